"""The arrays that cross a boundary: their dims, variables and dtype, checked in one place.

Times inside arrays are `datetime64[ns]` UTC; `UTCDateTime` stays in `obsnet.signals`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from obsnet.errors import LayoutError


@dataclass(frozen=True)
class Layout:
    """Name of an array type, its dims in order, and for a Dataset the variables that it must hold."""

    name: str
    dims: tuple[str, ...]
    variables: tuple[str, ...] = ()


SPECTRA = Layout("spectra", ("frequency", "time"))
AZIGRAM = Layout("azigram", ("frequency", "time"))
CEPSTROGRAM = Layout("cepstrogram", ("quefrency", "time"))
PROPAGATION = Layout("propagation", ("path", "range"), ("delay", "pressure", "slowness"))


def require(array: xr.DataArray | xr.Dataset, layout: Layout) -> None:
    """Raise `LayoutError` unless `array` has the layout's dims, coordinates and variables."""
    missing = [name for name in layout.variables if name not in array]
    if missing:
        raise LayoutError(f"{layout.name} lacks {', '.join(missing)}; it holds {', '.join(map(str, array))}")
    found = tuple(str(dim) for dim in array.dims)
    if isinstance(array, xr.Dataset):
        absent = [dim for dim in layout.dims if dim not in found]
        if absent:
            raise LayoutError(f"{layout.name} must have dims {layout.dims}, found {found}")
    elif found != layout.dims:
        raise LayoutError(f"{layout.name} must have dims {layout.dims} in this order, found {found}")
    bare = [dim for dim in layout.dims if dim not in array.coords]
    if bare:
        raise LayoutError(f"{layout.name} has no coordinate along {', '.join(bare)}")


def to_posix(times: np.ndarray | np.datetime64) -> np.ndarray:
    """Seconds since 1970-01-01 UTC (float64) of `datetime64` times.

    >>> float(to_posix(np.datetime64("1970-01-01T00:01:00")))
    60.0
    """
    return (np.asarray(times, "datetime64[ns]").astype("int64")) / 1e9


def from_posix(seconds: npt.ArrayLike) -> np.ndarray:
    """`datetime64[ns]` of seconds since 1970-01-01 UTC.

    >>> from_posix([60.0])
    array(['1970-01-01T00:01:00.000000000'], dtype='datetime64[ns]')
    """
    return np.rint(np.asarray(seconds, float) * 1e9).astype("int64").astype("datetime64[ns]")


def iso(time: np.datetime64 | float) -> str:
    """ISO 8601 UTC text ending in Z, to the second (tenths where they matter).

    >>> iso(np.datetime64("2013-05-21T10:00:00"))
    '2013-05-21T10:00:00Z'
    """
    stamp = from_posix(time) if isinstance(time, (int, float)) else np.asarray(time)
    text = np.datetime_as_string(stamp.astype("datetime64[ms]"))
    return str(text).removesuffix(".000") + "Z"
