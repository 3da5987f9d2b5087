"""Station-days: as in one continuous run, never twice, and a bad one does not stop the rest."""

import copy
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import obspy
import pandas as pd
import pytest
import xarray as xr

import obsnet
from obsnet.archive import archive
from obsnet.archive.day import known_station
from obsnet.archive.ledger import Ledger
from obsnet.config import build, merge_overrides
from obsnet.kinematics import StraightCourse
from obsnet.pipeline import RunConfig
from obsnet.twin.scenario import Passage, Scenario
from obsnet.twin.ship import Ship
from obsnet.twin.station import simulate

pytest.importorskip("pyarrow")
pytest.importorskip("distributed")
ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow
MIDNIGHT = obspy.UTCDateTime(2013, 5, 22)


@pytest.fixture(scope="module")
def config(fast):
    return build(RunConfig, merge_overrides({}, list(fast)))


@pytest.fixture(scope="module")
def night(tmp_path_factory, config, write_sds):
    """Eleven simulated hours with a ship nearest at midnight, as an SDS archive and as one stream."""
    folder = tmp_path_factory.mktemp("night")
    begin = MIDNIGHT.timestamp - 6 * 3600
    passage = Passage(
        Ship.random(3, 100000001), StraightCourse(MIDNIGHT.timestamp + 600.0, 6000.0, 60.0, 8.0)
    )
    made = simulate(Scenario(begin, 11.0, (passage,), seed=4))
    made.inventory.write(str(folder / "station.xml"), format="STATIONXML")
    write_sds(made.stream, folder / "sds")
    station = obsnet.Station.from_stationxml(folder / "station.xml")
    # Into a folder: its maps are packed as the archive's are.
    one = obsnet.track(folder / "sds", station, config, folder=folder / "one")
    report = archive(
        folder / "sds", folder / "station.xml", "2013-05-21", "2013-05-23", folder / "out", config, jobs=2
    )
    return folder / "out", one, report


def minutes(out):
    table = pd.read_parquet(out / "detections").sort_values(["station", "time"])
    return table.assign(time=table["time"].dt.tz_localize(None).astype("datetime64[ns]"))


def maps(out):
    days = sorted((out / "maps").glob("station=*/*.zarr"))
    return xr.concat([xr.open_zarr(day, consolidated=False) for day in days], "time", join="override")


def test_station_days_are_those_of_one_continuous_run(night):
    out, one, report = night
    assert list(report.rows["status"]) == ["done", "done"] and report.computed == 2
    table = minutes(out)
    assert len(table) == 2 * 1440 and table["time"].is_unique
    both = table.merge(one.detections, on="time", suffixes=("", "_one"))
    assert len(both) == len(one.detections) > 600
    for name in ("coverage", "azimuth_deg", "azimuth_llr", "range_m", "range_rate_mps", "range_llr"):
        np.testing.assert_allclose(both[name], both[f"{name}_one"], atol=1e-3, err_msg=name)
    outside = table[~table["time"].isin(one.detections["time"])]
    assert (outside["coverage"] == 0).all() and outside["azimuth_llr"].isna().all()


def test_maps_are_those_of_one_continuous_run_to_one_step_of_their_packing(night):
    out, one, _ = night
    held = maps(out)
    at = held.sel(time=one.maps["time"].values)
    np.testing.assert_allclose(at["azimuth_llr"], one.maps["azimuth_llr"], atol=1e-3)
    np.testing.assert_allclose(at["range_llr"], one.maps["range_llr"], atol=0.051)
    assert held.sizes["time"] == 2 * 1440
    silent = held["range_coverage"].values == 0
    assert np.isnan(held["range_llr"].values[silent]).all() and silent.sum() == 2 * 1440 - len(one.detections)


def test_a_ship_at_midnight_is_one_track(night):
    out, one, _ = night
    found = pd.read_parquet(out / "tracks")
    assert len(found) == len(one.tracks) == 1
    row, expected = found.iloc[0], one.tracks[0].row(1)
    assert row["start"] < pd.Timestamp(MIDNIGHT.datetime, tz="UTC") < row["end"]
    assert row["track"].startswith("XX.SIM01-20130522T00") and str(row["date"]) == "2013-05-21"
    for name in ("cpa_distance_m", "course_deg", "speed_mps"):
        assert row[name] == pytest.approx(expected[name], rel=1e-3)
    # Both are of maps packed to 0.05 nats, on which the spread depends more than on how the days are cut.
    assert row["cpa_time_std_s"] == pytest.approx(expected["cpa_time_std_s"], rel=0.02)


def test_without_a_run_in_the_first_minutes_would_differ(night, config):
    """The guard of the tests above: they can fail."""
    out, one, _ = night
    station = obsnet.Station.from_stationxml(out / "stations" / "XX.SIM01.xml")
    cold = obsnet.detect(
        out.parent / "sds", station, config, starttime="2013-05-22", endtime="2013-05-22T01:00:00"
    )
    both = cold.detections.merge(one.detections, on="time", suffixes=("", "_one"))
    assert (abs(both["range_llr"] - both["range_llr_one"]) > 1e-3).mean() > 0.5


def test_a_finished_day_is_not_computed_again_and_new_days_are(night, config, tmp_path):
    before, _, _ = night
    out = tmp_path / "out"
    shutil.copytree(before, out)
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.parent.name.startswith("date=")}
    again = archive(
        before.parent / "sds", before.parent / "station.xml", "2013-05-20", "2013-05-24", out, config, jobs=1
    )
    assert again.computed == 0
    assert list(again.rows["status"]) == ["no data", "done", "done", "no data"]
    assert again.rows["tracks"].sum() == 1
    assert files == {path: path.stat().st_mtime_ns for path in files}


def test_tracks_are_found_anew_when_a_missing_day_comes(night, config, tmp_path):
    whole, _, _ = night
    out = tmp_path / "out"
    first = archive(
        whole.parent / "sds", whole.parent / "station.xml", "2013-05-21", "2013-05-22", out, config, jobs=1
    )
    (half,) = [pd.read_parquet(path) for path in (out / "tracks").rglob("*.parquet")]
    assert first.rows["tracks"].sum() == 1 and str(half["end"].iloc[0]) < "2013-05-22"
    archive(
        whole.parent / "sds", whole.parent / "station.xml", "2013-05-22", "2013-05-23", out, config, jobs=1
    )
    pd.testing.assert_frame_equal(pd.read_parquet(out / "tracks"), pd.read_parquet(whole / "tracks"))


@pytest.mark.parametrize("said", ["{}", "[]", "", '{"status": "done", "minutes": "all"}'])
def test_a_record_that_says_nothing_is_made_anew(command, sds, tmp_path, said):
    out = tmp_path / "out"
    assert command(sds, out, "--jobs", "1")[0] == 0
    (held,) = (out / "days").rglob("2013-05-21.json")
    before = pd.read_parquet(out / "detections")
    held.write_text(said)
    status, lines, errors = command(sds, out, "--jobs", "1")
    assert (status, errors) == (0, []) and "1 computed now" in "".join(lines)
    pd.testing.assert_frame_equal(pd.read_parquet(out / "detections"), before)


@pytest.mark.parametrize("left", [0, 1000, None])
def test_a_day_whose_minutes_are_lost_or_cut_short_is_computed_again(command, sds, tmp_path, left):
    out = tmp_path / "out"
    assert command(sds, out, "--jobs", "1")[0] == 0
    before = pd.read_parquet(out / "detections")
    (minutes,) = (out / "detections").rglob("*.parquet")
    whole = minutes.read_bytes()
    minutes.unlink() if left is None else minutes.write_bytes(whole[:left])
    status, lines, errors = command(sds, out, "--jobs", "1")
    assert (status, errors) == (0, []) and "1 computed now" in "".join(lines)
    pd.testing.assert_frame_equal(pd.read_parquet(out / "detections"), before)


def test_minutes_that_are_damaged_within_are_one_line(command, sds, tmp_path):
    out = tmp_path / "out"
    assert command(sds, out, "--jobs", "1")[0] == 0
    (minutes,) = (out / "detections").rglob("*.parquet")
    whole = minutes.read_bytes()
    minutes.write_bytes(whole[:4] + bytes(2000) + whole[2004:])
    status, _, errors = command(sds, out, "--jobs", "1")
    assert status == 2 and len(errors) == 1 and "minutes.parquet cannot be read" in errors[0]


def test_a_bad_day_is_reported_and_the_rest_is_done(command, three_days, tmp_path):
    status, lines, errors = command(three_days, tmp_path / "out", "--jobs", "2", end="2013-05-25")
    assert (status, errors) == (3, [])
    (bad,) = [line for line in lines if line.startswith("failed")]
    assert "2013-05-22" in bad and "142: " in bad
    report = pd.read_csv(tmp_path / "out" / "report.csv")
    assert list(report["status"]) == ["done", "failed", "done", "no data"]
    assert report["error"].notna().sum() == 1


def test_other_parameters_or_metadata_are_refused_and_nothing_is_lost(command, sds, record, tmp_path):
    out = tmp_path / "out"
    assert command(sds, out)[0] == 0
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    status, _, errors = command(sds, out, "--set", "azimuth.detection_probability=0.5")
    assert status == 2 and len(errors) == 1
    assert "was begun with azimuth.detection_probability = " in errors[0]
    text = (record / "station.xml").read_text()
    other = tmp_path / "other.xml"
    other.write_text(text.replace("4340", "4330"))
    assert other.read_text() != text
    status, _, errors = command(sds, out, "--stations", other)
    assert status == 2 and "metadata of XX.SIM01" in errors[0]
    assert {path for path in before if path.exists()} == set(before)


def test_a_model_that_was_exchanged_is_refused(sds, record, tmp_path, config):
    from obsnet.archive.ledger import Ledger, model_digests
    from obsnet.errors import ConfigError

    learned = replace(config, detector="learned-azimuth")
    (digest,) = model_digests(learned).values()
    assert len(digest) == 64 and model_digests(replace(config, detector="analytic")) == {}
    with Ledger(tmp_path).begun(learned, {}):
        pass
    known = json.loads((tmp_path / "archive.json").read_text())
    (tmp_path / "archive.json").write_text(json.dumps(known | {"models": {"azimuth": "another"}}))
    with (
        pytest.raises(ConfigError, match=r"begun with model digests\.azimuth"),
        Ledger(tmp_path).begun(learned, {}),
    ):
        pass


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--start", "2013-05-21T01:00:00"), "not a midnight"),
        (("--start", "yesterday"), "is no date"),
        (("--end", "2013-05-21"), "is not before the end"),
        (("--end", "2999-01-01"), "lies ahead"),
        (("--select", "YV.*"), "describes none of YV.*"),
        (("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler answers at tcp://127.0.0.1:1"),
        (("--set", "tracker=bernoulli"), "grid search"),
    ],
)
def test_what_cannot_be_is_one_line(command, sds, tmp_path, options, expected):
    status, _, errors = command(sds, tmp_path / "out", *options)
    assert status == 2 and len(errors) == 1 and expected in errors[0]
    assert errors[0].startswith("obsnet: error: ")


def test_codes_that_lead_out_of_the_folder_are_one_line(command, sds, record, tmp_path):
    evil = tmp_path / "in" / "evil.xml"
    evil.parent.mkdir()
    evil.write_text((record / "station.xml").read_text().replace('code="XX"', 'code="../../evil"'))
    status, _, errors = command(sds, tmp_path / "deep" / "out", "--stations", evil)
    assert status == 2 and len(errors) == 1 and "has the code '../../evil'" in errors[0]
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {evil}


def test_a_station_lies_where_it_lay_on_the_day(record, tmp_path):
    inventory = obspy.read_inventory(str(record / "station.xml"))
    (early,) = inventory[0]
    late = copy.deepcopy(early)
    early.end_date = late.start_date = obspy.UTCDateTime(2014, 1, 1)
    late.latitude, late.elevation = 10.0, -1000.0
    inventory[0].stations.append(late)
    ledger = Ledger(tmp_path)
    path = ledger.station_file("XX.SIM01")
    path.parent.mkdir(parents=True, exist_ok=True)
    inventory.write(str(path), "STATIONXML")
    then, now = (known_station(ledger, "XX.SIM01", at.timestamp) for at in (MIDNIGHT, MIDNIGHT + 1e8))
    assert (then.latitude, then.depth_m) == (early.latitude, -early.elevation)
    assert (now.latitude, now.depth_m) == (10.0, 1000.0)


def test_a_folder_that_is_no_archive_is_one_line(command, record, tmp_path):
    status, _, errors = command(record, tmp_path / "out")
    assert status == 2 and "is not an SDS archive" in errors[0]


def test_a_killed_archive_leaves_nothing_half_written_and_goes_on(three_days, record, fast, tmp_path):
    out = tmp_path / "out"
    words = ["archive", str(three_days), "--stations", str(record / "station.xml"), "--start", "2013-05-21", "--end", "2013-05-24",
             "--out", str(out), "--jobs", "1"]  # fmt: skip
    words += [word for override in fast for word in ("--set", override)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    started = subprocess.Popen(
        [sys.executable, "-m", "obsnet", *words], env=environment, stdout=subprocess.DEVNULL
    )
    first = out / "days" / "XX.SIM01" / "2013-05-21.json"
    end = time.monotonic() + 60
    while not first.exists() and time.monotonic() < end:
        time.sleep(0.02)
    started.send_signal(signal.SIGKILL)
    started.wait()
    stamp = first.stat().st_mtime_ns
    for record_file in (out / "days").rglob("*.json"):
        if json.loads(record_file.read_text())["status"] == "done":
            day = record_file.name.split(".")[0]
            assert (out / "detections" / "station=XX.SIM01" / f"date={day}" / "minutes.parquet").exists()
    half = out / "maps" / "station=XX.SIM01" / ".unfinished-1-date=2013-05-23.zarr"
    half.mkdir(parents=True)
    resumed = subprocess.run(
        [sys.executable, "-m", "obsnet", *words], env=environment, capture_output=True, text=True, timeout=120
    )
    assert resumed.returncode == 3, resumed.stderr
    assert first.stat().st_mtime_ns == stamp
    assert not list(out.rglob(".unfinished-*"))
    assert list(pd.read_csv(out / "report.csv")["status"]) == ["done", "failed", "done"]


def test_an_interrupted_archive_ends_soon_and_leaves_nothing_unfinished(sds, record, tmp_path):
    out = tmp_path / "out"
    words = ["archive", str(sds), "--stations", str(record / "station.xml"), "--start", "2013-05-21", "--end", "2013-05-22",
             "--out", str(out), "--jobs", "1"]  # fmt: skip
    started = subprocess.Popen(
        [sys.executable, "-m", "obsnet", *words], env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )  # fmt: skip
    end = time.monotonic() + 60
    while not list(out.rglob(".unfinished-*")) and time.monotonic() < end:
        time.sleep(0.02)
    started.send_signal(signal.SIGTERM)
    _, errors = started.communicate(timeout=20)
    assert started.returncode == 128 + signal.SIGTERM and errors == b""
    assert not list(out.rglob(".unfinished-*")) and not list(out.rglob("*.parquet"))
