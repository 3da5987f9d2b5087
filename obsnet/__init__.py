"""obsnet: one ocean-bottom station detects, localises and tracks ships.

Waveforms become an azigram and a cepstrogram; a detector (learned or analytic) turns those into likelihood maps;
Bayesian segmentation and a grid-search tracker turn the maps into tracks. Nothing heavy is imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOME = {
    "Station": "obsnet.signals.station",
    "Track": "obsnet.trackers.track",
    "RunConfig": "obsnet.run",
    "Run": "obsnet.run",
    "track": "obsnet.run",
    "detect": "obsnet.run",
}

__all__ = ["Run", "RunConfig", "Station", "Track", "__version__", "detect", "track"]

if TYPE_CHECKING:
    from obsnet.run import Run, RunConfig, detect, track
    from obsnet.signals.station import Station
    from obsnet.trackers.track import Track


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'obsnet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
