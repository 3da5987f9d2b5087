"""One station-day: waveforms around it in; its minutes as Parquet and its maps as Zarr out.

The record is read from so long before midnight that what the causal filters remember at midnight is what they would in
one continuous run, and until the last minute's window is full.
"""

from __future__ import annotations

import os
import shutil
import time
import traceback
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

import obsnet
from obsnet import netcdf
from obsnet.archive.ledger import DAY_S, UNFINISHED, Day, Ledger, put
from obsnet.errors import ObsnetError, OutputError, WaveformError
from obsnet.layout import from_posix, to_posix
from obsnet.ocean.rays import propagation_table
from obsnet.pipeline import Minutes, Pipeline, RunConfig
from obsnet.signals.spectra import iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import WaveformSource, open_waveforms

CHUNK_MINUTES = 60
MINUTE_COLUMNS = [
    "time", "coverage", "azimuth_deg", "azimuth_llr", "range_m", "range_rate_mps", "range_llr", "approaching_llr",
    "leaving_llr",
]  # fmt: skip
"""Those of detections.csv, and the presence of a closing and of an opening ship, which the segmentation takes."""


@dataclass(frozen=True)
class DayTask:
    """What a worker needs to detect one station-day: paths that it can see, and parameters."""

    waveforms: str
    folder: str
    day: Day
    config: RunConfig


def detect_day(task: DayTask) -> dict[str, Any]:
    """Detect one station-day, write it and its record; the record says 'done' or 'failed' and why.

    Raises
    ------
    OutputError : the results cannot be written, which no other day will escape.
    """
    ledger, begun = Ledger(task.folder), time.perf_counter()
    entry: dict[str, Any] = {"station": task.day.code, "date": task.day.date, "obsnet": obsnet.__version__}
    try:
        entry |= _detect(task, ledger) | {"status": "done"}
    except OutputError:
        raise
    except ObsnetError as error:
        entry |= {"status": "failed", "error": one_line(error)}
    except Exception as error:
        text = f"{type(error).__name__}: {one_line(error)}"
        entry |= {"status": "failed", "error": text, "traceback": traceback.format_exc()}
    entry["seconds"] = round(time.perf_counter() - begun, 3)
    ledger.write(task.day, entry)
    return entry


def one_line(error: BaseException) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split())[:300]


@lru_cache(maxsize=8)
def station_of(path: str, changed_ns: int) -> Station:
    """The station of a StationXML file, kept between days."""
    return Station.from_stationxml(path)


@lru_cache(maxsize=8)
def table_of(config: RunConfig, depth_m: float) -> xr.Dataset:
    """Propagation table of a station, kept between days."""
    return propagation_table(config.ocean, depth_m)


def known_station(ledger: Ledger, code: str, time: float) -> Station:
    """A station of the archive, where it lies at a time [s since 1970]."""
    path = ledger.station_file(code)
    return station_of(str(path), path.stat().st_mtime_ns).placed(time)


def _detect(task: DayTask, ledger: Ledger) -> dict[str, Any]:
    day, config = task.day, task.config
    station = known_station(ledger, day.code, day.start)
    reach = config.azimuth.window_s + config.spectra.window_s
    source = open_waveforms(
        task.waveforms, station, starttime=day.start - config.memory_s, endtime=day.start + DAY_S + reach,
        min_rate_hz=config.spectra.analysis_rate_hz,
    )  # fmt: skip
    table = table_of(config, station.depth_m)
    pipeline = Pipeline(station, config, table=table, begin=day.start)
    step = config.azimuth.step_s
    times = from_posix(day.start + step * np.arange(round(DAY_S / step)))
    parts = []
    with DayMaps(
        ledger.maps(day), times, {"station": day.code, "source": f"obsnet {obsnet.__version__}"}
    ) as maps:
        for block in iter_spectra(source, config.spectra):
            for minutes in pipeline.push(block):
                parts.append(_table(minutes))
                maps.append(minutes.maps)
        for minutes in pipeline.flush():
            parts.append(_table(minutes))
            maps.append(minutes.maps)
        rows = pd.concat(parts) if parts else pd.DataFrame(columns=MINUTE_COLUMNS)
        rows = rows.set_index("time").reindex(pd.DatetimeIndex(times, name="time")).reset_index()
        rows = rows.reindex(columns=MINUTE_COLUMNS).fillna({"coverage": 0.0})
        if not (rows["coverage"] > 0).any():
            raise WaveformError(_nothing(day, source))
    size = put(rows.assign(time=rows["time"].dt.tz_localize("UTC")), ledger.detections(day))
    return {
        "minutes": int((rows["coverage"] > 0).sum()),
        "azimuths": int(rows["azimuth_deg"].notna().sum()),
        "ranges": int(rows["range_m"].notna().sum()),
        "bytes": size + sum(path.stat().st_size for path in ledger.maps(day).rglob("*") if path.is_file()),
        "notes": source.report.notes[:20],
    }


def _table(minutes: Minutes) -> pd.DataFrame:
    ratios = minutes.presence
    both = {f"{name}_llr": ratios[name].to_numpy() for name in ("approaching", "leaving") if name in ratios}
    return minutes.detections.assign(**both)


def _nothing(day: Day, source: WaveformSource) -> str:
    why = [f"{Path(path).name}: {reason}" for path, reason in list(source.report.ignored.items())[:4]]
    why += [
        f"{seed_id}: {channel.dead_frames} dead and {channel.clipped_frames} clipped frames"
        for seed_id, channel in source.report.channels.items()
    ]
    return (
        f"no minute of {day.code} on {day.date} has usable data ({'; '.join([*why, *source.report.notes])})"
    )


class DayMaps:
    """Writes the maps of a day into one Zarr group, block by block; it appears when all is written, or never.

    Rows of minutes without data are NaN, their coverage 0. `range_llr` is packed as in maps.nc.

    Parameters
    ----------
    path : of the group.
    times : datetime64 array, all minutes of the day.
    attrs : of the group.
    """

    def __init__(self, path: Path, times: np.ndarray, attrs: dict[str, Any]) -> None:
        self.path, self.times, self.attrs = path, times, attrs
        self._partial = path.with_name(f"{UNFINISHED}{os.getpid()}-{path.name}")
        self._made = False

    def append(self, maps: xr.Dataset) -> None:
        """Write the rows of `maps` that lie within the day."""
        seconds, own = to_posix(maps["time"].values), to_posix(self.times)
        maps = maps.isel(time=(seconds >= own[0]) & (seconds <= own[-1]))
        if not maps.sizes["time"]:
            return
        first = int(np.searchsorted(own, to_posix(maps["time"].values[0])))
        block = maps.drop_vars(list(maps.coords)).transpose("time", ...)
        for name in netcdf.PACKED:
            if name in block:
                block[name] = block[name].clip(-netcdf.LARGEST, netcdf.LARGEST)
        try:
            if not self._made:
                self._make(maps)
            region = {"time": slice(first, first + maps.sizes["time"])}
            block.drop_attrs().to_zarr(self._partial, region=region, consolidated=False)
        except OSError as error:
            raise OutputError(
                f"cannot write {self.path}: {error.strerror or error}; make room for it"
            ) from None

    def _make(self, maps: xr.Dataset) -> None:
        import dask.array

        self._partial.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self._partial, ignore_errors=True)
        coords = {name: coord for name, coord in maps.coords.items() if name != "time"}
        whole = xr.Dataset(coords=coords | {"time": self.times}, attrs=self.attrs)
        encoding: dict[str, dict[str, Any]] = {}
        for key, values in maps.data_vars.items():
            name = str(key)
            dims = ("time", *(dim for dim in values.dims if dim != "time"))
            shape = tuple(len(self.times) if dim == "time" else maps.sizes[dim] for dim in dims)
            chunks = (min(CHUNK_MINUTES if len(dims) > 2 else shape[0], shape[0]), *shape[1:])
            if len(dims) > 1:
                encoding[name] = {"chunks": chunks, "compressors": _compressors(), "fill_value": np.nan}
                whole[name] = dims, dask.array.full(shape, np.nan, np.float32, chunks=chunks), values.attrs
            else:
                whole[name] = dims, np.zeros(shape, np.float32), values.attrs
            if name in netcdf.PACKED:
                packing = {"dtype": "int16", "scale_factor": netcdf.PACKED[name]}
                encoding[name] |= packing | {"_FillValue": int(netcdf.FILL), "fill_value": int(netcdf.FILL)}
        whole.to_zarr(self._partial, mode="w", compute=False, encoding=encoding, consolidated=False)
        self._made = True

    def __enter__(self) -> DayMaps:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and self._made:
            shutil.rmtree(self.path, ignore_errors=True)
            os.replace(self._partial, self.path)
        shutil.rmtree(self._partial, ignore_errors=True)


def _compressors() -> tuple[Any, ...]:
    from zarr.codecs import BloscCodec, BloscShuffle

    return (BloscCodec(cname="zstd", clevel=3, shuffle=BloscShuffle.bitshuffle),)
