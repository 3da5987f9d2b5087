"""Where a run's minutes go as they are finished: into memory, or block by block into a folder, and from there again."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from obsnet import netcdf
from obsnet.detectors.maps import joined
from obsnet.output import prepare_folder
from obsnet.pipeline import Minutes
from obsnet.signals.station import Station
from obsnet.tables import DETECTION_COLUMNS


class MemorySink:
    """Collects minutes in memory."""

    def __init__(self) -> None:
        self._minutes: list[Minutes] = []

    def append(self, minutes: Minutes) -> None:
        """Take the next minutes."""
        self._minutes.append(minutes)

    def close(self) -> tuple[xr.Dataset, xr.Dataset | Path]:
        """Finish; maps and features come back."""
        return joined([m.maps for m in self._minutes]), joined([m.features for m in self._minutes])

    def detections(self) -> pd.DataFrame:
        """The rows of detections.csv so far."""
        frames = [m.detections for m in self._minutes]
        return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=DETECTION_COLUMNS)

    def presence(self) -> pd.DataFrame:
        """Log presence ratios so far, indexed by s since 1970."""
        return pd.concat([m.presence for m in self._minutes]) if self._minutes else pd.DataFrame()

    def __enter__(self) -> MemorySink:
        return self

    def __exit__(self, *error: Any) -> None:
        return None


class FolderSink(MemorySink):
    """Writes maps and features to disk as they come; keeps the small tables."""

    def __init__(self, folder: str | Path, station: Station) -> None:
        super().__init__()
        self._folder = prepare_folder(folder)
        attrs = {"station": station.code, "source": f"obsnet {version('obsnet')}"}
        self._writers = [
            netcdf.TimeWriter(self._folder / f"{name}.nc", attrs) for name in ("maps", "features")
        ]

    def append(self, minutes: Minutes) -> None:
        """Write the next minutes."""
        self._writers[0].append(minutes.maps)
        self._writers[1].append(minutes.features)
        empty = xr.Dataset()
        self._minutes.append(Minutes(empty, minutes.detections, minutes.presence, empty))

    def close(self) -> tuple[xr.Dataset, xr.Dataset | Path]:
        """Finish the files; the maps come back unread, and where the features are."""
        if not self._minutes:
            return MemorySink().close()
        for writer in self._writers:
            writer.close()
        return netcdf.read(self._folder / "maps.nc"), self._folder / "features.nc"

    def __exit__(self, *error: Any) -> None:
        for writer in self._writers:
            writer.__exit__(*error)


def read_minutes(path: Path, count: int) -> xr.Dataset:
    """A file of maps or features that holds `count` minutes; a run without minutes has none."""
    if count == 0:
        return xr.Dataset(coords={"time": np.empty(0, "datetime64[ns]")})
    path.stat()
    dataset = netcdf.join_complex(netcdf.read(path))
    if dataset.sizes["time"] != count:
        raise ValueError(f"{path.name} holds {dataset.sizes['time']} minutes, detections.csv {count}")
    return dataset
