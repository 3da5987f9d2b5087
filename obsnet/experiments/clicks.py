"""Clicks on a compact array (`obsnet reproduce clicks`): the paper's clutter experiment, two animals, and
whole recordings.

All data are simulated. Three scenarios:

- *clutter*: one animal for 5 min, TDOAs rounded to samples at 96 kHz on a tetrahedron of 1 m, with clutter
uniform over
  ±1.5 ms, one a pair and scan in the mean (the paper's figs 7 and 8). The point-by-point regression is told
  which TDOAs are the animal's; the tracker is not. Beside it, the regression that takes the best-fitting
  combination of each scan.
- *two animals* (the paper's stated future): the same clutter, 90 % of the clicks heard, one animal begins
late, one ends
  early; OSPA against time.
- *recordings*: 60 s of samples of two animals, their surface echoes and coloured noise, written to a 16 bit
WAV file and
  put through detector, TDOA, angle of arrival, echo ranging and tracker.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import wavfile

from obsnet.arrays.arrival import directions
from obsnet.arrays.clicks import ClickRecord, process
from obsnet.arrays.compact import CompactArray
from obsnet.experiments import montecarlo
from obsnet.experiments.click_scenes import (
    QUANTISATION_S,
    SAMPLING_RATE_HZ,
    AnimalPath,
    TdoaScene,
    simulated_click_times,
    simulated_path,
    simulated_recording,
    simulated_tdoas,
)
from obsnet.experiments.click_scores import (
    association_counts,
    audible,
    best_fits,
    click_errors,
    merged,
    nearest_arrival,
    over_stated,
    own_tdoas,
    owner_of,
    range_errors,
    separations,
    squares,
    track_errors,
)
from obsnet.experiments.clicks_result import CUTOFF_DEG, Result
from obsnet.kinematics import wrap180
from obsnet.trackers.association import Association, associate
from obsnet.trackers.metrics import ospa
from obsnet.trackers.observation_models import TdoaModel
from obsnet.trackers.scans import ScanConfig, click_scans, regular_scans

DURATION_S = 300.0
RECORDING_S = 60.0
MOST_RECORDINGS = 8


def reproduce(
    runs: int = 50, seed: int = 0, progress: montecarlo.Progress | None = None, jobs: int = 1
) -> Result:
    """Run the three scenarios.

    Parameters
    ----------
    runs : of the first two scenarios; of the recordings at most `MOST_RECORDINGS`.
    seed : of all simulated data. progress : callable(done, total). jobs : processes.

    Raises
    ------
    ConfigError
        `runs`, `seed` or `jobs` is out of range.
    """
    recordings = min(runs, MOST_RECORDINGS)
    total = 2 * runs + recordings
    outcomes = []
    for trial, count, before in (
        (clutter, runs, 0),
        (two_animals, runs, runs),
        (recording, recordings, 2 * runs),
    ):
        outcomes.append(montecarlo.run(trial, count, seed, jobs, _shifted(progress, before, total)))
    return Result(runs, seed, *outcomes)


def clutter(rng: np.random.Generator) -> dict[str, float]:
    """One run of the first scenario: sums of squared errors, and counts."""
    scene, array, pairs = clutter_scene(rng)
    found, _ = tracked(scene, array, pairs, clicking=0.95, seed=rng)
    azimuth, elevation = scene.paths[0].direction(scene.time, array.mean_depth_m)
    own = own_tdoas(scene, len(pairs))
    regression = directions(own, array, pairs, np.eye(len(pairs)) * QUANTISATION_S**2)
    naive = best_fits(scene, array, pairs)
    number = owner_of(found, scene, 0)
    outcome = {
        "tracks": float(len(found.tracks)),
        **association_counts(found, scene, number),
        **squares("regression", regression.azimuth_deg - azimuth, regression.elevation_deg - elevation),
        **squares("naive", naive[0] - azimuth, naive[1] - elevation),
    }
    if number is None:
        return outcome
    track = found.tracks[number]
    here = np.searchsorted(scene.time, track.time)
    turn, rise = wrap180(track.azimuth_deg - azimuth[here]), track.elevation_deg - elevation[here]
    outcome |= squares("smoother", turn, rise)
    outcome |= squares("filter", track.filtered[:, 0] - azimuth[here], track.filtered[:, 1] - elevation[here])
    outcome["smoother_normalised"] = float(over_stated(track, turn, rise).sum())
    return outcome


def two_animals(rng: np.random.Generator) -> dict[str, Any]:
    """One run of the second scenario: OSPA [deg] against time, numbers of animals and of tracks."""
    scene, array, pairs = two_animal_scene(rng)
    found, _ = tracked(scene, array, pairs, clicking=0.9, seed=rng)
    distance = [ospa(separations(scene, found, array, k), CUTOFF_DEG, 1.0) for k in range(len(scene.time))]
    alive = audible(scene)
    said = np.array([sum(t.time[0] <= time <= t.time[-1] for t in found.tracks) for time in scene.time])
    return {
        "ospa": np.array(distance),
        "right_number": float((said == alive.sum(axis=0)).mean()),
        "tracks": len(found.tracks),
    }


def recording(rng: np.random.Generator) -> dict[str, float]:
    """One run of the third scenario: detections, errors of clicks and of tracks, ranges from echoes."""
    array = CompactArray.tetrahedron()
    paths, record, direct, echo = simulated_record(rng, array)
    found = associate(click_scans(record), _record_model(record), seed=rng)
    heard, animal = merged(direct)
    which, near = nearest_arrival(record.time, heard)
    _, is_echo = nearest_arrival(record.time, merged(echo)[0])
    accepted = record.directions.accepted
    outcome = {
        "clicks": float(len(heard)),
        "found": float(len(np.unique(which[near & accepted]))),
        "false": float((~near & ~is_echo & accepted).sum()),
        "animals": float(len(paths)),
        "tracks": float(len(found.tracks)),
    }
    errors = click_errors(record, paths, animal[which], near & accepted, array)
    outcome |= squares("clicks", *errors)
    turn, rise, over = track_errors(found, paths, array)
    outcome |= squares("tracks", turn, rise)
    outcome["tracks_normalised"] = float(over.sum())
    outcome |= range_errors(record, paths, animal[which], near)
    return outcome


def clutter_scene(rng: np.random.Generator) -> tuple[TdoaScene, CompactArray, np.ndarray]:
    """Simulated TDOAs of one animal clicking about once a second, and clutter."""
    array = CompactArray.tetrahedron()
    pairs = array.pairs(every=False)
    time = simulated_click_times(rng, 0.0, DURATION_S)
    path = simulated_path(rng, DURATION_S)
    return simulated_tdoas(rng, array, pairs, [path], time, np.ones((1, len(time)), bool)), array, pairs


def two_animal_scene(rng: np.random.Generator) -> tuple[TdoaScene, CompactArray, np.ndarray]:
    """Simulated TDOAs of one animal that ends after three quarters and one that begins after a quarter.

    One scan a second; the animals are at the same azimuth at half time.
    """
    array = CompactArray.tetrahedron()
    pairs = array.pairs(every=False)
    time = np.arange(1.0, DURATION_S)
    first, second = (simulated_path(rng, DURATION_S) for _ in range(2))
    half = np.array(DURATION_S / 2.0)
    meeting, own = (path.direction(half, array.mean_depth_m)[0] for path in (first, second))
    paths = [first, second.turned(float(meeting - own))]
    heard = rng.random((2, len(time))) < 0.9
    heard &= np.stack([time < 0.75 * DURATION_S, time >= 0.25 * DURATION_S])
    return simulated_tdoas(rng, array, pairs, paths, time, heard, detection=0.98), array, pairs


def tracked(
    scene: TdoaScene,
    array: CompactArray,
    pairs: np.ndarray,
    clicking: float,
    seed: int | np.random.Generator = 0,
) -> tuple[Association, TdoaModel]:
    """Association of a simulated scene, with the priors that it was simulated with."""
    model = TdoaModel(array, pairs, np.eye(len(pairs)) * QUANTISATION_S**2)
    scans = regular_scans(scene.time, scene.channel, scene.value, len(pairs), ScanConfig(clicking=clicking))
    return associate(scans, model, seed=seed), model


def simulated_record(
    rng: np.random.Generator, array: CompactArray
) -> tuple[list[AnimalPath], ClickRecord, list[np.ndarray], list[np.ndarray]]:
    """A simulated recording of two animals, through a WAV file; arrival times of clicks and of echoes."""
    paths = [simulated_path(rng, RECORDING_S) for _ in range(2)]
    emitted = [simulated_click_times(rng, -2.0, RECORDING_S, interval) for interval in (1.0, 0.8)]
    samples, direct, echo = simulated_recording(rng, array, paths, emitted, RECORDING_S, source_level=4.0)
    stored = np.round(samples / np.abs(samples).max() * 32_000.0).astype(np.int16)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "simulated.wav"
        wavfile.write(path, int(SAMPLING_RATE_HZ), stored.T)
        record = process(path, array)
    return paths, record, direct, echo


def _record_model(record: ClickRecord) -> TdoaModel:
    """Model of a recording's TDOAs; each click brings its own covariance."""
    return TdoaModel(record.array, record.pairs, record.array.tdoa_covariance(record.pairs, 1e-6, 1e-6))


def _shifted(progress: montecarlo.Progress | None, before: int, total: int) -> montecarlo.Progress | None:
    return None if progress is None else lambda done, _: progress(before + done, total)
