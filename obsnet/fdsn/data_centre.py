"""An FDSN data centre: obspy's client, with retries and with errors of one line."""

from __future__ import annotations

import time
from dataclasses import dataclass
from http.client import HTTPException
from io import BytesIO
from typing import Any

import obspy
from obspy import UTCDateTime
from obspy.clients.fdsn import Client
from obspy.clients.fdsn import header as fdsn_errors

import obsnet
from obsnet.console import patiently
from obsnet.errors import ConfigError, SourceError
from obsnet.fdsn.sds import Day
from obsnet.signals.inventory import check_codes

SHORTEST_REQUEST_S = 600.0
SHORTEST_RECORD = 128
"""Bytes; miniSEED records are a power of two times this."""
TRANSIENT = (
    fdsn_errors.FDSNTimeoutException,
    fdsn_errors.FDSNTooManyRequestsException,
    fdsn_errors.FDSNInternalServerException,
    fdsn_errors.FDSNBadGatewayException,
    fdsn_errors.FDSNServiceUnavailableException,
    HTTPException,
    OSError,
    EOFError,
)
RESTRICTED = (fdsn_errors.FDSNUnauthorizedException, fdsn_errors.FDSNForbiddenException)


@dataclass(frozen=True)
class Retry:
    """How often a request is made, and how long to wait after the first failure, s; the wait doubles each
    time.
    """

    attempts: int = 5
    wait_s: float = 2.0
    longest_wait_s: float = 60.0

    def __post_init__(self) -> None:
        if self.attempts < 1 or self.wait_s < 0:
            raise ConfigError(f"retries need at least one attempt and no negative wait, found {self}")


class DataCentre:
    """A data centre: obspy's client, with retries and with errors of one line."""

    def __init__(self, url: str, retry: Retry, timeout_s: float) -> None:
        self._retry = retry
        try:
            self._client = Client(
                url, timeout=timeout_s, user_agent=f"obsnet/{obsnet.__version__}", _discover_services=False
            )
        except (ValueError, fdsn_errors.FDSNException) as error:
            raise SourceError(
                f"{url} is no FDSN data centre: {_line(error)}; give its name or address"
            ) from None
        self.url = self._client.base_url

    def station_xml(
        self, network: str, station: str, location: str, channels: str, start: UTCDateTime, end: UTCDateTime
    ) -> bytes:
        """StationXML with responses, as the data centre sends it."""
        code, span = f"{network}.{station}", f"between {start} and {end}"
        query = {"network": network, "station": station, "starttime": start, "endtime": end}
        text = self._ask(
            "station", code, query | {"channel": channels, "location": location, "level": "response"}
        )
        if not text:
            everything = self._ask("station", code, query | {"level": "channel"})
            if not everything:
                raise SourceError(f"{self.url} knows no station {code} {span}; check its code and the times")
            inventory = read_stationxml(everything, self.url)
            known = sorted({channel.code for net in inventory for sta in net for channel in sta})
            raise SourceError(
                f"{code} has no channel {channels} at location {location} {span}; it has {', '.join(known)}"
            )
        read_stationxml(text, self.url)
        return text

    def waveforms(self, day: Day) -> bytes:
        """MiniSEED records of a day, or nothing; a request that is too large is halved."""
        query = {
            "network": day.network,
            "station": day.station,
            "location": day.location,
            "channel": day.channel,
            "starttime": day.start,
            "endtime": day.end,
        }
        try:
            content = self._ask("dataselect", day.name, query)
        except fdsn_errors.FDSNRequestTooLargeException as error:
            length = day.end - day.start
            if length < SHORTEST_REQUEST_S:
                raise SourceError(
                    f"{self.url} refuses {length:.0f} s of {day.name} as too large: {_line(error)}"
                ) from None
            middle = day.start + length / 2
            halves = (Day(*day.code, day.start, middle - 1e-6), Day(*day.code, middle, day.end))
            return b"".join(self.waveforms(half) for half in halves)
        if content:
            try:
                with patiently():
                    obspy.read(BytesIO(content), format="MSEED", headonly=True)
            except Exception as error:  # obspy raises bare Exception subclasses of many kinds here
                raise SourceError(
                    f"{self.url} answers for {day.name} with no miniSEED: {_line(error)}"
                ) from None
        return content

    def _ask(self, service: str, what: str, query: dict[str, Any]) -> bytes:
        """Answer of a service; empty where it has no data."""
        request = self._client.get_stations if service == "station" else self._client.get_waveforms
        attempt = 0
        while True:
            attempt += 1
            answer = BytesIO()
            try:
                request(**query, filename=answer)
                if service == "dataselect" and len(answer.getvalue()) % SHORTEST_RECORD:
                    raise HTTPException("the answer was cut short")
                return answer.getvalue()
            except fdsn_errors.FDSNNoDataException:
                return b""
            except fdsn_errors.FDSNRequestTooLargeException:
                raise
            except RESTRICTED as error:
                raise SourceError(f"{self.url} does not give {what} to everybody: {_line(error)}") from None
            except (*TRANSIENT, fdsn_errors.FDSNException) as error:
                reason = self._explain(service, what, error)
                if not _may_pass(error, first=service == "station"):
                    raise SourceError(reason) from None
                if attempt >= self._retry.attempts:
                    raise SourceError(
                        f"{reason} ({attempt} attempts); run it again to go on from here"
                    ) from None
                time.sleep(min(self._retry.wait_s * 2.0 ** (attempt - 1), self._retry.longest_wait_s))

    def _explain(self, service: str, what: str, error: BaseException) -> str:
        text = _line(error)
        if "404" in text:
            return f"{self.url} has no FDSN {service} service (404); check the address"
        if "Name or service not known" in text or "getaddrinfo" in text or "name resolution" in text:
            return f"{self.url} is an unknown host; check the address and the network"
        if "refused" in text:
            return f"{self.url} refuses connections; check the address and whether the service runs"
        if isinstance(error, (TimeoutError, fdsn_errors.FDSNTimeoutException)) or "timed out" in text.lower():
            return f"{self.url} did not answer in time about {what}"
        return f"{self.url} failed on {what}: {text}"


def _may_pass(error: BaseException, first: bool) -> bool:
    """Whether a failed request is worth repeating; at first contact an address that is not there is not."""
    text = str(error)
    unreachable = any(words in text for words in ("not known", "getaddrinfo", "name resolution", "refused"))
    if isinstance(error, TRANSIENT):
        return not (first and unreachable)
    return "Unknown Error" in text and not (first and unreachable)


def read_stationxml(text: bytes, url: str) -> obspy.Inventory:
    """Metadata of a data centre's answer; `SourceError` where it is none, `StationError` for codes that are none."""
    try:
        inventory = obspy.read_inventory(BytesIO(text), format="STATIONXML")
    except Exception as error:  # obspy and lxml raise many kinds here, some of them bare
        raise SourceError(f"{url} answers with no StationXML: {_line(error)}") from None
    check_codes(inventory, url)
    return inventory


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
