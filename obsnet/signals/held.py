"""Frames that are held between blocks of a record: joined, laid out for a store and taken up again, thinned for the eye."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import xarray as xr

from obsnet.layout import from_posix, to_posix

_SQUARED = {"m/s": "m2 s-2"}


def laid_out(frames: xr.DataArray) -> dict[str, np.ndarray]:
    """Frames as plain arrays: values, time, the other coordinate, and name, dims and attributes in JSON."""
    said = json.dumps({"name": frames.name, "dims": frames.dims, "attrs": frames.attrs})
    return {
        "values": frames.values,
        "time": frames["time"].values.astype(np.int64),
        "axis": frames[frames.dims[0]].values,
        "said": np.frombuffer(said.encode(), np.uint8),
    }


def taken_up(arrays: Mapping[str, np.ndarray]) -> xr.DataArray | None:
    """The frames of `laid_out`; none of nothing."""
    if not arrays:
        return None
    said = json.loads(arrays["said"].tobytes())
    coords = {said["dims"][0]: arrays["axis"], "time": arrays["time"].astype("datetime64[ns]")}
    return xr.DataArray(arrays["values"], coords, said["dims"], said["name"], said["attrs"])


def under(state: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """What a state holds under a name, without it."""
    return {key.removeprefix(f"{name}/"): value for key, value in state.items() if key.startswith(f"{name}/")}


def power_of(spectra: xr.Dataset) -> xr.DataArray:
    """The component whose power is shown: the pressure, or the ground motion without one."""
    return spectra[next(name for name in ("p", "down", "north", "east") if name in spectra)]


def thinned_power(spectra: xr.Dataset) -> xr.DataArray:
    """Power of the pressure (or of the ground motion without one) in bins of eight, so that a minute is small."""
    values = power_of(spectra)
    power = values.values.real**2 + values.values.imag**2
    bins = power.shape[0] // 8
    thinned = power[: bins * 8].reshape(bins, 8, -1).mean(axis=1)
    centre = spectra["frequency"].values[: bins * 8].reshape(bins, 8).mean(axis=1)
    coords = {"spectrogram_frequency": centre, "time": spectra["time"].values}
    unit = values.attrs.get("units", "1")
    attrs = {"long_name": "squared amplitude of a tone", "units": _SQUARED.get(unit, f"{unit}2")}
    return xr.DataArray(thinned, coords, ("spectrogram_frequency", "time"), "power", attrs)


def per_minute(frames: xr.DataArray, minutes: np.ndarray, step: float) -> xr.DataArray:
    """Mean of the frames within half a step of each minute; NaN where there is none."""
    times = to_posix(frames["time"].values)
    edges = np.searchsorted(times, np.append(minutes - step / 2, minutes[-1] + step / 2))
    values = frames.values
    valid = ~np.isnan(values[0])
    count = np.concatenate([[0], np.cumsum(valid)])
    number = count[edges[1:]] - count[edges[:-1]]
    full = np.diff(edges) > 0
    # each sum by itself: differences of a running one lose what is quiet after what was loud
    total = np.add.reduceat(np.where(valid, values, 0)[:, : edges[-1]], edges[:-1][full], axis=1)
    mean = np.full((len(values), len(minutes)), np.nan, np.result_type(values, number))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean[:, full] = total / number[full]
    dim = frames.dims[0]
    return xr.DataArray(
        mean,
        dims=(dim, "time"),
        coords={dim: frames[dim].values, "time": from_posix(minutes)},
        attrs=frames.attrs,
    )


def followed_by(held: xr.DataArray | None, new: xr.DataArray) -> xr.DataArray:
    """Frames (…, time) and those that come after them, in one."""
    if held is None or not held.sizes["time"]:
        return new
    dim = new.dims[0]
    coords = {dim: new[dim].values, "time": np.concatenate([held["time"].values, new["time"].values])}
    values = np.concatenate([held.values, new.values], axis=1)
    return xr.DataArray(values, dims=new.dims, coords=coords, name=new.name, attrs=new.attrs)
