"""Where a source is in shallow water in; the delays between its paths, by the image method, and how well each
pair of paths can be heard, out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError
from obsnet.ocean.bottom import Bottom

IMAGE_DEPTHS = {
    "direct": (0, 1),
    "surface": (0, -1),
    "bottom": (2, -1),
    "surface-bottom": (-2, 1),
    "bottom-surface": (2, 1),
    "surface-bottom-surface": (-2, -1),
    "bottom-surface-bottom": (4, -1),
    "bottom-surface-bottom-surface": (4, 1),
}
"""Depth of the receiver's image for each path, as (multiple of the water depth, multiple of the receiver's
depth); a path's name lists its reflections from the source on."""

SHORTEST_M = 1e-3
SINES = 2001
"""Sines of the grazing angle at which the bottom's reflection is tabulated."""


@dataclass(frozen=True)
class Hearing:
    """What decides which pairs of paths are loud enough to be detected.

    Parameters
    ----------
    bottom : the sea floor.
    source_depth_m : m, where the source makes its sound: near the surface, which takes the low frequencies from
        flat paths (Lloyd's mirror).
    max_frequency_hz : Hz, the cepstrum's band ends here.
    delay_s, floor : arrays, dims (delay,): cepstral amplitude that a peak must exceed to be detected, against
        delay, s; constant beyond the ends.

    Raises
    ------
    ConfigError
        A size or an amplitude is not positive, or delays do not increase.
    """

    bottom: Bottom
    source_depth_m: float
    max_frequency_hz: float
    delay_s: np.ndarray
    floor: np.ndarray

    def __post_init__(self) -> None:
        for name in ("source_depth_m", "max_frequency_hz"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        if np.ndim(self.delay_s) != 1 or np.shape(self.delay_s) != np.shape(self.floor):
            raise ConfigError(
                "the detection floor needs one amplitude for each delay, found shapes "
                f"{np.shape(self.delay_s)} and {np.shape(self.floor)}"
            )
        if not (np.size(self.floor) and np.all(np.diff(self.delay_s) > 0) and np.all(self.floor > 0)):
            raise ConfigError("the detection floor needs increasing delays and positive amplitudes")


class ImageModel:
    """Delays in a waveguide of constant depth and sound speed, by the image method.

    Path k has the length q_k = √((p − i_k)² + r²), p the source's depth, i_k that of the receiver's image;
    the delay of a pair is |q_a − q_b|/c. A source above the surface, below the bottom, or at a negative range
    has no paths.

    Parameters
    ----------
    water_depth_m, sound_speed_mps : m, m/s, positive.
    paths : names out of `IMAGE_DEPTHS`; two of them make a pair, ordered (0, 1), (0, 2), (1, 2).
    bounces_apart : leave out pairs whose numbers of reflections at the bottom differ by more than this; None
        takes every two paths.
    hearing : what makes detection depend on the source's place; None: the same all over, as in the paper.

    Raises
    ------
    ConfigError
        A path is unknown or named twice, no pair is left, or a size is not positive.

    Notes
    -----
    With `hearing`, path k of b_k reflections at the bottom has the amplitude

        A_k = |R(θ_k)|^b_k √(1 − sin x_k / x_k) / q_k,    x_k = 4π f z sin θ_k / c,

    θ_k its grazing angle, z the source's depth, and the root the mean over frequencies up to f of what the
    source's image in the surface leaves of it, but for a factor that all paths share. In the cepstrum pair (a,
    b) has the amplitude A_a A_b / Σ A_k²; its visibility is that squared over that squared plus the square of
    the detection floor at its delay. Where a pair is as high as the floor it is detected half as often as at
    best.

    Source: Watkins et al., eq. (2), fig. 1 and section III-A, where probabilities of detection may depend on
    the source's place.

    >>> model = ImageModel(65.0, 1508.0)
    >>> model.pairs
    ('direct,bottom', 'direct,bottom-surface', 'bottom,bottom-surface')
    """

    def __init__(
        self,
        water_depth_m: float,
        sound_speed_mps: float,
        paths: Sequence[str] = ("direct", "bottom", "bottom-surface"),
        bounces_apart: int | None = None,
        hearing: Hearing | None = None,
    ) -> None:
        for name, value in {"water depth": water_depth_m, "sound speed": sound_speed_mps}.items():
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"the {name} must be positive, found {value}")
        unknown = [path for path in paths if path not in IMAGE_DEPTHS]
        if unknown:
            raise ConfigError(f"unknown path '{unknown[0]}'; the known ones are {', '.join(IMAGE_DEPTHS)}")
        if len(paths) < 2 or len(set(paths)) < len(paths):
            raise ConfigError(f"delays need two different paths at least, found {list(paths)}")
        if hearing is not None and any(path.startswith("surface") for path in paths):
            raise ConfigError(
                "with `hearing` every path holds the source's image in the surface; leave out the paths that "
                f"begin there, found {list(paths)}"
            )
        self.water_depth_m, self.sound_speed_mps = float(water_depth_m), float(sound_speed_mps)
        self.paths = tuple(paths)
        self._factors = np.array([IMAGE_DEPTHS[path] for path in self.paths], float)
        self._bounces = np.abs(self._factors[:, 0]) / 2
        first, second = np.triu_indices(len(self.paths), k=1)
        if bounces_apart is not None:
            kept = np.abs(self._bounces[first] - self._bounces[second]) <= bounces_apart
            first, second = first[kept], second[kept]
        if not len(first):
            raise ConfigError(f"no two of {list(paths)} are within {bounces_apart} reflections at the bottom")
        self._first, self._second = first, second
        self.pairs = tuple(f"{self.paths[a]},{self.paths[b]}" for a, b in zip(first, second, strict=True))
        self._hearing = hearing
        if hearing is not None:
            self._sines = np.linspace(0.0, 1.0, SINES)
            slowness = np.minimum(np.sqrt(1.0 - self._sines**2), 1.0 - 1e-9) / self.sound_speed_mps
            self._reflection = np.abs(hearing.bottom.reflection(slowness, self.sound_speed_mps))

    def tdoas(self, range_m: np.ndarray, depth_m: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Delays [s], dims (source, pair)."""
        range_m, depth_m = np.asarray(range_m, float), np.asarray(depth_m, float)
        images = self._images(receiver_depth_m)
        lengths = np.sqrt((depth_m[:, None] - images) ** 2 + range_m[:, None] ** 2)
        lengths[(range_m < 0) | (depth_m < 0) | (depth_m > self.water_depth_m)] = np.nan
        return np.abs(lengths[:, self._first] - lengths[:, self._second]) / self.sound_speed_mps

    def visibility(self, range_m: np.ndarray, receiver_depth_m: float | None = None) -> np.ndarray:
        """Factor of each pair's probability of detection, dims (source, pair), for a source near the surface."""
        if self._hearing is None:
            return np.ones((1, len(self.pairs)))
        images = self._images(receiver_depth_m)
        lengths = np.maximum(np.hypot(np.asarray(range_m, float)[:, None], images), SHORTEST_M)
        sines = np.minimum(np.abs(images) / lengths, 1.0)
        turns = 4.0 * self._hearing.max_frequency_hz * self._hearing.source_depth_m / self.sound_speed_mps
        power = np.interp(sines, self._sines, self._reflection) ** (2 * self._bounces)
        power *= np.maximum(1.0 - np.sinc(turns * sines), 0.0) / lengths**2
        total = np.maximum(power.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        energy = power[:, self._first] * power[:, self._second] / total**2
        delay = np.abs(lengths[:, self._first] - lengths[:, self._second]) / self.sound_speed_mps
        floor = np.interp(delay, self._hearing.delay_s, self._hearing.floor)
        return energy / (energy + floor**2)

    def _images(self, receiver_depth_m: float | None) -> np.ndarray:
        """Depths of the receiver's images [m], dims (path,)."""
        if receiver_depth_m is None or not 0.0 <= receiver_depth_m <= self.water_depth_m:
            raise ConfigError(
                f"the receiver's depth must lie in the water, 0 to {self.water_depth_m} m, "
                f"found {receiver_depth_m}"
            )
        return self._factors @ np.array([self.water_depth_m, receiver_depth_m])
