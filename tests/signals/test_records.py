"""miniSEED records: each at its own time, damage that costs only itself, and only the bytes asked for."""

import io

import numpy as np
import obspy
import pytest

from obsnet.signals.records import RecordReader, scan

from .conftest import START, trace


def write(path, *traces, **options):
    obspy.Stream(list(traces)).write(str(path), "MSEED", **options)
    return path


def record_by_record(data, times, *, rate=50.0, **options):
    """One miniSEED record for each chunk, at the time given for it."""
    out = io.BytesIO()
    for chunk, time in zip(data, times, strict=True):
        obspy.Stream([trace(chunk, rate=rate, start=time)]).write(out, "MSEED", reclen=512, **options)
    return out.getvalue()


def only(reader, path):
    (pair,) = reader.pieces(path)[0]
    return pair[1]


@pytest.mark.parametrize("encoding", ["INT16", "INT32", "STEIM1", "STEIM2", "FLOAT32", "FLOAT64"])
@pytest.mark.parametrize(("reclen", "byteorder"), [(512, ">"), (4096, "<")])
def test_pieces_are_what_obspy_reads(tmp_path, encoding, reclen, byteorder):
    kind = {"INT16": np.int16, "FLOAT32": np.float32, "FLOAT64": np.float64}.get(encoding, np.int32)
    data = np.random.default_rng(1).integers(-3000, 3000, 20000).astype(kind)
    start = obspy.UTCDateTime(2016, 2, 29, 23, 59, 58, 123457)
    path = write(
        tmp_path / "a.mseed", trace(data, start=start), encoding=encoding, reclen=reclen, byteorder=byteorder
    )
    reader = RecordReader()
    ((seed_id, piece),), file = reader.pieces(path)
    assert seed_id == "YV.RR03.00.BDH"
    assert (piece.start_ns, piece.count, piece.rate) == (start.ns, data.size, 50.0)
    assert file.broken == 0
    np.testing.assert_array_equal(piece.read(0, data.size), data)
    np.testing.assert_array_equal(piece.read(7001, 13003), data[7001:13003])
    assert piece.read(0, 10).dtype == (np.int32 if kind is np.int16 else kind)  # obspy widens 16 bits


@pytest.mark.parametrize("rate", [62.5, 100.0, 49.9987, 0.1, 31.25, 1e3])
def test_rates_are_read_from_header_or_blockette_100(tmp_path, rate):
    path = write(tmp_path / "a.mseed", trace(np.arange(3000, dtype=np.int32), rate=rate))
    assert only(RecordReader(), path).rate == pytest.approx(rate, rel=1e-7)


def test_records_that_drift_keep_their_own_time(tmp_path):
    # the clock runs 1e-4 fast: each record joins the one before within 0.01 sample, and the last is ten
    # samples early; obspy joins them all at the nominal rate
    true_rate, chunk, records = 50.005, 100, 1000
    times = [START + n * chunk / true_rate for n in range(records)]
    data = np.arange(records * chunk, dtype=np.int32).reshape(records, chunk)
    path = tmp_path / "drift.mseed"
    path.write_bytes(record_by_record(data, times))
    assert len(obspy.read(str(path))) == 1
    piece = only(RecordReader(), path)
    late = (piece.count - 1) / true_rate
    assert float(piece.seconds(piece.count - 1)) == pytest.approx(late, abs=1e-4)
    assert abs(late - (piece.count - 1) / 50.0) > 0.19
    assert piece.rate == pytest.approx(true_rate, rel=1e-6)


def test_a_clock_that_no_single_rate_describes_is_followed_record_by_record(tmp_path):
    chunk, records = 100, 600
    n = np.arange(records)
    true = n * 2.0 + 0.05 * np.sin(n / 60)  # s after the start: wanders by 2.5 samples, 0.04 sample a record
    path = tmp_path / "wander.mseed"
    path.write_bytes(
        record_by_record(np.zeros((records, chunk), np.int32), [START + float(t) for t in true - true[0]])
    )
    piece = only(RecordReader(), path)
    np.testing.assert_allclose(piece.seconds(n * chunk), true - true[0], atol=1e-4)
    index = piece.index(START.ns + np.rint((true - true[0]) * 1e9).astype(np.int64))
    np.testing.assert_allclose(index, n * chunk, atol=5e-3)


def test_order_and_repeats_do_not_matter(tmp_path):
    data = np.random.default_rng(2).integers(-99, 99, (40, 300)).astype(np.int32)
    times = [START + 6.0 * n for n in range(40)]
    raw = record_by_record(data, times)
    records = [raw[n * 512 : (n + 1) * 512] for n in range(40)]
    order = np.random.default_rng(3).permutation(40)
    path = tmp_path / "shuffled.mseed"
    path.write_bytes(b"".join(records[n] for n in order) + records[5] + records[6])
    reader = RecordReader()
    ((_, piece),), file = reader.pieces(path)
    assert file.channels[0].repeats == 2
    assert piece.start_ns == START.ns
    np.testing.assert_array_equal(piece.read(0, piece.count), data.ravel())


def test_gaps_split_pieces_and_half_a_sample_does_not(tmp_path):
    data = np.zeros((4, 100), np.int32)
    times = [START, START + 2.0 + 0.009, START + 4.0 + 0.009, START + 6.0 + 0.009 + 0.011]
    path = tmp_path / "gap.mseed"
    path.write_bytes(record_by_record(data, times))
    pieces, _ = RecordReader().pieces(path)
    assert [piece.count for _, piece in pieces] == [300, 100]


def test_channels_of_one_file_come_apart(tmp_path):
    a, b = np.arange(5000, dtype=np.int32), -np.arange(5000, dtype=np.int32)
    one = write(tmp_path / "a", trace(a), encoding="INT32", reclen=512).read_bytes()
    other = write(tmp_path / "b", trace(b, "BHZ"), encoding="INT32", reclen=512).read_bytes()
    path = tmp_path / "interleaved.mseed"
    cut = [(one[n : n + 512], other[n : n + 512]) for n in range(0, len(one), 512)]
    path.write_bytes(b"".join(part for pair in cut for part in pair))
    pieces = dict(RecordReader().pieces(path)[0])
    np.testing.assert_array_equal(pieces["YV.RR03.00.BDH"].read(100, 4000), a[100:4000])
    np.testing.assert_array_equal(pieces["YV.RR03.00.BHZ"].read(100, 4000), b[100:4000])


def test_a_cut_tail_and_broken_headers_cost_only_themselves(tmp_path):
    data = np.random.default_rng(4).integers(-99, 99, (50, 300)).astype(np.int32)
    raw = bytearray(record_by_record(data, [START + 6.0 * n for n in range(50)]))
    raw[20 * 512 : 20 * 512 + 64] = bytes(64)
    path = tmp_path / "damaged.mseed"
    path.write_bytes(bytes(raw[: 48 * 512 + 100]))
    pieces, file = RecordReader().pieces(path)
    assert file.broken == 2
    assert [piece.count for _, piece in pieces] == [20 * 300, 27 * 300]
    np.testing.assert_array_equal(pieces[1][1].read(0, 27 * 300), data[21:48].ravel())


def test_a_record_whose_samples_are_damaged_is_nan_and_the_others_are_read(tmp_path):
    data = np.random.default_rng(5).integers(-99, 99, (16, 300)).astype(np.int32)
    raw = bytearray(record_by_record(data, [START + 6.0 * n for n in range(16)], encoding="STEIM2"))
    raw[7 * 512 + 64 : 8 * 512] = bytes(np.random.default_rng(6).integers(0, 256, 448, np.uint8))
    path = tmp_path / "damaged.mseed"
    path.write_bytes(bytes(raw))
    said = []
    got = only(RecordReader(said.append), path).read(0, 16 * 300).reshape(16, 300)
    assert said == ["damaged.mseed: some records do not decode; their samples are missing"]
    assert np.isnan(got[7]).all()
    keep = np.arange(16) != 7
    np.testing.assert_array_equal(got[keep], data[keep])


def test_only_the_records_asked_for_are_read(tmp_path, monkeypatch):
    data = np.random.default_rng(7).integers(-9999, 9999, 200_000).astype(np.int32)
    path = write(tmp_path / "long.mseed", trace(data), encoding="INT32", reclen=512)
    piece = only(RecordReader(), path)
    asked = []
    original = obspy.read
    monkeypatch.setattr(
        obspy, "read", lambda buffer, **k: asked.append(len(buffer.getvalue())) or original(buffer, **k)
    )
    np.testing.assert_array_equal(piece.read(150_000, 150_500), data[150_000:150_500])
    assert sum(asked) <= 7 * 512


@pytest.mark.parametrize("content", [b"", b"000001D ", b"nonsense " * 200, bytes(4096)])
def test_what_is_no_miniseed_is_left_to_others(tmp_path, content):
    path = tmp_path / "x"
    path.write_bytes(content)
    assert scan(path) is None
