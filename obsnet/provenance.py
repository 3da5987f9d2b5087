"""What made a run: versions, seconds per stage, memory."""

from __future__ import annotations

import platform
import resource
import sys
import time
from importlib.metadata import version
from typing import Any


def versions() -> dict[str, Any]:
    """Versions of obsnet, of what it computes with, and of Python."""
    names = ("numpy", "scipy", "numba", "xarray", "pandas", "pyproj", "obspy", "onnxruntime")
    return {
        "obsnet": version("obsnet"),
        "versions": {name: version(name) for name in names},
        "python": platform.python_version(),
    }


def peak_memory_mb() -> float:
    """Greatest resident memory of this process so far, MB."""
    scale = 1024 if sys.platform != "darwin" else 1024**2
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale, 1)


class Clock:
    """Seconds spent per stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Charge the time since the last call to a stage."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._last
        self._last = now
