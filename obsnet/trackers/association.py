"""Rao-Blackwellised Monte Carlo data association: scans of measurements in, tracks of several animals out.

Each particle is one history of associations {animal k, clutter, new animal}; given a history every animal's
state is an extended Kalman filter's, and so is the probability that it still clicks. Particles that agree on
an animal's history share its filter: a tree of tracks whose branches are the associations, so that the cost
follows the disagreements, not the number of particles. The most probable history is smoothed by
Rauch–Tung–Striebel.

Source: Särkkä, Vehtari & Lampinen 2004, FUSION (the filter); Bénard-Caudal et al. 2010, Appl. Acoust. 71, §4
(one whale and clutter; several animals, births and deaths are its stated future).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.association_options import Options, offer
from obsnet.trackers.kalman import predict
from obsnet.trackers.observation_models import ObservationModel
from obsnet.trackers.particles import effective_sample_size, normalise, systematic_resampling
from obsnet.trackers.scans import Scan
from obsnet.trackers.track_tree import NOBODY, AnimalTrack, Forecast, TrackTree


@dataclass(frozen=True)
class AssociationConfig:
    """Rao-Blackwellised association.

    Attributes
    ----------
    particles : association histories kept.
    resample_below : share of effective particles below which they are resampled.
    lifetime_s : mean time that an animal goes on clicking.
    least_existence : tracks less probable than this are ended.
    gate_std : measurements farther from a track than this many standard deviations are not its.
    branches : combinations of measurements considered a track, the best ones.
    max_animals : tracks a particle may hold at a time.
    min_clicks : clicks below which a track of the final history is called clutter.
    """

    particles: int = 100
    resample_below: float = 0.5
    lifetime_s: float = 1800.0
    least_existence: float = 1e-3
    gate_std: float = 5.0
    branches: int = 16
    max_animals: int = 8
    min_clicks: int = 4

    def __post_init__(self) -> None:
        for name in ("particles", "branches", "max_animals", "min_clicks"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigError(f"{name} must be a whole number of at least 1, found {value!r}")
        for name in ("resample_below", "least_existence"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"{name} must lie between 0 and 1, found {getattr(self, name)!r}")
        if not (self.lifetime_s > 0 and self.gate_std > 0):
            raise ConfigError(
                f"lifetime_s and gate_std must be positive, found {self.lifetime_s!r} and {self.gate_std!r}"
            )


@dataclass(frozen=True)
class Association:
    """Outcome of `associate`.

    Attributes
    ----------
    tracks : animals of the most probable history, in the order of their first click.
    owner : one int array a scan: the track of each measurement, −1 for clutter.
    animals : array (scan,), expected number of animals over all histories.
    log_evidence : natural log of the measurements' probability, relative to all of them being clutter.
    """

    tracks: list[AnimalTrack]
    owner: list[np.ndarray]
    animals: np.ndarray
    log_evidence: float


@dataclass
class _Particles:
    """Histories: log weight, log joint probability, live tracks (−1: none), chained tracks that ended."""

    log_weight: np.ndarray
    joint: np.ndarray
    live: np.ndarray
    ended: list[tuple]

    def resample(self, rng: np.random.Generator) -> None:
        index = systematic_resampling(self.log_weight, rng)
        self.joint, self.live = self.joint[index], self.live[index]
        self.ended = [self.ended[k] for k in index]
        self.log_weight = np.full(len(index), -np.log(len(index)))


def associate(
    scans: Sequence[Scan],
    model: ObservationModel,
    config: AssociationConfig | None = None,
    seed: int | np.random.Generator = 0,
    initial: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> Association:
    """Track an unknown number of animals among clutter.

    The importance density of an association is its posterior given the particle's past: animals choose one
    after the other among the measurements that are still free, or none; then a new animal may; the rest is
    clutter. A particle's weight grows by the sum over its choices, so that their order does not bias it.

    Parameters
    ----------
    scans : in the order of time.
    model : how states move, what they measure, where a new one may be.
    seed : of the particles' choices.
    initial : means and covariances of animals known to be there at the first scan.

    Raises
    ------
    FilterError
        No history explains the measurements (where there is no clutter that could).
    LayoutError
        Scans are out of order or name a channel that the model does not have.
    """
    config = config or AssociationConfig()
    rng = np.random.default_rng(seed)
    _check(scans, model)
    count = config.particles
    tree, evidence = TrackTree(), 0.0
    roots = np.array([_root(tree, model, *state) for state in initial], int)
    live = np.broadcast_to(roots, (count, len(roots))).copy()
    particles = _Particles(np.full(count, -np.log(count)), np.zeros(count), live, [()] * count)
    animals = np.zeros(len(scans))
    for k, scan in enumerate(scans):
        interval_s = scan.time - scans[max(k - 1, 0)].time
        _step(particles, tree, k, scan, interval_s, model, config, rng)
        particles.log_weight, total = normalise(particles.log_weight, "association history")
        evidence += total
        alive = np.array([*tree.existence, 0.0])[particles.live].sum(axis=1)
        animals[k] = float(np.exp(particles.log_weight) @ alive)
        if effective_sample_size(particles.log_weight) < config.resample_below * count:
            particles.resample(rng)
    return Association(*_history(particles, tree, scans, config), animals, evidence)


def _check(scans: Sequence[Scan], model: ObservationModel) -> None:
    times = np.array([scan.time for scan in scans], float)
    if not np.isfinite(times).all() or np.any(np.diff(times) < 0):
        raise LayoutError("scans must be in the order of time; sort them first")
    for scan in scans:
        if len(scan.channel) and not 0 <= scan.channel.min() <= scan.channel.max() < model.channels:
            raise LayoutError(
                f"the scan at {scan.time:g} s has channels {scan.channel.min()} to {scan.channel.max()}, "
                f"the model 0 to {model.channels - 1}"
            )


def _root(tree: TrackTree, model: ObservationModel, mean: np.ndarray, covariance: np.ndarray) -> int:
    state = (np.asarray(mean, float), np.asarray(covariance, float))
    size = 2 * model.dimensions
    if state[0].shape != (size,) or state[1].shape != (size, size):
        raise LayoutError(f"an initial animal needs a mean ({size},) and a covariance ({size}, {size})")
    return tree.add(NOBODY, -1, (), 1.0, 0.0, state, state, np.eye(size))


def _step(
    particles: _Particles,
    tree: TrackTree,
    index: int,
    scan: Scan,
    interval_s: float,
    model: ObservationModel,
    config: AssociationConfig,
    rng: np.random.Generator,
) -> None:
    """Move all particles through one scan."""
    tracks = np.unique(particles.live[particles.live >= 0])
    mean, covariance, existence = tree.states(tracks, 2 * model.dimensions)
    transition, drift = model.dynamics(interval_s, mean)
    mean, covariance = predict(mean, covariance, transition, drift)
    existence = existence * np.exp(-interval_s / config.lifetime_s)
    forecast = Forecast(tracks, mean, covariance, existence, transition)
    options = offer(scan, model, forecast, config.gate_std, config.branches)
    chosen, birth = _choose(particles, scan, options, tracks, config, rng)
    children = _grow(tree, index, scan, forecast, options, particles.live, chosen, birth)
    live: list[list[int]] = []
    for p, row in enumerate(particles.live):
        after = [children[int(u), int(o)] for u, o in zip(row, chosen[p], strict=True) if u >= 0]
        for u in after:
            if tree.existence[u] < config.least_existence:
                particles.ended[p] = (particles.ended[p], u)
        kept = [u for u in after if tree.existence[u] >= config.least_existence]
        live.append([*kept, children[NOBODY, int(birth[p])]] if birth[p] else kept)
    width = max(map(len, live), default=0)
    particles.live = np.array([row + [NOBODY] * (width - len(row)) for row in live], int).reshape(
        len(live), width
    )


def _grow(
    tree: TrackTree,
    index: int,
    scan: Scan,
    forecast: Forecast,
    options: Options,
    live: np.ndarray,
    chosen: np.ndarray,
    birth: np.ndarray,
) -> dict[tuple[int, int], int]:
    """New nodes, one for each choice that some particle made: by (track, choice), −1 for new animals."""
    children: dict[tuple[int, int], int] = {}
    lasting = forecast.existence * np.exp(scan.log_miss - options.miss)
    for track, choice in {*zip(live[live >= 0].tolist(), chosen[live >= 0].tolist(), strict=True)}:
        row = int(np.searchsorted(forecast.tracks, track))
        before = (forecast.mean[row], forecast.covariance[row])
        if choice == 0:
            outcome = ((), lasting[row], options.miss[row], before)
        else:
            state = (options.updated[row, choice - 1], options.narrowed[row, choice - 1])
            outcome = (options.combinations[choice - 1], 1.0, options.hit[row, choice - 1], state)
        children[track, choice] = tree.add(track, index, *outcome, before, forecast.transition)
    for choice in {*birth[birth > 0].tolist()}:
        k = choice - 1
        state = (options.newborn[k], options.newborn_covariance[k])
        children[NOBODY, choice] = tree.add(
            NOBODY, index, options.combinations[k], 1.0, options.born[k], state, state, forecast.transition
        )
    return children


def _choose(
    particles: _Particles,
    scan: Scan,
    options: Options,
    tracks: np.ndarray,
    config: AssociationConfig,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw each particle's associations and grow its weight; choice 0 is none, k the combination k − 1."""
    count, slots = particles.live.shape
    chosen = np.zeros((count, slots), int)
    free = np.ones((count, len(scan.value)), bool)
    table = np.column_stack([options.miss, options.hit])
    for slot in range(slots):
        there = particles.live[:, slot] >= 0
        rows = np.searchsorted(tracks, particles.live[there, slot])
        chosen[there, slot] = _draw(particles, there, table[rows], free, options.member, rng)
    room = (particles.live >= 0).sum(axis=1) < config.max_animals
    fresh = np.broadcast_to(np.append(0.0, options.born), (count, len(options.born) + 1))[room]
    birth = np.zeros(count, int)
    birth[room] = _draw(particles, room, fresh, free, options.member, rng)
    impossible = (free & ~np.isfinite(scan.log_clutter)).any(axis=1)
    particles.log_weight = np.where(impossible, -np.inf, particles.log_weight)
    particles.joint = np.where(impossible, -np.inf, particles.joint)
    return chosen, birth


def _draw(
    particles: _Particles,
    where: np.ndarray,
    factors: np.ndarray,
    free: np.ndarray,
    member: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """One choice for each of the particles `where`, among combinations whose measurements are still free."""
    if not where.any():
        return np.empty(0, int)
    clash = (~free[where]).astype(float) @ member.T.astype(float) > 0
    factors = np.where(np.column_stack([np.zeros(len(clash), bool), clash]), -np.inf, factors)
    top = factors.max(axis=1, keepdims=True)
    cumulated = np.cumsum(np.exp(factors - top), axis=1)
    pick = (cumulated < rng.random(len(factors))[:, None] * cumulated[:, -1:]).sum(axis=1)
    particles.log_weight[where] += top[:, 0] + np.log(cumulated[:, -1])
    particles.joint[where] += factors[np.arange(len(pick)), pick]
    taken = np.vstack([np.zeros(member.shape[1], bool), member])[pick]
    free[where] &= ~taken
    return pick


def _history(
    particles: _Particles, tree: TrackTree, scans: Sequence[Scan], config: AssociationConfig
) -> tuple[list[AnimalTrack], list[np.ndarray]]:
    """Tracks of the most probable history, and the owner of each measurement."""
    owner = [np.full(len(scan.value), NOBODY) for scan in scans]
    best = int(particles.joint.argmax())
    leaves = [int(u) for u in particles.live[best] if u >= 0]
    ended = particles.ended[best]
    while ended:
        ended, leaf = ended
        leaves.append(leaf)
    found = [tree.track(leaf, scans, config.min_clicks) for leaf in leaves]
    tracks = sorted((track for track in found if track is not None), key=lambda track: track.time[0])
    for number, track in enumerate(tracks):
        for k, m in track.measurements:
            owner[k][m] = number
    return tracks, owner
