"""What goes wrong between the sensors and the archive: gaps, dead and clipped channels, late starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError

FULL_SCALE = 2**23 - 1


@dataclass(frozen=True)
class Gap:
    """No data from `start_s` for `duration_s`, seconds from the record's start, on `components` (letters of
    H12Z).
    """

    start_s: float
    duration_s: float
    components: str = "H12Z"


@dataclass(frozen=True)
class Faults:
    """Faults of a record.

    Parameters
    ----------
    gaps : tuple of Gap
        Missing samples.
    dead : str
        Components (letters of H12Z) that record zeros.
    clip_counts : int
        Full scale: 24 bits where nothing is wrong.
    clipped : str
        Components that clip at a hundredth of it.
    late_s : tuple of float
        Seconds by which H, 1, 2, Z start after the record's start.
    """

    gaps: tuple[Gap, ...] = ()
    dead: str = ""
    clip_counts: int = FULL_SCALE
    clipped: str = ""
    late_s: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if set(self.dead + self.clipped) - set("H12Z"):
            raise ConfigError(f"components are letters of H12Z, found {self.dead=} {self.clipped=}")
        if len(self.late_s) != 4 or min(self.late_s) < 0:
            raise ConfigError(f"late_s holds a delay for each of H, 1, 2, Z, found {self.late_s}")

    @classmethod
    def random(cls, generator: np.random.Generator, hours: float) -> Faults:
        """Draw gaps of seconds to half an hour, in a third of the records, some on one channel only."""
        if generator.random() > 1 / 3:
            return cls()
        gaps = []
        for _ in range(1 + generator.poisson(1.0)):
            duration = float(np.exp(generator.uniform(np.log(2.0), np.log(1800.0))))
            where = "H12Z" if generator.random() < 0.7 else str(generator.choice(list("H12Z")))
            gaps.append(Gap(float(generator.uniform(0.0, hours * 3600.0)), duration, where))
        return cls(gaps=tuple(gaps))

    def pieces(
        self, part: str, first: int, counts: np.ndarray, sampling_rate: float, start: float
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Contiguous pieces of a component's int32 counts, with their offset in samples."""
        limit = self.clip_counts // 100 if part in self.clipped else self.clip_counts
        whole = np.clip(counts, -limit - 1, limit)
        if part in self.dead:
            whole[:] = 0
        keep = np.ones(whole.size, bool)
        spans = [(g.start_s, g.start_s + g.duration_s) for g in self.gaps if part in g.components]
        spans.append((-np.inf, self.late_s["H12Z".index(part)]))
        time = (first + np.arange(whole.size)) / sampling_rate - start
        for begin, end in spans:
            keep &= (time < begin) | (time >= end)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], keep, [False])).astype(np.int8)))
        for low, high in edges.reshape(-1, 2):
            yield int(low), whole[low:high]
