"""Waveforms from anywhere give the same samples, and bad ones say what they are."""

import gzip
import pickle
from pathlib import Path

import numpy as np
import obspy
import pytest

from obsnet.errors import WaveformError
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms, to_ns

from .conftest import START, channel, deployments, inventory, standard, trace

STATION = Station.from_stationxml(inventory(standard()))
BDH = "YV.RR03.00.BDH"


def noise(count, seed=0):
    return np.random.default_rng(seed).integers(-5000, 5000, count).astype(np.int32)


def samples(source, seed_id=BDH):
    return [(run.begin_ns, run.read(0, run.length)) for run in source.timelines[seed_id].runs]


def same(source, expected, seed_id=BDH):
    got = samples(source, seed_id)
    assert len(got) == len(expected)
    for (begin, data), (start, wanted) in zip(got, expected, strict=True):
        assert abs(begin - start.ns) < 1_000_000
        np.testing.assert_array_equal(data, wanted)


def sds(root, data, start, code="BDH", rate=50.0, location="00"):
    """Write an SDS archive: one file a day, records cut at midnight."""
    whole = trace(data, code, rate=rate, start=start, location=location)
    day = obspy.UTCDateTime(start.year, start.month, start.day)
    while day < whole.stats.endtime:
        part = whole.slice(day, day + 86400 - 0.5 / rate)
        folder = root / str(day.year) / "YV" / "RR03" / f"{code}.D"
        folder.mkdir(parents=True, exist_ok=True)
        part.write(str(folder / f"YV.RR03.{location}.{code}.D.{day.year}.{day.julday:03d}"), "MSEED")
        day += 86400


def test_what_was_opened_for_a_span_keeps_it_when_it_is_opened_again():
    first = open_waveforms(trace(noise(60_000)), STATION, starttime=START + 200, endtime=START + 600)
    again = open_waveforms(first, STATION)
    assert (again.begin_ns, again.end_ns) == (first.begin_ns, first.end_ns)
    later = open_waveforms(first, STATION, starttime=START + 300)
    assert (later.begin_ns, later.end_ns) == ((START + 300).ns, first.end_ns)


@pytest.mark.parametrize("form", ["MSEED", "SAC", "GSE2", "SLIST", "TSPAIR", "SH_ASC"])
def test_any_format_that_obspy_reads(tmp_path, form):
    data = noise(3000)
    written = trace(data.astype(np.float32) if form == "SAC" else data)
    if form == "GSE2":
        written.stats.location = ""
    path = tmp_path / "record"
    written.write(str(path), form)
    source = open_waveforms(path, STATION)
    same(source, [(START, data)])
    assert source.report.files == 1
    assert not source.report.ignored


def test_compressed_files_are_read(tmp_path):
    data = noise(3000)
    trace(data).write(str(tmp_path / "a.mseed"), "MSEED")
    (tmp_path / "a.mseed.gz").write_bytes(gzip.compress((tmp_path / "a.mseed").read_bytes()))
    same(open_waveforms(tmp_path / "a.mseed.gz", STATION), [(START, data)])


def test_files_folders_wildcards_and_streams_are_one(tmp_path):
    data = noise(9000)
    parts = [trace(data[n : n + 3000], start=START + n / 50) for n in (0, 3000, 6000)]
    (tmp_path / "deep" / "er").mkdir(parents=True)
    names = [tmp_path / "b.mseed", tmp_path / "deep" / "a.mseed", tmp_path / "deep" / "er" / "c"]
    for name, part in zip(names, parts, strict=True):
        part.write(str(name), "MSEED")
    wanted = [(START, data)]
    same(open_waveforms(tmp_path, STATION), wanted)
    same(open_waveforms(names[::-1], STATION), wanted)
    same(open_waveforms([str(name) for name in names] * 2, STATION), wanted)
    same(open_waveforms(f"{tmp_path}/**/*", STATION), wanted)
    same(open_waveforms(obspy.Stream(parts[::-1]), STATION), wanted)


@pytest.mark.parametrize(
    "start",
    [
        obspy.UTCDateTime(2012, 12, 31, 23),
        obspy.UTCDateTime(2016, 2, 28, 23),
        obspy.UTCDateTime(2016, 2, 29, 23),
    ],
)
def test_an_sds_archive_is_read_across_days_years_and_leap_days(tmp_path, start):
    data = noise(26 * 3600 * 50)
    sds(tmp_path, data, start)
    source = open_waveforms(tmp_path, STATION)
    assert source.report.files == 3
    same(source, [(start, data)])


def test_of_an_archive_only_the_station_and_the_days_are_opened(tmp_path):
    data = noise(50 * 3600)
    for day in range(1, 20):
        sds(tmp_path, data, obspy.UTCDateTime(2013, 1, day, 12))
    other = tmp_path / "2013" / "YV" / "RR04" / "BDH.D"
    other.mkdir(parents=True)
    (other / "YV.RR04.00.BDH.D.2013.001").write_bytes(b"never opened")
    source = open_waveforms(
        tmp_path, STATION, starttime="2013-01-05T00:00:00Z", endtime=np.datetime64("2013-01-07T00:00:00")
    )
    assert source.report.files == 4  # a day on each side, for records that spill over midnight
    assert not source.report.ignored
    assert source.begin_ns == obspy.UTCDateTime(2013, 1, 5).ns


def test_an_archive_of_other_stations_says_which(tmp_path):
    sds(tmp_path, noise(5000), START)
    other = Station.from_stationxml(inventory(standard(), code="RR99"))
    with pytest.raises(WaveformError, match=r"holds no waveforms of YV\.RR99; it has YV\.RR03"):
        open_waveforms(tmp_path, other)


def test_gaps_overlaps_and_half_sample_steps():
    data = noise(12000)
    late = START + 0.008
    stream = obspy.Stream([
        trace(data[:4000]),
        trace(data[3000:6000], start=START + 60),  # repeats 1000 samples
        trace(data[6000:8000], start=late + 120),  # 0.4 sample late: still the same run
        trace(data[9000:], start=START + 180),  # 20 s missing
    ])  # fmt: skip
    source = open_waveforms(stream, STATION)
    same(source, [(START, data[:8000]), (START + 180, data[9000:])])
    report = source.report.channels[BDH]
    assert (report.gaps, report.overlaps, report.conflicting_overlaps) == (1, 1, 0)
    assert report.gap_s == pytest.approx(20.0, abs=0.02)


def test_of_conflicting_samples_the_first_are_kept_and_it_is_said():
    first, second = noise(4000), noise(4000, seed=1)
    source = open_waveforms(obspy.Stream([trace(second, start=START + 40), trace(first)]), STATION)
    same(source, [(START, np.concatenate([first, second[2000:]]))])
    assert source.report.channels[BDH].conflicting_overlaps == 1


def test_duplicates_and_contained_pieces_vanish():
    data = noise(4000)
    stream = obspy.Stream([trace(data), trace(data), trace(data[500:900], start=START + 10)])
    same(open_waveforms(stream, STATION), [(START, data)])


def test_a_masked_stream_has_gaps():
    data = np.ma.masked_array(noise(4000), mask=np.zeros(4000, bool))
    data[1000:1500] = np.ma.masked
    kept = np.ma.getdata(data)
    masked = obspy.Trace(data, trace(np.zeros(4000)).stats)
    same(open_waveforms(masked, STATION), [(START, kept[:1000]), (START + 30, kept[1500:])])


def test_times_are_those_of_the_samples():
    stream = obspy.Stream([trace(noise(4000)), trace(noise(4000), start=START + 80.003)])
    (run,) = open_waveforms(stream, STATION).timelines[BDH].runs
    times = START.ns + np.array([0, 1_000_000_000, 79_984_000_000, 80_003_000_000, 81_009_000_000])
    position = run.nearest(times)
    np.testing.assert_array_equal(position, [0, 50, 3999, 4000, 4050])
    np.testing.assert_allclose(run.delay(position, times), [0, 0, -0.004, 0, -0.006], atol=1e-9)


def test_what_is_left_aside_is_reported(tmp_path):
    trace(noise(3000)).write(str(tmp_path / "good.mseed"), "MSEED")
    trace(noise(3000), "BHZ", rate=20.0).write(str(tmp_path / "slow.mseed"), "MSEED")
    trace(noise(3000), station="RR99").write(str(tmp_path / "foreign.mseed"), "MSEED")
    (tmp_path / "empty.mseed").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("deployed in 2012\n")
    (tmp_path / ".hidden").write_bytes(b"x")
    (tmp_path / "station.xml").write_text("<xml/>")
    report = open_waveforms(tmp_path, STATION).report
    assert list(report.channels) == [BDH]
    ignored = {Path(path).name: reason for path, reason in report.ignored.items()}
    assert ignored == {"empty.mseed": "empty", "notes.txt": "no format that obspy reads"}
    assert report.left_aside == {
        "YV.RR03.00.BHZ": "sampled at 20 Hz, below the 50 Hz needed",
        "YV.RR99.00.BDH": "not described for YV.RR03",
    }
    assert report.to_dict()["channels"][BDH]["sampling_rate"] == 50.0


def test_a_location_code_or_network_code_that_differs_is_forgiven_and_said():
    source = open_waveforms(trace(noise(3000), location="", network=""), STATION)
    assert list(source.timelines) == [BDH]
    assert ".RR03..BDH taken for YV.RR03.00.BDH" in source.report.notes
    two = Station.from_stationxml(inventory([*standard(), channel("BDH", location="01")]))
    with pytest.raises(WaveformError, match="not described"):
        open_waveforms(trace(noise(3000), location="07"), two)


@pytest.mark.parametrize("foreign", [{"location": ""}, {"location": "10"}, {"network": ""}])
@pytest.mark.parametrize("late", [-3600.0, 0.0, 3600.0])
def test_beside_the_described_channel_no_other_is_taken_for_it(foreign, late):
    """Whichever begins first, lies first in the file or fills the other's silence."""
    data, other = noise(3000), trace(noise(400_000, seed=1), start=START + late, **foreign)
    for stream in ([trace(data), other], [other, trace(data)]):
        source = open_waveforms(obspy.Stream(stream), STATION)
        same(source, [(START, data)])
        assert source.report.left_aside == {other.id: "not described for YV.RR03"}
        assert not source.report.notes


def test_of_several_that_could_stand_for_a_channel_one_does():
    data = noise(3000)
    other = trace(noise(9000, seed=1), start=START - 60, location="20")
    source = open_waveforms(obspy.Stream([other, trace(data, location="10")]), STATION)
    same(source, [(START, data)])
    assert source.report.left_aside == {"YV.RR03.20.BDH": "not described for YV.RR03"}
    assert source.report.notes == ["YV.RR03.10.BDH taken for YV.RR03.00.BDH"]


@pytest.mark.parametrize("form", ["MSEED", "SAC"])
def test_a_file_that_vanishes_is_a_gap(tmp_path, form):
    path = tmp_path / "record"
    trace(noise(3000).astype(np.float32)).write(str(path), form)
    source = open_waveforms(path, STATION)
    path.unlink()
    ((_, data),) = samples(source)
    assert data.size == 3000
    assert np.isnan(data).all()
    assert len(source.report.notes) == 1
    assert "record: " in source.report.notes[0]


def test_impossible_dates_are_left_aside():
    item = trace(noise(3000))
    item.stats.starttime = obspy.UTCDateTime(2250, 1, 1)
    report = open_waveforms(obspy.Stream([item, trace(noise(3000), "BHZ")]), STATION).report
    assert report.left_aside == {BDH: "dated outside 1900 to 2200"}


class Trap:
    """Leaves a mark when unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("unpickled"),))


def test_pickles_are_never_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stream.pickle").write_bytes(pickle.dumps(["obspy.core.stream", Trap()], protocol=0))
    with pytest.raises(WaveformError, match=r"stream\.pickle: no format that obspy reads"):
        open_waveforms(tmp_path / "stream.pickle", STATION)
    assert not (tmp_path / "unpickled").exists()


def bad(tmp_path, name):
    path = tmp_path / "x.mseed"
    full = tmp_path / "full"
    trace(noise(30000)).write(str(full), "MSEED", reclen=4096)
    content = {
        "empty": b"",
        "random": bytes(np.random.default_rng(0).integers(0, 256, 20000, np.uint8)),
        "zeros": bytes(10000),
        "text": b"time,lon,lat\n1,2,3\n" * 50,
        "cut": full.read_bytes()[:1000],
    }[name]
    full.unlink()
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("name", ["empty", "random", "zeros", "text", "cut"])
def test_files_that_hold_no_waveforms_give_one_line(tmp_path, name):
    with pytest.raises(WaveformError, match=r"no usable waveforms of YV\.RR03 in .*x\.mseed") as caught:
        open_waveforms(bad(tmp_path, name), STATION)
    assert "\n" not in str(caught.value)
    assert "wanted YV.RR03.00.BDH" in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: open_waveforms(d / "nothing.mseed", STATION), "there is no file, folder or archive"),
        (lambda d: open_waveforms(d / "*.mseed", STATION), "there is no file, folder or archive"),
        (lambda d: open_waveforms(d, STATION), "found no files"),
        (lambda d: open_waveforms([], STATION), "found no files"),
        (lambda d: open_waveforms(obspy.Stream(), STATION), "no usable waveforms of YV.RR03 in the stream"),
        (
            lambda d: open_waveforms(trace(noise(9), station="A"), STATION),
            r"found YV\.A\.00\.BDH not described",
        ),
        (lambda d: open_waveforms(trace(np.zeros(0)), STATION), "no usable waveforms"),
        (
            lambda d: open_waveforms(trace(noise(9)), STATION, starttime="2014-01-01", endtime="2013-01-01"),
            "start 2014-01-01T00:00:00Z is not before the end 2013-01-01",
        ),
        (
            lambda d: open_waveforms(trace(noise(9)), STATION, starttime="2014-01-01"),
            r"no waveforms from 2014-01-01T00:00:00Z on; they span 2013-05-21T10:00:00Z to",
        ),
        (lambda d: open_waveforms(trace(noise(9)), STATION, starttime="soon"), "cannot read the time 'soon'"),
        (lambda d: open_waveforms(17, STATION), "takes paths or an obspy Stream, found int"),
    ],
)
def test_bad_requests_say_what_was_found(tmp_path, call, message):
    with pytest.raises(WaveformError, match=message):
        call(tmp_path)


def test_times_of_every_kind_are_one():
    expected = START.ns
    for time in (
        START,
        START.datetime,
        "2013-05-21T10:00:00Z",
        np.datetime64("2013-05-21T10:00"),
        START.timestamp,
    ):
        assert to_ns(time) == expected


def test_a_station_lies_where_it_lay_when_its_record_begins():
    station = Station.from_stationxml(deployments())
    early, late = (trace(noise(3000), start=obspy.UTCDateTime(year, 6, 1)) for year in (2012, 2014))
    both = obspy.Stream([early, late])

    def found(stream, **span):
        source = open_waveforms(stream, station, **span)
        return source.station.latitude, source.station.depth_m, source.report.notes

    first, second = (-20.0, 4000.0, []), (-25.0, 2000.0, [])
    assert found(early) == found(both, endtime="2013-01-01") == first
    assert found(late) == found(both, starttime="2013-06-01") == second
    *place, notes = found(both)
    assert place == [-20.0, 4000.0]
    assert notes == [
        "YV.RR03 lies elsewhere from 2014-01-01T00:00:00Z on: where it lay when the record begins is used "
        "throughout; use the parts by themselves (--start, --end)"
    ]
