"""Parameters of a live station: those of a run, and a section ``live`` of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from urllib.parse import urlsplit

from obsnet.errors import ConfigError
from obsnet.pipeline import RunConfig


@dataclass(frozen=True)
class LiveConfig:
    """How a station waits, remembers and speaks.

    Attributes
    ----------
    latency_s : how far behind the newest sample of any channel a packet may be and still be used.
    snapshot_s : spacing of the snapshots of the detectors' memory, s of data; a restart computes anew what came since.
    jump_s, confirm_s : a packet dated further than `jump_s` ahead of all others does not move the station's clock until
        its channel has gone on for `confirm_s`.
    silence_s : without a packet for so long the station says that it hears nothing, and reconnects.
    connect_s : time for a server to answer.
    retry_s, retry_max_s : first and longest wait before connecting, or writing, again; each wait is drawn up to twice
        the one before.
    keepalive_s : spacing of the questions that keep a quiet connection open; 0 for none.
    poll_s : spacing of the looks into a folder.
    selectors : SeedLink selectors, such as BH? BDH; all channels of the StationXML by default.
    memory_h : longest segment that is searched as a whole; its maps stay on disk until it closes.
    strips_h : how long columns of the maps are kept for the page of `obsnet serve`; 0 for none.
    threads : of the grid search.
    nmea : where NMEA sentences go: udp://HOST:PORT or tcp://HOST:PORT (a server there); nowhere by default.
    talker : two letters before TTM and TLL.
    http : HOST:PORT of /healthz and /metrics; none by default.
    """

    latency_s: float = 60.0
    snapshot_s: float = 600.0
    jump_s: float = 600.0
    confirm_s: float = 60.0
    silence_s: float = 300.0
    connect_s: float = 30.0
    retry_s: float = 1.0
    retry_max_s: float = 300.0
    keepalive_s: float = 60.0
    poll_s: float = 5.0
    selectors: str = ""
    memory_h: float = 72.0
    strips_h: float = 168.0
    threads: int = 1
    nmea: str = ""
    talker: str = "RA"
    http: str = ""

    def __post_init__(self) -> None:
        for name in (
            "snapshot_s", "jump_s", "confirm_s", "silence_s", "connect_s", "retry_s", "retry_max_s", "poll_s", "memory_h",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        for name in ("latency_s", "keepalive_s", "strips_h"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, found {getattr(self, name)}")
        if self.threads < 1:
            raise ConfigError(f"threads must be 1 or more, found {self.threads}")
        if not (len(self.talker) == 2 and self.talker.isalpha() and self.talker.isupper()):
            raise ConfigError(f"talker must be two capital letters, found {self.talker!r}")
        if self.nmea:
            address(self.nmea, ("udp", "tcp"), "nmea")
        if self.http:
            address(f"http://{self.http}", ("http",), "http")


@dataclass(frozen=True)
class WatchConfig(RunConfig):
    """`RunConfig` and the section `live`."""

    live: LiveConfig = field(default_factory=LiveConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tracker != "grid":
            raise ConfigError(
                f"a live station follows ships with the Bernoulli filter and closes segments with the grid search; "
                f"tracker must be grid, found {self.tracker!r}"
            )


def address(text: str, schemes: tuple[str, ...], name: str) -> tuple[str, str, int]:
    """Scheme, host and port of an address.

    Raises
    ------
    ConfigError : another scheme, or no host and port.
    """
    try:
        parts = urlsplit(text)
        if parts.scheme in schemes and parts.hostname and parts.port:
            return parts.scheme, parts.hostname, parts.port
    except ValueError:
        pass
    wanted = " or ".join(f"{scheme}://HOST:PORT" for scheme in schemes).replace("http://", "")
    raise ConfigError(f"{name} must be {wanted}, found {text!r}")
