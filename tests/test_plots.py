"""Pictures of runs: what lies where on them, what is missing from them, and how they come from a folder."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.signal
import xarray as xr
from matplotlib import colormaps
from matplotlib.path import Path as Outline
from pyproj import Proj

from obsnet.ais import ReferenceTrack, write_plain
from obsnet.config import to_dict
from obsnet.detectors.maps import detections, presence
from obsnet.errors import AISError, ConfigError, LayoutError, OutputError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import from_posix, iso, to_posix
from obsnet.ocean.rays import propagation
from obsnet.pipeline import RunConfig
from obsnet.plots import FIGURES, draw, report, style
from obsnet.plots.columns import Columns, range_columns
from obsnet.plots.envelope import RANGE_STEP_M, observed_envelope
from obsnet.plots.figures import DAY_ROWS, MOST_COLUMNS, MOST_TRACKS, day_rows, figure
from obsnet.plots.overlay import heard, reference_heard
from obsnet.plots.panels import analytic_signal
from obsnet.plots.plan import ellipse
from obsnet.plots.report import drawing
from obsnet.run import Run, read_run
from obsnet.signals.station import Station
from obsnet.trackers.track import Segment, Track

START = 1369130400.0
STATION = Station("XX.SIM01", -21.4, 54.1, 4300.0)
COVARIANCE = np.diag([20.0, 300.0, 1.0, 0.1]) ** 2
COURSE = StraightCourse(START + 4 * 3600.0, -9e3, 70.0, 7.0)


def slow_delay(range_m):
    """Sound at 1500 m/s along the slant from 4300 m."""
    return np.hypot(range_m, 4300.0) / 1500.0


def track_of(course, start=START + 1800.0, end=START + 7 * 3600.0, bayes=500.0):
    return Track(start, end, course, COVARIANCE, bayes)


@pytest.fixture(scope="module")
def table():
    ocean = RunConfig().ocean
    return propagation(ocean.sound_speed(), STATION.depth_m, ocean.bottom, np.arange(0.0, 100e3, 500.0))


def make_run(table, tracks, hours=8.0, parts=("azimuth", "range"), step=60.0, gap=None):
    """A run whose maps hold a ridge along each track as heard (from a table of the sound's delay), and noise."""
    rng = np.random.default_rng(1)
    time = START + step * np.arange(1, int(hours * 3600 / step))
    azimuth, range_m, rate = (
        np.arange(0.0, 360.0, 2.0),
        np.arange(0.0, 50e3, 250.0),
        np.arange(-12.0, 12.1, 2.0),
    )
    bearing, ridge = np.full((len(time), 180), -20.0), np.full((len(time), len(range_m), len(rate)), -20.0)
    run = Run(STATION, RunConfig(), None, None, None, None, [], list(tracks), table)
    for found in tracks:
        emitted = np.linspace(found.start - 200.0, found.end, 5000)
        where = found.motion.observables(emitted)
        at = emitted + run.delay(where[1])
        inside = (time >= found.start) & (time <= found.end)
        east, north = np.sin(np.deg2rad(where[0])), np.cos(np.deg2rad(where[0]))
        a = np.rad2deg(np.arctan2(np.interp(time, at, east), np.interp(time, at, north)))[inside]
        r, v = np.interp(time, at, where[1])[inside], np.interp(time, at, where[2])[inside]
        bearing[inside] += 30.0 * np.exp(-0.5 * (wrap180(azimuth - a[:, None]) / 8.0) ** 2)
        near = np.exp(-0.5 * ((range_m - r[:, None]) / 400.0) ** 2)
        ridge[inside] += 35.0 * near[:, :, None] * np.exp(-0.5 * ((rate - v[:, None]) / 2.0) ** 2)[:, None, :]
    maps, features = {}, {}
    power = rng.exponential(1e-4, (len(time), 20))
    features["power"] = (("time", "spectrogram_frequency"), power, {"units": "Pa2"})
    if "azimuth" in parts:
        maps["azimuth_llr"] = (("time", "azimuth"), bearing.astype(np.float32))
        maps["azimuth_coverage"] = ("time", np.ones(len(time), np.float32))
        features["azigram"] = (
            ("time", "frequency"),
            np.exp(2j * np.pi * rng.random((len(time), 30))).astype("c8"),
        )
    if "range" in parts:
        maps["range_llr"] = (("time", "range", "range_rate"), ridge.astype(np.float32))
        maps["range_coverage"] = ("time", np.ones(len(time), np.float32))
        features["cepstrogram"] = (("time", "quefrency"), rng.normal(0, 0.02, (len(time), 513)).astype("f4"))
    coordinates = {"time": from_posix(time), "azimuth": azimuth, "range": range_m, "range_rate": rate}
    run.maps = xr.Dataset(maps).pipe(
        lambda d: d.assign_coords({k: v for k, v in coordinates.items() if k in d.dims})
    )
    grids = {"spectrogram_frequency": np.linspace(0.5, 24.5, 20), "frequency": np.linspace(11.0, 24.0, 30),
             "quefrency": 0.02 * np.arange(513), "time": from_posix(time)}  # fmt: skip
    run.features = xr.Dataset(features).pipe(
        lambda d: d.assign_coords({k: v for k, v in grids.items() if k in d.dims})
    )
    if gap is not None:
        keep = (time < gap[0]) | (time > gap[1])
        run.maps, run.features = run.maps.isel(time=keep), run.features.isel(time=keep)
    run.presence = presence(run.maps)
    run.detections = detections(run.maps, run.presence)
    run.segments = [Segment(t.start, t.end, t.motion.cpa_time) for t in tracks]
    place = {key: getattr(STATION, key) for key in ("code", "latitude", "longitude", "depth_m")}
    spans = [{key: iso(getattr(s, key)) for key in ("start", "end", "cpa")} for s in run.segments]
    run.info = {"station": place, "config": to_dict(run.config), "segments": spans, "notes": []}
    return run


def empty_run(table):
    run = make_run(table, [], hours=0.5)
    none = slice(0, 0)
    run.maps, run.features = run.maps.isel(time=none), run.features.isel(time=none)
    run.detections, run.presence = run.detections.iloc[none], run.presence.iloc[none]
    return run


def reference_of(course, start=START - 3600.0, hours=10.0):
    time = start + np.arange(0.0, hours * 3600.0, 300.0)
    east, north = course.position(time)
    return ReferenceTrack(123456789, "SHIP", time, east, north, time[0], time[-1])


def texts(made):
    return [text.get_text() for ax in made.axes for text in ax.texts] + [
        text.get_text() for text in made.texts
    ]


def panel(made, label):
    return next(ax for ax in made.axes if ax.get_ylabel() == label and ax.images)


@pytest.fixture(scope="module")
def run(table):
    return make_run(table, [track_of(COURSE)])


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    run.write(folder)
    return folder


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "run"))


def test_heard_is_where_the_ship_was_when_the_sound_left():
    curve = heard(track_of(COURSE), slow_delay)
    emitted = np.linspace(START - 100.0, START + 8 * 3600.0, 200_000)
    azimuth, distance, _ = COURSE.observables(emitted)
    at = emitted + slow_delay(distance)
    np.testing.assert_allclose(curve.range_m, np.interp(curve.time, at, distance), atol=0.5)
    np.testing.assert_allclose(wrap180(curve.azimuth - np.interp(curve.time, at, azimuth)), 0.0, atol=1e-3)
    assert np.abs(curve.range_m - COURSE.observables(curve.time)[1]).max() > 50.0


def test_heard_range_rate_is_that_of_the_heard_range():
    curve = heard(track_of(COURSE), slow_delay)
    slope = np.gradient(curve.range_m, curve.time)
    np.testing.assert_allclose(curve.range_rate[1:-1], slope[1:-1], atol=0.01)


def test_track_and_ais_of_one_course_are_heard_alike():
    curve = heard(track_of(COURSE), slow_delay)
    ship = reference_heard(reference_of(COURSE), slow_delay, curve.time[0], curve.time[-1])
    np.testing.assert_allclose(np.interp(curve.time, ship.time, ship.range_m), curve.range_m, atol=10.0)


def test_no_azimuth_line_crosses_the_panel_at_north():
    northbound = StraightCourse(START + 4 * 3600.0, 5e3, 270.0, 8.0)
    curve = heard(track_of(northbound), slow_delay)
    assert np.abs(np.diff(curve.azimuth)).max() > 300.0
    _, azimuth = curve.on("azimuth")
    steps = np.abs(np.diff(azimuth))
    assert steps[np.isfinite(steps)].max() < 180.0
    assert np.isnan(azimuth).sum() == 1


def test_ellipse_holds_ninety_percent_of_the_positions():
    rng = np.random.default_rng(2)
    turn = np.array([[1.0, 0.6, 0.2, 0], [0.6, 1.0, 0.3, 0], [0.2, 0.3, 1.0, 0], [0, 0, 0, 1.0]])
    std = np.array([40.0, 200.0, 1.5, 0.1])
    covariance = std[:, None] * turn * std
    track = Track(START, START + 3600.0, COURSE, covariance, 1.0)
    draws = rng.multivariate_normal([COURSE.cpa_time, COURSE.cpa_range_m, COURSE.course_deg, COURSE.speed_mps],
                                    covariance, 20_000)  # fmt: skip
    east, north = np.array([StraightCourse(*d).position(COURSE.cpa_time) for d in draws]).T
    outline = np.stack(ellipse(track))
    centre = outline[:, :-1].mean(axis=1)
    share = Outline(outline.T).contains_points(np.stack([east, north], axis=1)).mean()
    assert share == pytest.approx(0.90, abs=0.01)
    np.testing.assert_allclose(centre, COURSE.position(COURSE.cpa_time), atol=1.0)


@pytest.mark.parametrize("most", [1, 7, 60, 1000])
def test_column_means_against_a_loop(most):
    rng = np.random.default_rng(3)
    seconds = START + 60.0 * np.concatenate([np.arange(50), np.arange(80, 120)])
    values = rng.normal(size=(90, 4)).astype(np.float32)
    values[10:14] = np.nan
    columns = Columns.over(from_posix(seconds), most)
    mean = columns.mean(xr.DataArray(values, dims=("time", "cell")))
    assert columns.count == min(most, 120)
    width = 120 * 60.0 / columns.count
    for i in range(columns.count):
        left = START - 30.0 + i * width
        inside = (seconds >= left - 1e-3) & (seconds < left + width - 1e-3)
        kept = values[inside][~np.isnan(values[inside]).any(axis=1)]
        wanted = kept.mean(axis=0) if len(kept) else np.full(4, np.nan)
        np.testing.assert_allclose(mean[i], wanted, rtol=1e-4, atol=1e-5)


def test_a_column_shows_its_strongest_minute():
    weight = np.array([0.0, 5.0, np.nan, np.nan, -3.0, -7.0, np.nan])
    columns = Columns.over(from_posix(START + 60.0 * np.arange(6)), 3)
    assert columns.strongest(weight[:6]).tolist() == [1, -1, 4]


def test_columns_of_a_window_count_minutes_of_the_whole_run():
    time = from_posix(START + 60.0 * np.arange(100))
    columns = Columns.over(time, 10, START + 1200.0, START + 1790.0)
    assert (columns.first, len(columns.column), columns.count) == (20, 10, 10)
    assert columns.strongest(np.arange(100.0)).tolist() == list(range(20, 30))
    assert Columns.over(time, 10, START + 1e5, START + 2e5) is None


@pytest.mark.parametrize("most", [479, 40])
def test_range_map_from_disk_is_the_map_in_memory(run, written, most):
    on_disk = read_run(written)
    assert "range_llr" in on_disk.maps and not on_disk.maps["range_llr"].variable._in_memory
    columns = Columns.over(run.maps["time"].values, most)
    weight = run.detections["range_llr"].to_numpy(float)
    values = range_columns(on_disk.maps, on_disk.features, columns, weight)
    llr = run.maps["range_llr"].values.astype(float)[columns.strongest(weight)]
    np.testing.assert_allclose(values, np.log(np.exp(llr).mean(axis=2)), atol=0.03)


def test_minutes_without_data_stay_blank_from_disk(run, tmp_path):
    holed = Run(**vars(run))
    holed.maps = run.maps.copy(deep=True)
    holed.maps["range_llr"][100:140] = np.nan
    holed.write(tmp_path)
    columns = Columns.over(run.maps["time"].values, 1000)
    back = read_run(tmp_path)
    values = range_columns(back.maps, back.features, columns, np.zeros(len(run.detections)))
    assert (
        np.isnan(values[100:140]).all()
        and np.isfinite(values[:100]).all()
        and np.isfinite(values[140:]).all()
    )


def test_report_puts_the_track_on_the_ridge_of_both_maps(run, tmp_path):
    made = report(run, tmp_path / "report.png")
    for label, tolerance in (("azimuth [°]", 3.0), ("range [km]", 0.5)):
        ax = panel(made, label)
        picture = ax.images[0]
        left, right, low, high = picture.get_extent()
        assert left * 86400.0 == pytest.approx(START + 30.0, abs=0.1)
        values = np.asarray(picture.get_array(), float)
        rows, columns = values.shape
        line = next(line for line in ax.lines if line.get_color() == style.track_style(0)["color"])
        x, y = line.get_data()
        shown = np.flatnonzero((y > low) & (y < high) & np.isfinite(x))[5:-5:20]
        column = ((x[shown] - left) / (right - left) * columns).astype(int)
        ridge = low + (np.nanargmax(values[:, column], axis=0) + 0.5) * (high - low) / rows
        assert len(shown) > 5
        np.testing.assert_allclose(ridge, y[shown], atol=tolerance)
    assert (tmp_path / "report.png").read_bytes()[:4] == b"\x89PNG"
    assert [path.name for path in tmp_path.iterdir()] == ["report.png"]


def test_a_report_drawn_in_steps_is_the_same_picture(run, table, tmp_path):
    """What is painted early is not painted again; nothing of the later parts may be lost, or hide what was there."""
    from matplotlib.image import imread

    for number, made in enumerate((run, empty_run(table))):
        found, heard = (
            (made.segments, made.tracks, made.info),
            Run(**{**vars(made), "tracks": [], "segments": []}),
        )
        reference = [reference_of(COURSE)]
        report(made, tmp_path / f"whole-{number}.png", reference)
        steps = drawing(tmp_path / f"steps-{number}.png", reference)
        next(steps)
        steps.send(heard)
        with pytest.raises(StopIteration):
            steps.send(found)
        whole, stepped = (imread(tmp_path / f"{name}-{number}.png")[..., :3] for name in ("whole", "steps"))
        differs = np.abs(whole - stepped).max(axis=2) > 0.2
        assert differs.mean() < 0.002


def test_report_puts_detections_and_ais_where_they_are_heard(run):
    made = report(run, reference=[reference_of(COURSE)])
    ax = panel(made, "range [km]")
    dots = next(line for line in ax.lines if line.get_marker() == "o")
    found = run.detections["range_m"].dropna()
    np.testing.assert_allclose(dots.get_ydata(), found / 1e3)
    dashed = next(line for line in ax.lines if line.get_linestyle() == "--" and line.get_color() == "black")
    x, y = dashed.get_data()
    track = heard(run.tracks[0], run.delay)
    np.testing.assert_allclose(np.interp(track.time, x * 86400.0, y), track.range_m / 1e3, atol=0.05)
    assert any("AIS (1 ship)" in text.get_text() for axes in made.axes if (legend := axes.get_legend()) is not None
               for text in legend.get_texts())  # fmt: skip


def test_spectrogram_is_a_power_spectral_density(run):
    picture = panel(report(run), "frequency [Hz]").images[0]
    level = np.asarray(picture.get_array(), float)
    mean_square = 1e-4 / 2.0
    bandwidth = 1.5 / run.config.spectra.window_s
    mean_level = 10.0 * np.log10(np.mean(10.0 ** (level / 10.0)))
    assert mean_level == pytest.approx(10.0 * np.log10(mean_square / bandwidth) + 120.0, abs=0.2)
    assert "dB re 1 µPa²/Hz" in [ax.get_ylabel() for ax in report(run).axes]


def test_gap_of_hours_is_a_blank_of_hours(table):
    gap = START + 2 * 3600.0, START + 5 * 3600.0
    made = report(make_run(table, [track_of(COURSE)], gap=gap))
    picture = panel(made, "azimuth [°]").images[0]
    blank = np.ma.getmaskarray(picture.get_array()).all(axis=0)
    left, right = picture.get_extent()[:2]
    centre = (left + (np.arange(len(blank)) + 0.5) * (right - left) / len(blank)) * 86400.0
    np.testing.assert_array_equal(blank, (centre > gap[0] - 1.0) & (centre < gap[1] + 1.0))


@pytest.mark.parametrize(("parts", "said"), [(("azimuth",), "no range"), (("range",), "no azimuth")])
def test_a_missing_half_is_said_and_the_rest_drawn(table, parts, said):
    track = track_of(COURSE)
    if parts == ("range",):
        track = Track(track.start, track.end, StraightCourse(COURSE.cpa_time, 9e3, 0.0, 7.0),
                      np.diag([400.0, 9e4, np.inf, 0.01]), 50.0)  # fmt: skip
    half = make_run(table, [track], hours=7.5, parts=parts)
    assert any(said in text for text in texts(report(half)))
    for number in FIGURES:
        made = figure(half, number)
        made.canvas.draw()
        assert any(ax.images or ax.lines for ax in made.axes) or number in (3, 6)
        if number in (7, 8):
            assert any(said in text for text in texts(made))


def test_unobserved_course_is_a_circle_at_the_closest_distance(table):
    motion = StraightCourse(COURSE.cpa_time, 9e3, 0.0, 7.0)
    track = Track(START + 1800.0, START + 7 * 3600.0, motion, np.diag([400.0, 9e4, np.inf, 0.01]), 50.0)
    made = report(make_run(table, [track], parts=("range",)))
    plan = next(ax for ax in made.axes if ax.get_xlabel() == "east [km]")
    colour = style.track_style(0)["color"]
    (line,) = [line for line in plan.lines if line.get_color() == colour]
    np.testing.assert_allclose(np.hypot(*line.get_data()), 9.0)
    assert not plan.patches


@pytest.mark.parametrize("number", FIGURES)
def test_no_ship_and_no_minute_are_drawn_and_said(table, number):
    quiet = make_run(table, [], hours=2.0)
    figure(quiet, number).canvas.draw()
    assert any("no minute of data" in text for text in texts(figure(empty_run(table), number)))


def test_reports_of_silence(table):
    assert any("no ship found" in text for text in texts(report(make_run(table, [], hours=2.0))))
    assert any("no minute of data" in text for text in texts(report(empty_run(table))))


def test_one_minute_is_enough(table):
    short = make_run(table, [], hours=0.034)
    assert short.maps.sizes["time"] == 1
    report(short).canvas.draw()
    for number in FIGURES:
        figure(short, number).canvas.draw()


def test_many_ships_and_days_stay_small(table):
    courses = [
        StraightCourse(START + (6.0 + 8.0 * i) * 3600.0, (-1) ** i * 8e3, 23.0 * i, 7.0) for i in range(16)
    ]
    ships = [track_of(c, c.cpa_time - 9e3, c.cpa_time + 9e3, bayes=float(i)) for i, c in enumerate(courses)]
    long = make_run(table, ships, hours=10 * 24.0, step=600.0)
    made = report(long)
    assert max(ax.images[0].get_size()[1] for ax in made.axes if ax.images) <= MOST_COLUMNS
    assert any("more, in tracks.csv" in text for text in texts(made))
    days = figure(long, 7)
    assert sum(ax.get_ylabel() == "azimuth [°]" for ax in days.axes) <= DAY_ROWS
    assert max(days.get_size_inches()) < 40.0
    tracks = figure(long, 8)
    shown = [ax.get_title(loc="left") for ax in tracks.axes if ax.get_title(loc="left").startswith("track")]
    assert len(shown) == MOST_TRACKS and shown[-1].startswith("track 16") and shown[0].startswith("track 5")


def test_rows_of_days_hold_the_run():
    for days in (0.2, 1.0, 1.5, 8.0, 31.0, 400.0):
        for offset in (0.0, 0.3, 0.99):
            start = 86400.0 * (15846.0 + offset)
            rows, length = day_rows(start, start + days * 86400.0)
            assert len(rows) <= DAY_ROWS
            assert rows[0] <= start and rows[-1] < start + days * 86400.0 <= rows[-1] + length + 1e-6
            assert days <= 1.0 or (rows[0] % 86400.0 == 0 and length % 86400.0 == 0)


@pytest.mark.parametrize("span", [90.0, 600.0, 8 * 3600.0, 86400.0, 31 * 86400.0, 900 * 86400.0, 2e9])
def test_ticks_of_time_are_few_round_and_dated(span):
    ax = style.figure(4, 4).add_axes((0.1, 0.1, 0.8, 0.8))
    style.time_axis(ax, START + 17.0, START + 17.0 + span)
    ticks = np.asarray(ax.get_xticks()) * 86400.0
    labels = [label.get_text() for label in ax.get_xticklabels()]
    assert 1 <= len(ticks) <= 9
    np.testing.assert_allclose(ticks % 60.0 % 59.999, 0.0, atol=0.01)
    assert labels[0].endswith(iso(float(round(ticks[0])))[:10])


def test_observed_envelope_stacks_minutes_at_the_range_heard(table):
    run = make_run(table, [track_of(COURSE)])
    time = to_posix(run.features["time"].values)
    curve = heard(run.tracks[0], run.delay)
    distance = np.interp(time, curve.time, curve.range_m, left=np.nan, right=np.nan)
    minutes = np.flatnonzero(np.abs(distance - 20e3) < 240.0)
    run.features["cepstrogram"][minutes] = 0.0
    run.features["cepstrogram"][minutes, 150] = 0.5
    grid = np.arange(0.0, 50e3 + 1.0, RANGE_STEP_M)
    envelope = observed_envelope(run, [], grid)
    peak = envelope.sel(quefrency=3.0, method="nearest")
    assert float(peak.idxmax("range")) == 20e3
    assert float(peak.max()) == pytest.approx(0.5, rel=0.01)
    assert np.isnan(envelope.sel(range=5e3)).all()
    known = observed_envelope(run, [reference_of(COURSE)], grid).sel(quefrency=3.0, method="nearest")
    assert float(known.idxmax("range")) == 20e3


@pytest.mark.parametrize("count", [512, 513])
def test_analytic_signal_is_scipys(count):
    values = np.random.default_rng(4).normal(size=(3, count))
    np.testing.assert_allclose(analytic_signal(values), scipy.signal.hilbert(values, axis=1), atol=1e-12)


def test_run_comes_back_from_its_folder(run, written):
    back = read_run(written)
    assert back.station.code == "XX.SIM01" and back.station.depth_m == 4300.0
    assert back.config == run.config and back.segments == run.segments
    (track,) = back.tracks
    assert track.motion.cpa_range_m == pytest.approx(-9e3, rel=1e-4)
    assert track.motion.cpa_time == pytest.approx(COURSE.cpa_time, abs=0.01)
    assert track.motion.course_deg == pytest.approx(70.0) and track.start == run.tracks[0].start
    np.testing.assert_allclose(track.covariance, COVARIANCE, rtol=1e-4)
    np.testing.assert_allclose(back.detections["range_m"], run.detections["range_m"], atol=0.06)
    np.testing.assert_allclose(back.maps["azimuth_llr"], run.maps["azimuth_llr"], rtol=1e-6)
    np.testing.assert_allclose(back.features["azigram"], run.features["azigram"], rtol=1e-6)


def test_unobserved_course_comes_back_unobserved(table, tmp_path):
    motion = StraightCourse(COURSE.cpa_time, 9e3, 0.0, 7.0)
    track = Track(START, START + 3600.0, motion, np.diag([400.0, 9e4, np.inf, 0.01]), 50.0)
    make_run(table, [track], hours=1.0, parts=("range",)).write(tmp_path)
    assert np.isinf(read_run(tmp_path).tracks[0].std[2])


def test_figures_from_a_folder_with_ais(folder):
    ship = reference_of(COURSE)
    plane = Proj(proj="aeqd", lat_0=STATION.latitude, lon_0=STATION.longitude, datum="WGS84")
    longitude, latitude = plane(ship.east_m, ship.north_m, inverse=True)
    ais = pd.DataFrame({"mmsi": ship.mmsi, "time": from_posix(ship.time), "lon": longitude, "lat": latitude})
    write_plain(ais, folder / "ais.csv")
    made = draw(folder, FIGURES, folder / "ais.csv")
    assert [path.name for path in made] == [f"figure-{number}.png" for number in (3, 5, 6, 7, 8)]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in made)
    assert not list(folder.glob(".*"))


def test_figures_of_a_run_without_minutes(table, tmp_path):
    empty_run(table).write(tmp_path)
    assert len(draw(tmp_path, FIGURES)) == 5


def test_folders_that_are_none_are_named(folder, tmp_path):
    with pytest.raises(LayoutError, match="nowhere is not a folder of `obsnet track`: the folder is missing"):
        draw(tmp_path / "nowhere", [3])
    with pytest.raises(LayoutError, match=r"not a folder of `obsnet track`: detections\.csv is missing"):
        draw(tmp_path, [3])
    (folder / "maps.nc").rename(folder / "kept")
    with pytest.raises(LayoutError, match=r"not a folder of `obsnet track`: maps\.nc is missing"):
        draw(folder, [3])
    (folder / "maps.nc").write_bytes(b"not netCDF")
    with pytest.raises(LayoutError, match="does not hold a run of this obsnet"):
        draw(folder, [3])
    (folder / "kept").rename(folder / "maps.nc")
    lines = (folder / "detections.csv").read_text().splitlines()
    (folder / "detections.csv").write_text("\n".join(lines[:-5]))
    with pytest.raises(LayoutError, match=r"maps\.nc holds 479 minutes, detections\.csv 474"):
        draw(folder, [3])


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"station": 3}', "not JSON"])
def test_a_damaged_description_is_named(folder, text):
    (folder / "run.json").write_text(text)
    with pytest.raises(LayoutError, match="does not hold a run of this obsnet"):
        read_run(folder)


def test_a_description_of_another_version_is_named(folder):
    info = json.loads((folder / "run.json").read_text())
    info["config"]["wizardry"] = 3
    (folder / "run.json").write_text(json.dumps(info))
    with pytest.raises(LayoutError, match="unknown key 'wizardry'"):
        read_run(folder)


def test_wrong_requests_are_named(run, written, tmp_path):
    with pytest.raises(ConfigError, match="no figure 4; choose among 3, 5, 6, 7, 8"):
        draw(tmp_path, [4])
    with pytest.raises(OutputError, match=r"cannot write .*nowhere/report\.png: No such file"):
        report(run, tmp_path / "nowhere" / "report.png")
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*taken\.png"):
        report(run, tmp_path / "taken.png")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.png"]
    with pytest.raises(AISError):
        draw(written, [3], tmp_path / "no.csv")


def test_colours_survive_print_in_grey():
    def grey(name):
        red, green, blue, _ = colormaps[name](np.linspace(0, 1, 64)).T
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    assert (np.diff(grey(style.SEQUENTIAL)) > 0).all()
    cyclic = colormaps[style.CYCLIC]
    np.testing.assert_allclose(cyclic(0.0), cyclic(1.0), atol=0.02)
    looks = {tuple(style.track_style(n).values()) for n in range(15)}
    assert len(looks) == 15


def test_nothing_is_laid_over_a_map_that_is_not_there(table):
    half = make_run(table, [track_of(COURSE)], parts=("azimuth",))
    made = report(half, reference=[reference_of(COURSE)])
    (ax,) = [ax for ax in made.axes if ax.get_ylabel() == "range [km]"]
    assert not any(len(line.get_xdata()) for line in ax.lines)


def test_a_run_without_tracking_does_not_claim_that_no_ship_was_found(table):
    untracked = make_run(table, [], hours=1.0)
    untracked.info["seconds"] = {"detect": 1.0}
    said = " ".join(texts(report(untracked)))
    assert "detections only" in said and "no ship" not in said
