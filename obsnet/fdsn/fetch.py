"""A station's waveforms and metadata out of an FDSN data centre, into a folder that a run can read."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import obspy
from obspy import UTCDateTime

from obsnet.errors import ConfigError
from obsnet.fdsn.data_centre import DataCentre, Retry, read_stationxml
from obsnet.fdsn.sds import Archive, Day

DEFAULT_URL = "https://service.earthscope.org"
CHANNELS = ("BH?", "HH?", "EH?", "SH?", "CH?", "BD?", "HD?", "ED?", "SD?", "CD?")
DAY_S = 86400.0


@dataclass
class FetchReport:
    """What `fetch` did: channel-days fetched, there before, and without data at the data centre."""

    station: str
    folder: Path
    channels: list[str] = field(default_factory=list)
    fetched: int = 0
    present: int = 0
    missing: list[str] = field(default_factory=list)
    bytes: int = 0

    def __str__(self) -> str:
        text = (
            f"{self.station} ({', '.join(self.channels)}): {self.fetched} channel-days fetched "
            f"({self.bytes / 1e6:.1f} MB), {self.present} there before"
        )
        if self.missing:
            text += f", {len(self.missing)} without data at the data centre"
        return f"{text}; in {self.folder}"


def fetch(
    network_station: str,
    starttime: Any,
    endtime: Any,
    out: str | Path,
    *,
    base_url: str | None = None,
    channels: str | tuple[str, ...] = CHANNELS,
    location: str = "*",
    retry: Retry = Retry(),
    timeout_s: float = 120.0,
    progress: Callable[[float, float], None] | None = None,
) -> FetchReport:
    """Fetch a station's StationXML (with responses) and waveforms.

    Parameters
    ----------
    network_station : str
        ``NET.STA``.
    starttime, endtime : anything UTCDateTime takes
    out : path
        Folder: ``station.xml``, ``fetch.json`` (the manifest) and an SDS archive. Run again, it fetches
        what is not there, what was incomplete, and days that had ended less than a day before they were
        asked for. Other stations, channels and epochs that ``station.xml`` describes stay in it.
    base_url : str, optional
        Data centre, by obspy's name (``RESIF``) or address; EarthScope by default.
    channels : str or tuple of str
        Channel codes with wildcards; a string is split at commas.
    location : str
        Location codes, ``*`` for any and ``--`` for the blank one.
    retry : Retry
        For requests that fail in a way that may pass.
    progress : called with channel-days done and in all.

    Returns
    -------
    FetchReport
        A day without data is reported, not an error.

    Raises
    ------
    ConfigError
        The station's name or the times are not usable.
    SourceError
        The data centre cannot be reached, does not know the station or the channels, or keeps failing.
    OutputError
        The folder cannot be written.
    """
    network, station = _split(network_station)
    start, end = _span(starttime, endtime)
    patterns = tuple(channels.split(",")) if isinstance(channels, str) else tuple(channels)
    source = DataCentre(base_url or DEFAULT_URL, retry, timeout_s)
    archive = Archive(Path(out))
    text = source.station_xml(network, station, location, ",".join(p.strip() for p in patterns), start, end)
    archive.write("station.xml", _joined(text, archive.folder / "station.xml", source.url))
    days = list(_days(read_stationxml(text, source.url), network, station, start, end))
    report = FetchReport(network_station, archive.folder, list(dict.fromkeys(day.channel for day in days)))
    for done, day in enumerate(days):
        if progress is not None:
            progress(done, len(days))
        wanted = archive.lacking(day)
        if wanted is None:
            report.present += 1
        else:
            size = archive.store(wanted, source.waveforms(wanted), source.url)
            report.fetched += size > 0
            report.bytes += size
        if archive.is_empty(day):
            report.missing.append(day.name)
    if progress is not None:
        progress(len(days), len(days))
    return report


def _joined(text: bytes, path: Path, url: str) -> bytes:
    """Metadata with those of the stations, channels and epochs that an earlier `fetch` into the folder has described."""
    if not path.is_file():
        return text
    whole, before = read_stationxml(text, url), read_stationxml(path.read_bytes(), str(path))
    known = set(_epochs(whole))
    for network in before:
        for station in network:
            station.channels = [c for c in station if _key(network, station, c) not in known]
        network.stations = [station for station in network if station.channels]
    whole.networks += [network for network in before if network.stations]
    if set(_epochs(whole)) == known:
        return text
    joined = io.BytesIO()
    whole.write(joined, format="STATIONXML")
    return joined.getvalue()


def _epochs(inventory: obspy.Inventory) -> Iterator[tuple[str, ...]]:
    for network in inventory:
        for station in network:
            for channel in station:
                yield _key(network, station, channel)


def _key(network: Any, station: Any, channel: Any) -> tuple[str, ...]:
    return network.code, station.code, channel.location_code, channel.code, str(channel.start_date)


def _split(network_station: str) -> tuple[str, str]:
    parts = network_station.split(".")
    if len(parts) != 2 or not all(part.isalnum() for part in parts):
        raise ConfigError(f"a station is given as NET.STA (YV.RR03), found '{network_station}'")
    return parts[0], parts[1]


def _span(starttime: Any, endtime: Any) -> tuple[UTCDateTime, UTCDateTime]:
    times = []
    for name, value in (("start", starttime), ("end", endtime)):
        try:
            times.append(UTCDateTime(str(value)))
        except (TypeError, ValueError):
            raise ConfigError(f"the {name} must be an ISO 8601 time in UTC, found '{value}'") from None
    if times[0] >= times[1]:
        raise ConfigError(f"the start {times[0]} must be before the end {times[1]}")
    return times[0], times[1]


def _days(
    inventory: obspy.Inventory, network: str, station: str, start: UTCDateTime, end: UTCDateTime
) -> Iterator[Day]:
    """Days of each channel that the metadata say was running, in order of time."""
    running: dict[tuple[str, str], list[tuple[UTCDateTime, UTCDateTime]]] = {}
    for channel in (channel for net in inventory for sta in net for channel in sta):
        epoch = (channel.start_date or start, channel.end_date or end)
        running.setdefault((channel.location_code, channel.code), []).append(epoch)
    day = UTCDateTime(start.year, start.month, start.day)
    while day < end:
        begin, stop = max(day, start), min(day + DAY_S - 1e-6, end)
        for (location, channel), epochs in sorted(running.items()):
            if any(first < stop and last > begin for first, last in epochs):
                yield Day(network, station, location, channel, begin, stop)
        day += DAY_S
