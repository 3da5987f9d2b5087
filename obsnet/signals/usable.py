"""A record whose frames were made in; out, the hydrophone that never worked, and why nothing could be heard."""

from __future__ import annotations

from obsnet.layout import iso
from obsnet.signals.waveforms import WaveformSource

_SECOND = 1_000_000_000


def mute_hydrophone(source: WaveformSource) -> str | None:
    """SEED id of a hydrophone with waveforms and not one usable frame, beside horizontals that work; else None."""
    heard = source.station.at(seed_ids=source.timelines.keys())
    frames = {seed_id: channel.usable_frames for seed_id, channel in source.report.channels.items()}
    others_work = len(heard.horizontals) > 1 and all(frames[channel.seed_id] for channel in heard.horizontals)
    if heard.pressure is None or frames[heard.pressure.seed_id] or not others_work:
        return None
    return heard.pressure.seed_id


def nothing_heard(source: WaveformSource, minutes: int, least_s: float) -> str:
    """Why no minute of a record has usable data, and what would serve.

    Parameters
    ----------
    source : WaveformSource
    minutes : int
        Minutes of the record, without data as they are; none where it is too short.
    least_s : float
        Length [s] of a record that holds a minute wherever it begins.
    """
    begin, end = source.begin_ns, source.end_ns
    said = f"no minute of {source.station.code} from {iso(begin / _SECOND)} to {iso(end / _SECOND)}"
    if not minutes:
        length_s = (min(end, source.data_end_ns) - max(begin, source.data_begin_ns)) / _SECOND
        return f"{said}: {length_s:g} s of waveforms are too short; give at least {least_s:.0f} s"
    why = [
        f"{seed_id}: {source.timelines[seed_id].missing_s(begin, end):g} s of gaps, "
        f"{channel.dead_frames} dead and {channel.clipped_frames} clipped frames"
        for seed_id, channel in source.report.channels.items()
    ]
    return (
        f"{said} has usable data ({'; '.join([*why, *source.report.notes])}); give at least {least_s:.0f} s of "
        "working channels, and leave out of the StationXML what never works"
    )
