"""What a station's memory depends on: where any of it has changed, the memory is not gone on with."""

import copy
from dataclasses import replace

import pytest

from obsnet.live.station import LiveStation
from obsnet.ocean.amplitudes import Amplitudes


def changed(station, what):
    """Station and what a calibration may change, one of them changed."""
    amplitudes = Amplitudes.broad().scaled_to(station.depth_m)
    if what in ("orientation", "polarity"):
        value = {"orientation": {"orientation_deg": 200.0}, "polarity": {"hydrophone_polarity": -1}}[what]
        return station.calibrated(**value), None
    if what == "amplitudes":
        return station, amplitudes
    if what == "epoch":
        epochs = tuple(replace(c, endtime=4e9) for c in station.epochs)
    else:
        epochs = tuple(replace(c, response=copy.deepcopy(c.response)) for c in station.epochs)
        epochs[0].response.response_stages[0].stage_gain *= 2.0
    chosen = {c.seed_id: c for c in epochs}
    return replace(station, epochs=epochs, channels=tuple(chosen[c.seed_id] for c in station.channels)), None


@pytest.mark.parametrize("what", ["orientation", "polarity", "amplitudes", "epoch", "response", "table"])
def test_what_a_calibration_changes_begins_a_new_record(station, small, table, tmp_path, what):
    def fingerprint(station, amplitudes, table):
        live = LiveStation(station, small, tmp_path, amplitudes, table)
        live.close()
        return live.fingerprint

    other, amplitudes = (station, None) if what == "table" else changed(station, what)
    shifted_table = table.assign(delay=table["delay"] + 0.01) if what == "table" else table
    before = fingerprint(station, None, table)
    assert fingerprint(station, None, table.copy(deep=True)) == before
    assert fingerprint(other, amplitudes, shifted_table) != before
