"""The arrays that cross a boundary: their dims, variables and dtype, checked in one place.

Times inside arrays are `datetime64[ns]` UTC; `UTCDateTime` stays in `obsnet.signals`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from obsnet.errors import LayoutError

_ISO_8601 = re.compile(
    r"(?P<year>\d{4})(-?(?P<ordinal>\d{3})|(?P<dash>-?)(?P<month>\d\d)((?P=dash)(?P<day>\d\d))?)?"
    r"(?P<clock>[T ](?P<hour>\d\d)((?P<colon>:?)(?P<minute>\d\d)((?P=colon)(?P<second>\d\d(\.\d+)?))?)?)?"
    r"(\s*[Zz]|(?P<sign>[+-])(?P<hours>\d\d):?(?P<minutes>\d\d))?"
)


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


def parse_utc(text: str) -> int:
    """Nanoseconds since 1970-01-01 UTC of ISO 8601 text; without an offset the time is UTC.

    Raises
    ------
    ValueError
        The text is no ISO 8601 time, or lies outside the years 1678 to 2261, which ns since 1970 can hold.

    >>> parse_utc("1970-01-01T00:00:10.24Z") == parse_utc("1970-01-01T02:00:10.24+02:00")
    True
    """
    parts = _ISO_8601.fullmatch(text.strip())
    whole_day = parts and (parts["ordinal"] or parts["day"])
    if (
        parts is None
        or not 1678 <= int(parts["year"]) <= 2261
        or (parts["clock"] and not whole_day)
        or (parts["sign"] and not parts["clock"])
        or (parts["month"] and not parts["day"] and not parts["dash"])
    ):
        raise ValueError(f"{text!r} is no ISO 8601 time of the years 1678 to 2261")
    time = f"{parts['hour'] or '00'}:{parts['minute'] or '00'}:{parts['second'] or '00'}"
    ends = re.fullmatch(r"24:00:00(\.0+)?", time) is not None
    since_midnight = np.datetime64(f"1970-01-01T{'00:00:00' if ends else time}", "ns") - np.datetime64(
        0, "ns"
    )
    hours, minutes = int(parts["hours"] or 0), int(parts["minutes"] or 0)
    offset_s = (-1 if parts["sign"] == "-" else 1) * (3600 * hours + 60 * minutes) - 86400 * ends
    midnight = _day(parts).astype("datetime64[ns]")
    return int((midnight + since_midnight).astype(np.int64)) - offset_s * 1_000_000_000


def _day(parts: re.Match[str]) -> np.datetime64:
    """Date of the parts of a time; `ValueError` where the year has no such day."""
    if parts["ordinal"] is None:
        return np.datetime64(f"{parts['year']}-{parts['month'] or '01'}-{parts['day'] or '01'}", "D")
    day = np.datetime64(f"{parts['year']}-01-01", "D") + int(parts["ordinal"]) - 1
    if str(day)[:4] != parts["year"]:
        raise ValueError(f"{parts['year']} has no day {parts['ordinal']}")
    return day


def iso(time: np.datetime64 | float, milliseconds: bool = False) -> str:
    """ISO 8601 UTC text ending in Z, to the second; to the millisecond where that matters, or always.

    Readers of whole columns take the format of the first time for that of all.

    >>> iso(np.datetime64("2013-05-21T10:00:00")), iso(0.0, milliseconds=True)
    ('2013-05-21T10:00:00Z', '1970-01-01T00:00:00.000Z')
    """
    stamp = from_posix(time) if isinstance(time, (int, float)) else np.asarray(time)
    text = str(np.datetime_as_string(stamp.astype("datetime64[ms]")))
    return (text if milliseconds else text.removesuffix(".000")) + "Z"
