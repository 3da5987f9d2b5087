"""What the click experiment counts: associations, clicks, angles and ranges in, errors against the simulated
truth out.
"""

from __future__ import annotations

import itertools

import numpy as np

from obsnet.arrays.arrival import directions
from obsnet.arrays.clicks import ClickRecord
from obsnet.arrays.compact import CompactArray, unit_vector
from obsnet.experiments.click_scenes import QUANTISATION_S, AnimalPath, TdoaScene
from obsnet.kinematics import wrap180
from obsnet.trackers.association import Association
from obsnet.trackers.track_tree import AnimalTrack


def association_counts(found: Association, scene: TdoaScene, number: int | None) -> dict[str, float]:
    """Clutter and what tracks took of it; the first animal's TDOAs and those that track `number` missed."""
    animal, owner = np.concatenate(scene.animal), np.concatenate(found.owner)
    return {
        "clutter": float((animal < 0).sum()),
        "clutter_taken": float((owner[animal < 0] >= 0).sum()),
        "own": float((animal == 0).sum()),
        "own_lost": float((animal == 0).sum() if number is None else (owner[animal == 0] != number).sum()),
    }


def squares(name: str, azimuth_error: np.ndarray, elevation_error: np.ndarray) -> dict[str, float]:
    """Sums of squared errors [deg²] and their number."""
    return {
        f"{name}_azimuth": float((wrap180(azimuth_error) ** 2).sum()),
        f"{name}_elevation": float((np.asarray(elevation_error) ** 2).sum()),
        f"{name}_count": float(len(elevation_error)),
    }


def own_tdoas(scene: TdoaScene, pairs: int) -> np.ndarray:
    """The first animal's own TDOAs, dims (scan, pair), NaN where it was not measured."""
    own = np.full((len(scene.time), pairs), np.nan)
    for k, animal in enumerate(scene.animal):
        own[k, scene.channel[k][animal == 0]] = scene.value[k][animal == 0]
    return own


def best_fits(scene: TdoaScene, array: CompactArray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direction of each scan's best-fitting combination of TDOAs: the classic method among clutter."""
    combinations, row = [], []
    for k, (channel, value) in enumerate(zip(scene.channel, scene.value, strict=True)):
        choices = [value[channel == pair] for pair in range(len(pairs))]
        ways = list(itertools.product(*choices))
        combinations += ways
        row += [k] * len(ways)
    fit = directions(np.array(combinations), array, pairs, np.eye(len(pairs)) * QUANTISATION_S**2)
    order = np.lexsort((fit.chi_squared, np.array(row)))
    best = order[np.unique(np.array(row)[order], return_index=True)[1]]
    return fit.azimuth_deg[best], fit.elevation_deg[best]


def owner_of(found: Association, scene: TdoaScene, animal: int) -> int | None:
    """The track that took most of an animal's TDOAs."""
    taken = np.concatenate([o[a == animal] for o, a in zip(found.owner, scene.animal, strict=True)])
    taken = taken[taken >= 0]
    return int(np.bincount(taken).argmax()) if len(taken) else None


def audible(scene: TdoaScene) -> np.ndarray:
    """Animals between their first and their last click, bool (animal, scan)."""
    before = np.maximum.accumulate(scene.present, axis=1)
    after = np.maximum.accumulate(scene.present[:, ::-1], axis=1)[:, ::-1]
    return before & after


def _at(track: AnimalTrack, time: float) -> np.ndarray | None:
    """Unit vector towards a track at `time`; None outside its life."""
    k = int(np.searchsorted(track.time, time - 1e-9))
    if k == len(track.time) or abs(track.time[k] - time) > 1e-6:
        return None
    return unit_vector(track.azimuth_deg[k], track.elevation_deg[k])


def separations(scene: TdoaScene, found: Association, array: CompactArray, k: int) -> np.ndarray:
    """Angles on the sphere [deg] between animals and tracks at scan `k`, dims (animal, track)."""
    alive = np.flatnonzero(audible(scene)[:, k])
    truth = [unit_vector(*scene.paths[i].direction(scene.time[k], array.mean_depth_m)) for i in alive]
    said = [vector for vector in (_at(track, scene.time[k]) for track in found.tracks) if vector is not None]
    if not truth or not said:
        return np.empty((len(truth), len(said)))
    return np.rad2deg(np.arccos(np.clip(np.array(truth) @ np.array(said).T, -1.0, 1.0)))


def merged(times: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All animals' arrival times in order, and whose each is."""
    animal = np.repeat(np.arange(len(times)), [len(t) for t in times])
    merged = np.concatenate(times)
    order = np.argsort(merged)
    return merged[order], animal[order]


def nearest_arrival(time: np.ndarray, heard: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest arrival of each detection, and whether it is within 2 ms."""
    if not len(heard):
        return np.zeros(len(time), int), np.zeros(len(time), bool)
    after = (
        np.clip(np.searchsorted(heard, time), 1, max(len(heard) - 1, 1))
        if len(heard) > 1
        else np.zeros(len(time), int)
    )
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(heard[before] - time) <= np.abs(heard[after] - time), before, after)
    return nearest, np.abs(heard[nearest] - time) < 2e-3


def _emission(path: AnimalPath, heard: np.ndarray, array: CompactArray) -> np.ndarray:
    """Time at which what is heard at `heard` left the animal."""
    emitted = np.array(heard, float)
    for _ in range(3):
        offset = path.at(emitted) - np.array([0.0, 0.0, array.mean_depth_m])
        emitted = heard - np.linalg.norm(offset, axis=-1) / array.sound_speed_mps
    return emitted


def click_errors(
    record: ClickRecord, paths: list[AnimalPath], animal: np.ndarray, use: np.ndarray, array: CompactArray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of azimuth and elevation [deg] of the clicks in `use`."""
    turn, rise = np.zeros(len(record.time)), np.zeros(len(record.time))
    for number, path in enumerate(paths):
        azimuth, elevation = path.direction(_emission(path, record.time, array), array.mean_depth_m)
        mine = animal == number
        turn[mine] = (record.directions.azimuth_deg - azimuth)[mine]
        rise[mine] = (record.directions.elevation_deg - elevation)[mine]
    return turn[use], rise[use]


def track_errors(
    found: Association, paths: list[AnimalPath], array: CompactArray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors [deg] of the smoothed tracks at their clicks, each against the animal that it follows best.

    The third array holds the mean of the two squared errors, each over the variance that the track states.
    """
    turns, rises, over = [np.empty(0)], [np.empty(0)], [np.empty(0)]
    for track in found.tracks:
        candidates = []
        for path in paths:
            azimuth, elevation = path.direction(_emission(path, track.time, array), array.mean_depth_m)
            turn = wrap180(track.azimuth_deg - azimuth)[track.clicked]
            candidates.append((turn, (track.elevation_deg - elevation)[track.clicked]))
        turn, rise = min(candidates, key=lambda errors: float((errors[0] ** 2 + errors[1] ** 2).sum()))
        turns.append(turn)
        rises.append(rise)
        over.append(over_stated(track, turn, rise, track.clicked))
    return np.concatenate(turns), np.concatenate(rises), np.concatenate(over)


def over_stated(
    track: AnimalTrack, turn: np.ndarray, rise: np.ndarray, at: np.ndarray | slice = slice(None)
) -> np.ndarray:
    """Mean of the squared errors of azimuth and elevation, each over the variance that the smoother states."""
    variance = np.diagonal(track.smoothed_covariance, axis1=1, axis2=2)[at]
    return (turn**2 / variance[:, 0] + rise**2 / variance[:, 1]) / 2.0


def range_errors(
    record: ClickRecord, paths: list[AnimalPath], animal: np.ndarray, near: np.ndarray
) -> dict[str, float]:
    """Squared relative errors of the ranges from surface echoes, with their number."""
    ranged = np.isfinite(record.echoes.range_m)
    right = ranged & near
    truth = np.array([np.linalg.norm(path.at(record.time)[:, :2], axis=1) for path in paths])
    relative = record.echoes.range_m[right] / truth[animal[right], np.flatnonzero(right)] - 1.0
    return {
        "ranged": float(ranged.sum()),
        "ranged_right": float((np.abs(relative) < 0.1).sum()),
        "range_squares": float((relative[np.abs(relative) < 0.1] ** 2).sum()),
    }
