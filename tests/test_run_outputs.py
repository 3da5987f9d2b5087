"""What a run's folder holds: the columns, times and values that scripts depend on."""

import copy
import json
import re
from shutil import copyfile

import numpy as np
import obspy
import pandas as pd
import pytest
import xarray as xr
from pyproj import Geod
from threadpoolctl import threadpool_info

from obsnet import Station, commands, detect, netcdf, track
from obsnet.errors import AISError, ObsnetError
from obsnet.evaluation import evaluate, evaluate_folder
from obsnet.kinematics import StraightCourse
from obsnet.pipeline import RunConfig
from obsnet.run import read_run
from obsnet.tables import geojson
from obsnet.trackers.track import Track

from .conftest import HOURS, START

DETECTIONS = "time,coverage,azimuth_deg,azimuth_llr,range_m,range_rate_mps,range_llr"
TRACKS = (
    "track,start,end,cpa_time,cpa_distance_m,cpa_azimuth_deg,course_deg,speed_mps,cpa_time_std_s,"
    "cpa_distance_std_m,course_std_deg,speed_std_mps,log_bayes_factor"
)
FILES = {
    "detections.csv", "tracks.csv", "tracks.geojson", "maps.nc", "features.nc", "report.png", "run.json",
}  # fmt: skip
UTC = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z")


def detections(folder):
    return pd.read_csv(folder / "detections.csv")


def notes(folder):
    info = json.loads((folder / "run.json").read_text())
    return " ".join(info["notes"] + info["waveforms"]["notes"])


def only(inventory, path, *codes, change=lambda channel: None):
    """StationXML with some of the channels."""
    kept = copy.deepcopy(inventory)
    kept[0][0].channels = [channel for channel in kept[0][0] if channel.code in codes]
    for channel in kept[0][0]:
        change(channel)
    kept.write(str(path), "STATIONXML")
    return path


def test_the_files_and_nothing_else(finished):
    assert {path.name for path in finished.iterdir()} == FILES
    assert (finished / "report.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_detections_are_a_row_a_minute(finished):
    assert (finished / "detections.csv").read_text().splitlines()[0] == DETECTIONS
    rows = detections(finished)
    assert rows["time"].str.fullmatch(UTC).all()
    times = pd.to_datetime(rows["time"])
    assert (times.diff().dropna() == pd.Timedelta("60s")).all()
    assert len(rows) == 60 * HOURS - 1
    assert rows["coverage"].between(0, 1).all()
    covered = rows["coverage"] > 0
    assert covered.all()
    for ratio, estimates in (("azimuth_llr", ["azimuth_deg"]), ("range_llr", ["range_m", "range_rate_mps"])):
        assert rows.loc[covered, ratio].notna().all()
        for estimate in estimates:
            known = rows[ratio] != 0  # printed as 0 it may have been either
            np.testing.assert_array_equal(rows[estimate].notna()[known], rows[ratio][known] > 0)
    assert rows["azimuth_deg"].dropna().between(0, 360, inclusive="left").all()


def test_the_track_is_the_ship(finished):
    assert (finished / "tracks.csv").read_text().splitlines()[0] == TRACKS
    (row,) = pd.read_csv(finished / "tracks.csv").to_dict("records")
    assert row["track"] == 1
    assert all(UTC.fullmatch(row[name]) for name in ("start", "end", "cpa_time"))
    assert abs(obspy.UTCDateTime(row["cpa_time"]) - (START + 3600)) < 60
    assert row["cpa_distance_m"] == pytest.approx(6000, abs=500)
    assert row["course_deg"] == pytest.approx(60, abs=2)
    assert row["cpa_azimuth_deg"] == pytest.approx(150, abs=2)
    assert row["speed_mps"] == pytest.approx(8, abs=0.5)
    assert row["log_bayes_factor"] > 10


def test_geojson_is_lines_in_wgs84_with_times(finished, inventory):
    collection = json.loads((finished / "tracks.geojson").read_text())
    assert collection["type"] == "FeatureCollection"
    (feature,) = collection["features"]
    assert feature["type"] == "Feature"
    assert feature["geometry"]["type"] == "LineString"
    coordinates = np.array(feature["geometry"]["coordinates"])
    times = feature["properties"]["times"]
    assert len(times) == len(coordinates) >= 2
    assert all(UTC.fullmatch(time) for time in times)
    assert len(pd.to_datetime(times)) == len(times)  # one format for all, or pandas refuses
    station = inventory[0][0]
    _, _, distance = Geod(ellps="WGS84").inv(
        [station.longitude] * len(times), [station.latitude] * len(times), *coordinates.T
    )
    nearest = int(np.argmin(distance))
    assert distance[nearest] == pytest.approx(6000, abs=700)
    along, _, length = Geod(ellps="WGS84").inv(*coordinates[0], *coordinates[-1])
    assert along % 360 == pytest.approx(60, abs=2)
    seconds = obspy.UTCDateTime(times[-1]) - obspy.UTCDateTime(times[0])
    assert length / seconds == pytest.approx(8, abs=0.5)


def line_past(longitude, course_deg=90.0):
    """Geometry and times of a ship that passes a station at a longitude, within an hour or two of it."""
    course = StraightCourse(START.timestamp, 5000.0, course_deg, 8.0)
    track = Track(START.timestamp - 7200, START.timestamp + 7200, course, np.eye(4), 100.0)
    (feature,) = geojson([track], Station("XX.SIM01", -20.0, longitude, 4000.0))["features"]
    return feature["geometry"], feature["properties"]["times"]


@pytest.mark.parametrize("longitude", [234.5, -125.5, 0.0, 360.0])
def test_longitudes_are_those_of_geojson(longitude):
    line, times = line_past(longitude)
    assert line["type"] == "LineString"
    found = np.array(line["coordinates"])[:, 0]
    assert len(times) == len(found)
    assert (np.abs(np.diff(found)) < 0.1).all()
    assert np.abs(found - (longitude + 180) % 360 + 180).max() < 1.0
    assert line == line_past((longitude + 180) % 360 - 180)[0]


@pytest.mark.parametrize("course_deg", [90.0, 270.0])
@pytest.mark.parametrize("longitude", [179.9, -179.9, 180.1])
def test_a_line_across_the_antimeridian_is_cut_there(longitude, course_deg):
    """RFC 7946, 3.1.9: no line goes around the world, none leaves it; each position keeps its time."""
    line, times = line_past(longitude, course_deg)
    assert line["type"] == "MultiLineString"
    before, after = (np.array(part) for part in line["coordinates"])
    east = 1 if course_deg == 90.0 else -1
    assert (before[-1, 0], after[0, 0]) == (180.0 * east, -180.0 * east)
    assert before[-1, 1] == after[0, 1]
    for part in (before, after):
        assert (np.abs(part[:, 0]) <= 180).all()
        assert (np.diff(part[:, 0]) * east > 0).all()
        assert (np.abs(np.diff(part[:, 0])) < 0.1).all()
        assert np.abs((part[:, 0] - longitude + 180) % 360 - 180).max() < 1.0
    assert [len(part) for part in times] == [len(before), len(after)]
    assert times[0][-1] == times[1][0]
    whole = pd.to_datetime([*times[0], *times[1][1:]])
    assert whole.is_monotonic_increasing
    speed = np.diff(np.unwrap([*before[:, 0], *after[1:, 0]], period=360)) / np.diff(
        whole.tz_localize(None).to_numpy()
    ).astype(float)
    np.testing.assert_allclose(speed, np.median(speed), rtol=0.01)


def test_times_of_cpa_are_all_alike():
    rows = [
        Track(0.0, 7200.0, StraightCourse(at, 5000.0, 90.0, 8.0), np.eye(4), 100.0).row(1)
        for at in (3600.0, 3600.5)
    ]
    assert [row["cpa_time"] for row in rows] == ["1970-01-01T01:00:00.000Z", "1970-01-01T01:00:00.500Z"]


def test_maps_are_cf_netcdf(finished):
    with xr.open_dataset(finished / "maps.nc", engine="h5netcdf") as maps:
        assert maps.attrs["Conventions"].startswith("CF-")
        assert maps["azimuth_llr"].dims == ("time", "azimuth")
        assert maps["range_llr"].dims == ("time", "range", "range_rate")
        np.testing.assert_array_equal(
            maps["time"].values, pd.to_datetime(detections(finished)["time"]).dt.tz_localize(None)
        )


def test_the_spectrogram_has_units(finished):
    with xr.open_dataset(finished / "features.nc") as features:
        assert features["power"].attrs["units"] == "Pa2"
        axes = {name: coord.attrs["units"] for name, coord in features.coords.items() if name != "time"}
    assert axes == {"spectrogram_frequency": "Hz", "frequency": "Hz", "quefrency": "s", "range": "m"}


def test_the_ratio_against_range_alone_lies_beside_the_map(finished):
    with xr.open_dataset(finished / "maps.nc") as maps, xr.open_dataset(finished / "features.nc") as features:
        llr = maps["range_llr"].transpose("time", "range", "range_rate").values.astype(float)
        marginal = np.log(np.exp(llr).mean(axis=2))
        np.testing.assert_allclose(features["range_marginal_llr"].values, marginal, atol=0.06)
        np.testing.assert_array_equal(features["range"], maps["range"])


@pytest.mark.parametrize("name", ["maps.nc", "features.nc"])
def test_files_are_read_as_xarray_reads_them(finished, name):
    with xr.open_dataset(finished / name, engine="h5netcdf") as whole:
        read = netcdf.read(finished / name)
        xr.testing.assert_identical(read.drop_attrs(), whole.drop_attrs())
        for variable in (set(whole.variables) | set(read.variables)) - {"time"}:
            assert read[variable].attrs == whole[variable].attrs, variable
        for part in (
            {"time": 5},
            {"time": [7, 3, 3, 9]},
            {"time": [0, whole.sizes["time"] - 1]},
            {"time": slice(40, 3, -7)},
            {"time": slice(0, 0)},
            {"time": []},
            {"time": 4, "range": 3},
            {"range": [30, 1], "time": slice(5, 30, 3)},
        ):
            part = {dim: at for dim, at in part.items() if dim in whole.dims}
            xr.testing.assert_equal(netcdf.read(finished / name).isel(part).load(), whole.isel(part).load())


def test_a_file_written_anew_is_not_read_as_the_old_one(finished, tmp_path):
    path = tmp_path / "maps.nc"
    copyfile(finished / "maps.nc", path)
    old = netcdf.read(path)
    with netcdf.TimeWriter(path) as writer:
        writer.append(netcdf.read(finished / "maps.nc").isel(time=slice(0, 3)).load())
    with pytest.raises(OSError, match="open it again"):
        old["range_llr"].load()


def test_run_json_says_how(finished):
    info = json.loads((finished / "run.json").read_text())
    assert {
        "config",
        "versions",
        "models",
        "seconds",
        "peak_memory_mb",
        "station",
        "waveforms",
    } <= info.keys()
    assert {"obspy", "onnxruntime"} <= info["versions"].keys()
    assert info["station"]["code"] == "XX.SIM01"
    assert info["config"]["detector"] == "learned"
    assert info["seconds"].keys() >= {"spectra", "detect", "track"}
    assert info["tracks"] == 1
    assert UTC.fullmatch(info["start"])


def test_no_ship_is_done(tracked, stream, tmp_path):
    noise = stream.copy()
    rng = np.random.default_rng(5)
    for trace in noise:
        trace.data = np.rint(rng.normal(0, 3000, trace.stats.npts)).astype(np.int32)
    noise.write(str(tmp_path / "noise.mseed"), "MSEED")
    out = tracked(tmp_path / "noise.mseed")
    assert (out / "tracks.csv").read_text() == TRACKS + "\n"
    assert json.loads((out / "tracks.geojson").read_text())["features"] == []
    assert (detections(out)["azimuth_llr"] <= 0).mean() > 0.9


def test_detect_is_the_same_without_tracks(tracked, finished):
    out = tracked(command="detect")
    assert (out / "detections.csv").read_bytes() == (finished / "detections.csv").read_bytes()
    assert (out / "tracks.csv").read_text() == TRACKS + "\n"


def test_any_split_of_the_record_gives_the_same_rows(tracked, finished, stream, tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    cuts = [0.0, 1000.01, 2222.2, 2222.22, 5000.0, 3600 * HOURS]
    for number, trace in enumerate(stream):
        for part in range(len(cuts) - 1):
            piece = trace.slice(START + cuts[part], START + cuts[part + 1] - 0.01)
            name = folder / f"{9 - part}-{number}.mseed"
            piece.write(str(name), "MSEED", reclen=512, encoding="INT32" if part % 2 else "STEIM2")
    expected = (finished / "detections.csv").read_bytes()
    assert (tracked(folder) / "detections.csv").read_bytes() == expected
    files = sorted(folder.iterdir(), reverse=True)
    out = tracked([*files, files[3]], "--set", "spectra.block_s=777")
    assert (out / "detections.csv").read_bytes() == expected
    assert (out / "tracks.csv").read_bytes() == (finished / "tracks.csv").read_bytes()


def test_a_run_read_again_is_the_run(finished):
    """Segments of the folder's files are those of the run: what tells closing from opening is kept."""
    from obsnet.tracking import find_tracks

    run = read_run(finished)
    found, tracks = find_tracks(run)
    assert [(s.start, s.end, s.cpa) for s in found] == [(s.start, s.end, s.cpa) for s in run.segments]
    assert len(tracks) == len(run.tracks)
    for again, kept in zip(tracks, run.tracks, strict=True):
        assert abs(again.motion.cpa_time - kept.motion.cpa_time) < 5.0


def test_a_station_that_was_moved_is_where_it_lay_when_its_record_begins(
    tracked, inventory, record, tmp_path
):
    """The record is of the first of two deployments, and so are its depth, its delays and the ships about it."""
    moved = copy.deepcopy(inventory)
    (here,) = moved[0]
    later = copy.deepcopy(here)
    later.latitude, later.elevation, later.start_date = -45.0, -900.0, START + 86400 * 365
    for channel in later:
        channel.start_date = later.start_date
    moved[0].stations.append(later)
    moved.write(str(tmp_path / "moved.xml"), "STATIONXML")
    options = ("--ais", record / "ais.csv", "--end", "2013-05-21T10:30:00Z", "--detector", "analytic")
    folders = [
        tracked(record / "waveforms.mseed", *options, station=station, command="detect")
        for station in (record / "station.xml", tmp_path / "moved.xml")
    ]
    (expected, rows), (found, same) = ((read_run(folder), detections(folder)) for folder in folders)
    assert found.station == expected.station
    pd.testing.assert_frame_equal(same, rows)


def test_ships_are_those_about_the_place_of_the_record(inventory, record, tmp_path):
    moved = copy.deepcopy(inventory)
    later = copy.deepcopy(moved[0][0])
    later.latitude, later.start_date = -45.0, START + 86400 * 365
    moved[0].stations.append(later)
    station = Station.from_stationxml(moved)
    assert station.latitude == -45.0
    here = commands.placed(station, [str(record / "waveforms.mseed")], RunConfig(), None, None)
    assert here.latitude == inventory[0][0].latitude
    assert len(commands.read_reference(record / "ais.csv", here)) == 1


def test_of_an_ais_file_the_surroundings_are_held_alone(record, inventory, tmp_path, monkeypatch):
    """A national archive would not fit."""
    held = []
    monkeypatch.setattr("obsnet.ais.reference_tracks", lambda ais, *place, **limits: held.append(ais) or [])
    near = pd.read_csv(record / "ais.csv")
    far = near.assign(lat=near["lat"] + 30.0, mmsi=near["mmsi"] + 1)
    pd.concat([near, far]).to_csv(tmp_path / "both.csv", index=False)
    far.to_csv(tmp_path / "far.csv", index=False)
    station = Station.from_stationxml(inventory)
    commands.read_reference(tmp_path / "both.csv", station)
    assert set(held[0]["mmsi"]) == set(near["mmsi"])
    with pytest.raises(AISError, match="too far away"):
        commands.read_reference(tmp_path / "far.csv", station)


def test_the_users_own_delays_are_used_and_said(tracked, finished, record, tmp_path):
    """In slower water a delay is heard from farther off; run.json names the table, and the run reads it back."""
    from obsnet.ocean.rays import propagation_table, write_propagation
    from obsnet.ocean.sound_speed import OceanConfig

    run = read_run(finished)
    slower = propagation_table(OceanConfig(profile="constant", sound_speed_mps=1450.0), run.station.depth_m)
    write_propagation(slower, tmp_path / "own.nc")
    out = tracked(record / "waveforms.mseed", "--propagation", tmp_path / "own.nc")
    own = read_run(out)
    assert own.config.ocean.propagation_file == str((tmp_path / "own.nc").resolve())
    np.testing.assert_allclose(own.table["delay"].values, slower["delay"].values)
    assert {path.name for path in out.iterdir()} == FILES | {"propagation.nc"}
    (tmp_path / "own.nc").unlink()  # the folder has its own
    np.testing.assert_array_equal(read_run(out).table["delay"].values, own.table["delay"].values)
    near = detections(out)["range_m"] / detections(finished)["range_m"]
    assert near.median() > 1.01


def test_a_table_that_was_given_is_the_runs_wherever_it_is_read(
    stream, inventory, record, tmp_path, unplotted, monkeypatch
):
    """Delays of slower water, given in Python: figures and scores of the folder take them, not the configured ocean's."""
    from obsnet.ocean.rays import propagation_table
    from obsnet.ocean.sound_speed import OceanConfig

    station = Station.from_stationxml(inventory)
    slower = propagation_table(OceanConfig(profile="constant", sound_speed_mps=1350.0), station.depth_m)
    run = detect(stream, station, RunConfig(detector="analytic"), endtime=START + 1800, table=slower)
    run.write(tmp_path)
    back = read_run(tmp_path)
    for name in ("delay", "pressure", "slowness"):
        np.testing.assert_array_equal(back.table[name].values, slower[name].values)
    used = []

    def spied(detections, tracks, reference, delay, *more, **limits):
        used.append(delay(np.array([10e3])))
        return evaluate(detections, tracks, reference, delay, *more, **limits)

    monkeypatch.setattr("obsnet.evaluation.folder.evaluate", spied)
    evaluate_folder(tmp_path, record / "ais.csv")
    np.testing.assert_array_equal(used, [run.delay(np.array([10e3]))])
    # of the next run nothing of it is left
    detect(stream, station, RunConfig(detector="analytic"), endtime=START + 1800).write(tmp_path)
    assert not np.allclose(read_run(tmp_path).table["delay"].values, slower["delay"].values, equal_nan=True)


def test_a_gap_costs_its_own_minutes(tracked, finished, stream, tmp_path):
    begin, end = START + 4000, START + 4600
    (stream.slice(START, begin) + stream.slice(end)).write(str(tmp_path / "w.mseed"), "MSEED")
    rows, whole = detections(tracked(tmp_path / "w.mseed")), detections(finished)
    assert rows["time"].tolist() == whole["time"].tolist()
    seconds = (pd.to_datetime(rows["time"]) - pd.Timestamp(str(START))).dt.total_seconds()
    touched = seconds.between(4000 - 101, 4600 + 101)
    inside = seconds.between(4000 + 80, 4600 - 80)
    assert (rows.loc[inside, "coverage"] == 0).all()
    assert rows.loc[inside, ["azimuth_llr", "range_llr"]].isna().all(axis=None)
    assert (rows.loc[~inside, "coverage"] > 0).all()
    before = seconds < 4000 - 101
    pd.testing.assert_frame_equal(rows[before], whole[before])
    np.testing.assert_array_equal(rows.loc[~touched, "coverage"], whole.loc[~touched, "coverage"])


def test_no_horizontals_is_range_only(tracked, finished, inventory, tmp_path):
    out = tracked(station=only(inventory, tmp_path / "s.xml", "BDH", "BHZ"))
    rows = detections(out)
    assert "range only" in notes(out)
    assert rows[["azimuth_deg", "azimuth_llr"]].isna().all(axis=None)
    np.testing.assert_array_equal(rows["range_m"], detections(finished)["range_m"])
    assert pd.read_csv(out / "tracks.csv")["course_deg"].isna().all()


def test_no_hydrophone_is_azimuth_by_polarisation(tracked, inventory, tmp_path):
    out = tracked(station=only(inventory, tmp_path / "s.xml", "BH1", "BH2", "BHZ"))
    rows = detections(out)
    assert "ambiguous by 180°" in notes(out)
    assert rows[["range_m", "range_llr"]].isna().all(axis=None)
    near = (pd.to_datetime(rows["time"]) - pd.Timestamp(str(START + 3600), tz="UTC")).abs() < "5min"
    off = (rows.loc[near, "azimuth_deg"] - 150 + 90) % 180 - 90
    assert off.notna().all()
    assert off.abs().max() < 30


def test_what_the_bernoulli_tracker_cannot_follow_is_not_read(
    obsnet, record, inventory, tmp_path, monkeypatch
):
    monkeypatch.setattr("obsnet.pipeline.Pipeline._begin", lambda *given: pytest.fail("went on"))
    station = only(inventory, tmp_path / "s.xml", "BH1", "BH2", "BHZ")
    status, _, errors = obsnet(
        "track", record / "waveforms.mseed", "--station", station, "--out", tmp_path / "o", "--tracker", "bernoulli"
    )  # fmt: skip
    assert status == 2
    (line,) = errors
    assert "which need two horizontals and a hydrophone" in line
    assert not (tmp_path / "o").exists()


def test_no_response_is_said(tracked, inventory, tmp_path):
    def bare(channel):
        channel.response = None

    station = only(inventory, tmp_path / "s.xml", "BDH", "BH1", "BH2", "BHZ", change=bare)
    out = tracked(station=station)
    assert "BDH has no response: its samples are taken as they are" in notes(out)


def test_a_file_cut_short_serves_as_far_as_it_goes(tracked, record, tmp_path):
    whole = (record / "waveforms.mseed").read_bytes()
    (tmp_path / "cut.mseed").write_bytes(whole[: len(whole) // 2 + 777])
    out = tracked(tmp_path / "cut.mseed")
    assert "records are cut or unreadable" in notes(out)
    assert len(detections(out))


def test_what_was_wrong_with_the_waveforms_is_said(obsnet, stream, record, tmp_path, unplotted):
    dead, other = stream.copy(), stream.slice(START, START + 600).copy()
    dead.select(channel="BH2")[0].data[:] = 0
    for trace in other:
        trace.data = trace.data[::-1].copy()
    for i in range(7):
        (stray := stream.select(channel="BDH").slice(START, START + 60).copy())[0].stats.station = f"OTH{i}"
        dead += stray
    (dead + other).write(str(tmp_path / "w.mseed"), "MSEED")
    with (tmp_path / "w.mseed").open("ab") as file:
        file.write((record / "waveforms.mseed").read_bytes()[:300])
    given = ("detect", tmp_path / "w.mseed", "--station", record / "station.xml", "--out", tmp_path / "out")
    status, said, _ = obsnet(*given)
    assert status == 0
    found = [line for line in said if line.startswith("note:")]
    assert any("cut or unreadable" in line for line in found)
    assert any(line == "note: XX.OTH0.00.BDH not described for XX.SIM01" for line in found)
    assert any(line.startswith("note: 3 more channels left aside") for line in found)
    assert any(re.search(r"BDH: \d+ conflicting overlaps", line) for line in found)
    assert any(re.search(r"BH2: .*\d+ dead frames", line) for line in found)


def test_times_with_an_offset_are_that_time(tracked, record):
    span = ("--start", "2013-05-21T13:00:00+02:00", "--end", "2013-05-21T11:20:00")
    times = detections(tracked(record / "waveforms.mseed", *span))["time"]
    assert times.iloc[0] >= "2013-05-21T11:00:00Z"
    assert times.iloc[-1] <= "2013-05-21T11:20:00Z"
    assert len(times) >= 18


def test_a_run_after_another_leaves_nothing_of_it(tracked, obsnet, record):
    out = tracked(record / "waveforms.mseed", "--tracker", "bernoulli")
    assert (out / "live.csv").exists()
    assert obsnet("plot", out, "--figure", "3", "--quiet")[0] == 0
    assert (out / "figure-3.png").exists()
    (out / "figure-1.png").write_text("of something else")
    status, _, _ = obsnet(
        "detect", record / "waveforms.mseed", "--station", record / "station.xml", "--out", out, "--quiet"
    )
    assert status == 0
    assert {path.name for path in out.iterdir()} == {*FILES, "figure-1.png"}


def test_evaluate_reads_what_was_written(obsnet, record, finished):
    status, told, errors = obsnet("evaluate", finished, "--ais", record / "ais.csv", "--json")
    assert (status, errors) == (0, [])
    (ship,) = json.loads(told[0])["ships"]
    assert abs(ship["cpa_time_error_s"]) < 60
    assert obsnet("evaluate", finished, "--ais", record / "ais.csv", "--quiet") == (0, [], [])


def test_a_run_in_python_keeps_blas_to_one_thread(stream, inventory):
    """Its matrices are small: a pool takes longer to wake than to multiply, and far longer beside other work."""

    def threads():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    before, seen = threads(), []
    station = Station.from_stationxml(inventory)
    detect(stream, station, endtime=START + 1800, heard=lambda run: seen.append(threads()))
    assert (seen, threads()) == ([{1}], before)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        ({"station": "station.xml"}, "a Station, as of Station.from_stationxml, found a str"),
        ({"station": None}, "found a NoneType"),
        ({"config": {"detector": "analytic"}}, "a RunConfig, found a dict"),
        ({"config": {"detector": "analytic"}, "detector": "learned"}, "a RunConfig, found a dict"),
        ({"stream": obspy.Stream()}, "the Stream is empty"),
        ({"threads": -2}, "must be a whole number of at least 1, or none for all cores, found -2"),
    ],
)
def test_what_is_given_wrong_in_python_is_said(stream, inventory, wrong, found):
    given = {"stream": stream, "station": Station.from_stationxml(inventory), "endtime": START + 600} | wrong
    with pytest.raises(ObsnetError, match=re.escape(found)):
        track(**given)


def test_one_minute_is_no_minutes(obsnet, record, tmp_path, unplotted):
    given = (
        "detect",
        record / "waveforms.mseed",
        "--station",
        record / "station.xml",
        "--out",
        tmp_path / "out",
    )
    status, told, _ = obsnet(*given, "--end", str(START + 100))
    assert status == 0
    assert any("XX.SIM01: 1 minute, " in line for line in told), told
