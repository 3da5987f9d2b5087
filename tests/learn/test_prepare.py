from dataclasses import replace

import numpy as np
import obspy
import pandas as pd
import pytest

pytest.importorskip("zarr")

from obsnet.detectors.azimuth_features import CHANNELS, cell_index
from obsnet.errors import WaveformError
from obsnet.layout import from_posix, parse_utc
from obsnet.learn.dataset import PreparedSet
from obsnet.learn.labels import labels
from obsnet.learn.prepare import ArchiveData, TwinData, prepare, twin_record
from obsnet.learn.scenes import NEVER_TRAINED, SceneConfig, draw_scene, split_of
from obsnet.twin.course import local_projection
from obsnet.twin.instrument import Recorder
from obsnet.twin.scenario import Scenario
from obsnet.twin.station import write_simulation

STATION = (-21.0, 54.0)
START = parse_utc("2012-11-01") / 1e9
LOUD = SceneConfig(hours=0.7, ship_shares=(0.0, 1.0), source_level_db=205.0, source_level_spread_db=0.1,
                   without_z=0.0, without_hydrophone=0.0, without_horizontals=0.0, lobe_shares=(1.0,), choir_share=0.0,
                   swarm_share=0.0)  # fmt: skip


def straight(minutes, speed=8.0, offset=5000.0):
    east, north = speed * (minutes - minutes.mean()), np.full(len(minutes), offset)
    lon, lat = local_projection(*STATION)(east, north, inverse=True)
    return pd.DataFrame({"mmsi": 244000001, "time": from_posix(minutes), "lon": lon, "lat": lat})


def test_labels_are_where_the_ship_was_when_it_is_heard():
    minutes = START + 60.0 * np.arange(60)
    seen = labels(
        straight(minutes), STATION, minutes[5:50], lambda distance: np.full(np.shape(distance), 30.0)
    )
    east = 8.0 * (minutes[5:50] - 30.0 - minutes.mean())
    np.testing.assert_allclose(seen["range_m"][:, 0], np.hypot(east, 5000.0), rtol=2e-3)
    np.testing.assert_allclose(
        seen["azimuth_deg"][:, 0], np.rad2deg(np.arctan2(east, 5000.0)) % 360, atol=0.3
    )
    assert seen["known"].all()


def test_what_ais_does_not_say_is_unknown():
    minutes = START + 60.0 * np.arange(240)
    ais = straight(minutes)
    gap = pd.concat([ais[:60], ais[160:]])
    delay = lambda distance: np.asarray(distance) / 1500.0  # noqa: E731
    seen = labels(gap, STATION, minutes, delay, max_interpolation_s=1200.0)
    assert seen["known"][30, 0] and not seen["known"][110, 0] and np.isfinite(seen["azimuth_deg"][110, 0])
    late = labels(ais[:60], STATION, minutes, delay)
    assert not late["known"][70, 0] and np.isnan(late["azimuth_deg"][70, 0]) and late["known"][200, 0]
    other = labels(ais, STATION, minutes, delay, ours=lambda mmsi: False)
    assert not other["known"].any()
    assert labels(None, STATION, minutes, delay)["azimuth_deg"].shape == (240, 0)


def test_scenes_are_drawn_from_their_seed_and_differ():
    one, again, other = draw_scene(3, "train"), draw_scene(3, "train"), draw_scene(3, "validation")
    assert one.scenario == again.scenario and one.ocean.depth_m == again.ocean.depth_m
    assert one.ocean.depth_m != other.ocean.depth_m
    scenes = [draw_scene(seed, "train", replace(SceneConfig(), hours=1.0)).scenario for seed in range(30)]
    assert {0, 1, 2} <= {len(scene.passages) for scene in scenes}
    assert len({scene.recorder.components for scene in scenes}) >= 3
    assert {scene.recorder.sampling_rate for scene in scenes} > {50.0}
    assert {0, 1, 2} == {len(scene.lobes) for scene in scenes}
    assert max(scene.earthquakes.per_day for scene in scenes) > 50.0
    assert max(len(scene.whales) for scene in scenes if scene.passages) >= 3
    assert max(len(scene.whales) for scene in scenes if not scene.passages) >= 3
    quiet = [scene.ambient.directional_fraction for scene in scenes if not scene.passages]
    loud = [scene.ambient.directional_fraction for scene in scenes if scene.passages]
    assert min(max(quiet), max(loud)) > 0.5 and max(min(quiet), min(loud)) < 0.4


def test_no_split_hears_the_ships_or_the_noise_of_another():
    config = SceneConfig(ship_shares=(0.0, 0.0, 1.0))
    scenarios = [draw_scene(5, split, config).scenario for split in ("train", "validation", "test")]
    assert len({scenario.seed for scenario in scenarios}) == 3
    assert len({passage.ship.seed for scenario in scenarios for passage in scenario.passages}) == 6


def test_ships_keep_to_their_split():
    found = [split_of(mmsi) for mmsi in range(200_000_000, 200_002_000)]
    assert 0.75 < found.count("train") / 2000 < 0.85
    assert split_of(244000001) == split_of(244000001)


def test_a_record_of_the_twin_points_to_its_ship(tmp_path):
    data = TwinData(train=1, validation=0, test=0, courses=None, scene=LOUD)
    record = twin_record("train-1", "train", 1, data)
    near = np.flatnonzero(record.range_m[:, 0] < 60e3)
    cells, errors = record.cells(), []
    for minute in near[2:-2]:
        first = int(cell_index(record.minute[minute] - 90.0))
        window = cells.between(first, first + 9)
        weight = window.invariants[:, CHANNELS.index("focus_near")] ** 8
        phasor = (window.phasor * weight).sum()
        errors.append((np.rad2deg(np.angle(phasor)) - record.azimuth_deg[minute, 0] + 180) % 360 - 180)
    assert len(errors) > 20
    assert abs(np.median(errors)) < 15.0
    assert record.table()["delay"].sizes["path"] == 6
    assert 0.7 < np.nanstd(record.cepstra[200:, 20:]) < 1.4


def test_an_archive_is_prepared_like_the_twin_and_goes_on(tmp_path):
    start = parse_utc("2012-11-01") / 1e9
    scenario = Scenario.random(5, 1.2, 1, start, recorder=Recorder(depth_m=3000.0), nuisances=False)
    write_simulation(scenario, tmp_path / "archive")
    data = ArchiveData(
        waveforms=str(tmp_path / "archive" / "waveforms.mseed"), stationxml=str(tmp_path / "archive" / "station.xml"),
        ais=(str(tmp_path / "archive" / "ais.csv"),), start="2012-11-01T00:00:00Z", end="2012-11-01T01:00:00Z", hours=0.5,
    )  # fmt: skip
    made = prepare(tmp_path / "set", data)
    names = made.names()
    assert len(names) == 2 and not made.read(names[0]).absence_known
    before = {name: (made.folder / f"{name}.zarr").stat().st_mtime_ns for name in names}
    prepare(tmp_path / "set", data)
    assert before == {name: (made.folder / f"{name}.zarr").stat().st_mtime_ns for name in names}
    first = PreparedSet(tmp_path / "set").read(names[0])
    assert first.minute[0] == start and 85 <= len(first.cell_index) <= 100


def test_a_stretch_between_two_files_without_waveforms_is_passed_over(tmp_path):
    scenario = Scenario.random(5, 0.6, 1, START, recorder=Recorder(depth_m=3000.0), nuisances=False)
    write_simulation(scenario, tmp_path / "archive")
    (tmp_path / "files").mkdir()
    stream = obspy.read(str(tmp_path / "archive" / "waveforms.mseed"))
    for name, later in (("first", 0.0), ("second", 4 * 3600.0)):
        for trace in stream:
            trace.stats.starttime += later
        stream.write(str(tmp_path / "files" / f"{name}.mseed"), "MSEED")
    data = ArchiveData(
        waveforms=str(tmp_path / "files"), stationxml=str(tmp_path / "archive" / "station.xml"),
        ais=(str(tmp_path / "archive" / "ais.csv"),), start="2012-11-01T00:00:00Z", end="2012-11-01T05:00:00Z", hours=0.5,
    )  # fmt: skip
    names = prepare(tmp_path / "set", data).names()
    assert names == [f"archive-2012-11-01T{time}00" for time in ("0000", "0030", "0400", "0430")]


def test_an_archive_without_waveforms_says_why(tmp_path):
    scenario = Scenario.random(5, 0.6, 1, START, recorder=Recorder(depth_m=3000.0), nuisances=False)
    write_simulation(scenario, tmp_path / "archive")
    held = {name: str(tmp_path / "archive" / name) for name in ("waveforms.mseed", "station.xml", "ais.csv")}
    data = ArchiveData(
        waveforms=str(tmp_path / "nowhere"), stationxml=held["station.xml"], ais=(held["ais.csv"],),
        start="2012-11-01T00:00:00Z", end="2012-11-01T00:30:00Z", hours=0.5,
    )  # fmt: skip
    with pytest.raises(WaveformError, match="nowhere"):
        prepare(tmp_path / "set", data)
    early = replace(data, waveforms=held["waveforms.mseed"], start="2012-10-31T20:00:00Z")
    names = prepare(tmp_path / "other", early).names()
    assert "archive-2012-11-01T000000" in names and "archive-2012-10-31T230000" not in names


def test_the_paper_s_week_is_never_trained_on():
    from obsnet.learn.prepare import _archive_jobs

    data = ArchiveData(
        waveforms="x", stationxml="x", ais=("x",), start="2013-05-18T00:00:00Z", end="2013-05-30T00:00:00Z"
    )
    jobs = list(_archive_jobs(data))
    inside = [
        split for _, split, (start, stop) in jobs if stop > NEVER_TRAINED[0] and start < NEVER_TRAINED[1]
    ]
    assert len(inside) == 24 and set(inside) == {"test"}
    assert {split for _, split, _ in jobs} > {"test"}
