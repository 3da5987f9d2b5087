"""What `obsnet bench station` feeds and says; its numbers are the machine's, and no test."""

from itertools import pairwise

from obsnet.live.bench import StationCost, _minutes
from obsnet.live.config import LiveConfig
from obsnet.live.packets import RecordStream
from obsnet.sample import sample_folder
from obsnet.signals.station import Station


def test_minutes_of_the_passage_hold_every_sample_once_in_order():
    station = Station.from_stationxml(sample_folder() / "station.xml")
    whole = sum(
        len(p.samples) for p in RecordStream().push((sample_folder() / "waveforms.mseed").read_bytes())
    )
    minutes = list(_minutes(station, LiveConfig()))
    ends = [max(p.end_ns for p in packets) for packets in minutes]
    assert ends == sorted(ends)
    assert sum(b - a < 121e9 for a, b in pairwise(ends)) > 0.95 * len(ends)
    starts = [(p.seed_id, p.start_ns) for packets in minutes for p in packets]
    assert len(starts) == len(set(starts))
    held = sum(len(p.samples) for packets in minutes for p in packets)
    assert whole - 4 * 50 * 700 < held <= whole


def test_the_table_says_each_number_beside_its_bar():
    cost = StationCost("analytic", 100, 52.4, 77.0, 240.0, 300.0, 2.5, 2.1, 2.6)
    assert "52.4 ms" in cost.table()
    assert "bar 250 MB" in cost.table()
    assert cost.to_json()["bars"]["ms_per_minute"] == 100.0
