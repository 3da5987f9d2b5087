"""How much later than the water's depth says the sea floor's echo comes, from the cepstral branches of known
ships.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from obsnet.calibration.envelope import (
    BLOCK_S,
    CLIP,
    MIN_FRAMES,
    Branches,
    scan,
    scan_noise,
    score_offsets,
)
from obsnet.calibration.passages import vertex
from obsnet.calibration.result import Echo
from obsnet.ocean.amplitudes import Amplitudes

STEP_S, FINE_STEP_S = 0.02, 0.005
SIGNIFICANCE, MODEL_STD_S, STDS = 4.0, 0.004, 3.0


def echo_delay(
    branches: Branches, amplitudes: Amplitudes, limits_s: tuple[float, float], search_m: float, step_m: float
) -> Echo | None:
    """Delay of the echo at vertical incidence that puts the branches of all passages where they are heard.

    Delay and the station's offset are sought together, as `locate` seeks the offset, since both move a branch.
    The standard deviation is that of leaving out each 20 min in turn (jackknife), and `MODEL_STD_S` for what
    one layer leaves out.

    Parameters
    ----------
    limits_s : least and greatest delay sought, s. search_m, step_m : as for `locate`.

    Returns
    -------
    Echo, or None where there is one passage alone, which another place of the station explains nearly as well, or
    where the passages are explained as well without: by less than 4 standard deviations of noise, or within 3 of
    the delay's own.
    """
    if branches.heard.time.size < MIN_FRAMES or np.unique(branches.heard.passage).size < 2:
        return None
    weights = branches.weights(amplitudes)
    grid = np.arange(-search_m, search_m + step_m, 2.0 * step_m)
    delays = STEP_S * np.arange(np.ceil(limits_s[0] / STEP_S), np.floor(limits_s[1] / STEP_S) + 1)
    scores = np.stack([scan(branches.late(delay), weights, grid) for delay in delays])
    scores -= np.median(scores)
    at, i, j = (int(k) for k in np.unravel_index(scores.argmax(), scores.shape))
    gain = scores[at, i, j] - scores[np.abs(delays).argmin()].max()
    if not gain > SIGNIFICANCE * scan_noise(weights) or at in (0, delays.size - 1):
        return None
    found, std = _refined(branches, weights, float(delays[at]), (grid[i], grid[j]), step_m)
    return Echo(found, std) if abs(found) > STDS * std else None


def _refined(
    branches: Branches, weights: np.ndarray, start_s: float, place_m: tuple[float, float], step_m: float
) -> tuple[float, float]:
    """Delay [s] at the peak of the score near a coarse one, whatever the offset there, and its deviation."""
    delays = start_s + FINE_STEP_S * np.arange(-6, 7)
    around = step_m * np.linspace(-2.0, 2.0, 9)
    east, north = place_m[0] + around, place_m[1] + around
    excess, blocks = np.minimum(branches.excess, CLIP), branches.heard.blocks(BLOCK_S)
    parts = np.stack(
        [score_offsets(branches.late(s), excess, weights, east, north, blocks) for s in delays], axis=1
    )
    parts = gaussian_filter1d(parts, 1.0, axis=1)

    def peak(scores: np.ndarray) -> float:
        along = scores.max(axis=(1, 2))
        best = int(along.argmax())
        return float(delays[best] + FINE_STEP_S * vertex(along, best))

    total = parts.sum(axis=0)
    without = np.array([peak(total - part) for part in parts])
    scatter = (without.size - 1) * np.var(without) if without.size > 1 else np.inf
    return peak(total), float(np.sqrt(scatter + MODEL_STD_S**2))
