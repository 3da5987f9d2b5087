import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from obsnet.ais import ReferenceTrack, write_plain
from obsnet.ais.tracks import reference_tracks
from obsnet.config import to_dict
from obsnet.errors import ConfigError, LayoutError
from obsnet.evaluation import DetectionCriteria, MatchGates, evaluate, evaluate_folder, match_tracks
from obsnet.evaluation.detections import smad
from obsnet.kinematics import BentCourse, StraightCourse, wrap180
from obsnet.layout import from_posix, iso

T0 = 1369130400.0
MINUTES = T0 + 60.0 * np.arange(-300, 301)
FIRST = StraightCourse(T0, 10e3, 60.0, 7.0)
SECOND = StraightCourse(T0 + 3000.0, -6e3, 240.0, 9.0)


def delay(range_m):
    return np.hypot(range_m, 4340.0) / 1500.0


def ship(course: StraightCourse, mmsi: int = 1, radius: float = 60e3) -> ReferenceTrack:
    half = np.sqrt(radius**2 - course.cpa_range_m**2) / course.speed_mps
    times = course.cpa_time + np.linspace(-1.2 * half, 1.2 * half, 200)
    east, north = course.position(times)
    return ReferenceTrack(
        mmsi,
        f"SHIP {mmsi}",
        times,
        east,
        north,
        course.cpa_time - half,
        course.cpa_time + half,
        attributes={},
    )


def detections(azimuth=np.nan, range_m=np.nan, rate=np.nan, coverage=1.0, times=MINUTES) -> pd.DataFrame:
    columns = {"coverage": coverage, "azimuth_deg": azimuth, "range_m": range_m, "range_rate_mps": rate}
    table = {name: np.broadcast_to(values, times.shape) for name, values in columns.items()}
    return pd.DataFrame({"time": from_posix(times), **table, "azimuth_deg": table["azimuth_deg"] % 360.0})


def tracks(*courses: StraightCourse) -> pd.DataFrame:
    rows = [
        {
            "track": i,
            "cpa_time": iso(course.cpa_time),
            "cpa_distance_m": abs(course.cpa_range_m),
            "cpa_azimuth_deg": course.cpa_azimuth_deg,
            "course_deg": course.course_deg,
            "speed_mps": course.speed_mps,
        }
        for i, course in enumerate(courses, 1)
    ]
    empty = ["track", "cpa_time", "cpa_distance_m", "cpa_azimuth_deg", "course_deg", "speed_mps"]
    return pd.DataFrame(rows, columns=empty)


def heard(course: StraightCourse, times=MINUTES):
    """Emission times on a fine grid, delayed forward, interpolated back."""
    emitted = np.arange(times[0] - 900, times[-1] + 900, 5.0)
    azimuth, distance, _ = course.observables(emitted)
    received = emitted + delay(distance)
    unwrapped = np.rad2deg(np.unwrap(np.deg2rad(azimuth)))
    fine = np.interp(times, received, distance)
    return np.interp(times, received, unwrapped), fine, np.gradient(fine, times)


def test_known_errors_give_known_spreads():
    azimuth, distance, rate = heard(FIRST)
    rng = np.random.default_rng(1)
    a, r, v = rng.normal(0, 4, 601), rng.normal(0, 300, 601), rng.normal(0, 0.2, 601)
    result = evaluate(detections(azimuth + a, distance + r, rate + v), tracks(), [ship(FIRST)], delay)
    row = result.ships[0]
    present = distance <= 60e3 - 1
    assert row.azimuth_n == present.sum() and row.range_n == present.sum()
    assert row.azimuth_smad_deg == pytest.approx(1.4826 * np.median(abs(a[present])), abs=0.05)
    assert row.range_smad_m == pytest.approx(1.4826 * np.median(abs(r[present])), abs=5)
    assert row.range_rate_smad_mps == pytest.approx(1.4826 * np.median(abs(v[present])), abs=0.01)
    assert row.azimuth_smad_deg == pytest.approx(4.0, rel=0.15)
    assert (result.total.azimuth_n, result.total.range_n) == (row.azimuth_n, row.range_n)


def test_only_detections_within_the_gates_count():
    azimuth, distance, rate = heard(FIRST)
    table = detections(azimuth, distance, rate)
    table.loc[table.index[200:210], "azimuth_deg"] = (azimuth[200:210] + 50) % 360
    table.loc[table.index[210:230], "range_m"] += 6000.0
    table.loc[table.index[230:235], "range_rate_mps"] += 3.5
    table.loc[table.index[235:238], ["azimuth_deg", "range_m", "range_rate_mps"]] = np.nan
    whole = evaluate(detections(azimuth, distance, rate), tracks(), [ship(FIRST)], delay).ships[0]
    row = evaluate(table, tracks(), [ship(FIRST)], delay).ships[0]
    assert (whole.azimuth_n - row.azimuth_n, whole.range_n - row.range_n) == (13, 28)


def test_travel_time_is_not_charged_to_the_detector():
    azimuth, distance, rate = heard(FIRST)
    with_delay = evaluate(detections(azimuth, distance, rate), tracks(), [ship(FIRST)], delay).ships[0]
    without = evaluate(detections(azimuth, distance, rate), tracks(), [ship(FIRST)]).ships[0]
    assert with_delay.range_smad_m < 1 and with_delay.range_rate_smad_mps < 0.01
    assert without.range_smad_m > 100


def test_azimuth_wraps_at_north():
    course = StraightCourse(T0, 10e3, 270.0, 7.0)
    azimuth, distance, rate = heard(course)
    row = evaluate(detections(azimuth + 3.0, distance, rate), tracks(), [ship(course)], delay).ships[0]
    assert row.azimuth_smad_deg == pytest.approx(3.0 * 1.4826, abs=0.01)


def test_two_ships_are_each_compared_and_the_last_row_counts_once():
    azimuth, distance, rate = heard(FIRST)
    table = detections(azimuth, distance, rate)
    result = evaluate(table, tracks(), [ship(FIRST, 1), ship(SECOND, 2)], delay)
    other = heard(SECOND)
    near = np.abs(wrap180(azimuth - other[0])) < 45
    inside = other[1] <= 60e3 - 1
    assert result.ships[1].azimuth_n == (near & inside).sum() > 0
    assert result.total.azimuth_n == len(table[(distance <= 60e3 - 1) | (near & inside)])
    assert result.total.azimuth_n < sum(row.azimuth_n for row in result.ships)


def test_minutes_right_wrong_and_false():
    azimuth, distance, rate = heard(FIRST)
    here = distance <= 60e3 - 1
    table = detections(np.where(here, azimuth, np.nan), np.where(distance < 50e3, distance, np.nan), rate)
    perfect = evaluate(table, tracks(), [ship(FIRST)], delay).minutes
    assert perfect["azimuth"]["right"] == perfect["range"]["right"] == 1.0
    assert perfect["azimuth"]["wrong_or_false_per_hour"] == 0.0
    assert (distance <= 50e3).sum() == perfect["range"]["minutes"] < perfect["azimuth"]["minutes"]
    lucky = np.flatnonzero(here)
    table.loc[lucky[:30], "azimuth_deg"] = (azimuth[lucky[:30]] + 11) % 360
    table.loc[np.flatnonzero(~here)[:7], "azimuth_deg"] = 5.0
    table.loc[np.flatnonzero(distance < 30e3)[:20], "range_m"] += 950.0
    scores = evaluate(table, tracks(), [ship(FIRST)], delay).minutes
    assert scores["azimuth"]["right"] == pytest.approx(1 - 30 / here.sum())
    assert scores["azimuth"]["right_estimates"] == pytest.approx((here.sum() - 30) / (here.sum() + 7))
    assert scores["azimuth"]["wrong_or_false_per_hour"] == pytest.approx(37 / (601 / 60))
    wrong = (np.maximum(500, 0.03 * distance[distance < 30e3][:20]) < 950.0).sum()
    assert scores["range"]["right"] == pytest.approx(1 - wrong / (distance <= 50e3).sum()) and wrong == 20


def test_gaps_in_the_record_are_nobodys_fault():
    azimuth, _, _ = heard(FIRST)
    covered = np.abs(MINUTES - T0) > 3600
    table = detections(np.where(covered, azimuth, np.nan), np.nan, np.nan, covered.astype(float))
    result = evaluate(table, tracks(), [ship(FIRST)], delay)
    assert result.minutes["azimuth"]["right"] == 1.0
    assert result.missed == () and not result.ships[0].expected
    assert evaluate(detections(), tracks(), [ship(FIRST)], delay).missed == (1,)


def test_ships_outside_the_record_are_left_out():
    later = ship(StraightCourse(T0 + 86400.0, 10e3, 60.0, 7.0), 2)
    result = evaluate(detections(), tracks(), [ship(FIRST), later], delay)
    assert [row.mmsi for row in result.ships] == [1]
    leaving = ship(StraightCourse(MINUTES[0] - 600.0, 10e3, 60.0, 7.0), 3)
    result = evaluate(detections(), tracks(), [leaving], delay)
    assert len(result.ships) == 1 and result.missed == ()


def test_tracker_errors_against_the_line_through_ais():
    found = StraightCourse(T0 + 40.0, 10.3e3, 58.5, 7.2)
    row = evaluate(detections(), tracks(found), [ship(FIRST)], delay).ships[0]
    assert row.track == 1
    assert row.cpa_time_error_s == pytest.approx(40.0, abs=1e-3)
    assert row.course_error_deg == pytest.approx(-1.5, abs=1e-6)
    assert row.cpa_distance_error_m == pytest.approx(300.0, abs=1e-3)
    assert row.speed_error_mps == pytest.approx(0.2, abs=1e-6)
    assert row.cpa_azimuth_error_deg == pytest.approx(-1.5, abs=1e-6)


def test_matching_is_one_to_one_and_best_overall():
    close = StraightCourse(T0 + 500.0, 9e3, 65.0, 7.5)
    better = StraightCourse(T0 + 10.0, 10.1e3, 61.0, 7.1)
    ghost = StraightCourse(T0 - 9000.0, 5e3, 10.0, 8.0)
    result = evaluate(
        detections(), tracks(close, ghost, better, SECOND), [ship(FIRST), ship(SECOND, 2)], delay
    )
    assert [row.track for row in result.ships] == [3, 4]
    assert result.false_tracks == (1, 2) and result.missed == ()


def test_as_many_ships_as_possible_are_matched():
    lines = [StraightCourse(T0, 5e3, 0.0, 7.0), StraightCourse(T0 + 1500.0, 5e3, 0.0, 7.0)]
    table = tracks(StraightCourse(T0 + 100.0, 5e3, 0.0, 7.0), StraightCourse(T0 - 1700.0, 5e3, 0.0, 7.0))
    assert match_tracks(table, lines) == {1: 0, 0: 1}


@pytest.mark.parametrize(
    "wrong",
    [
        StraightCourse(T0 + 1900.0, 10e3, 60.0, 7.0),
        StraightCourse(T0, 21e3, 60.0, 7.0),
        StraightCourse(T0, 10e3, 110.0, 7.0),
        StraightCourse(T0, 10e3, 60.0, 12.5),
    ],
)
def test_outside_any_gate_is_a_false_track_and_a_missed_ship(wrong):
    result = evaluate(detections(), tracks(wrong), [ship(FIRST)], delay)
    assert (result.false_tracks, result.missed) == ((1,), (1,))


def test_ships_that_pass_far_off_may_be_found_but_are_not_missed():
    """CPA of 10 km against a limit of 5: found it counts, unheard it has no row."""
    limit = {"expected_cpa_m": 0.5 * abs(FIRST.cpa_range_m)}
    unheard = evaluate(detections(), tracks(), [ship(FIRST)], delay, **limit)
    assert (unheard.ships, unheard.missed) == ((), ())
    found = evaluate(detections(), tracks(FIRST), [ship(FIRST)], delay, **limit)
    assert (found.false_tracks, found.missed, found.ships[0].track) == ((), (), 1)


def test_what_a_track_does_not_observe_is_not_held_against_it():
    table = tracks(FIRST).assign(course_deg=np.nan, cpa_azimuth_deg=np.nan)
    row = evaluate(detections(), table, [ship(FIRST)], delay).ships[0]
    assert (
        row.track == 1
        and np.isnan(row.course_error_deg)
        and row.speed_error_mps == pytest.approx(0, abs=1e-6)
    )


def test_last_row_is_the_spread_over_ships():
    found = [StraightCourse(T0 + 30.0, 10e3, 60.0, 7.0), StraightCourse(T0 + 3050.0, -6e3, 240.0, 9.0)]
    total = evaluate(detections(), tracks(*found), [ship(FIRST), ship(SECOND, 2)], delay).total
    assert total.cpa_time_error_s == pytest.approx(1.4826 * 40.0, abs=0.01)


def test_stated_uncertainties_are_checked():
    from obsnet.trackers.track import Track

    rng = np.random.default_rng(7)
    std = np.array([20.0, 300.0, 1.0, 0.1])
    mixing = np.linalg.cholesky(0.5 * np.eye(4) + 0.5)
    covariance = np.diag(std) @ mixing @ mixing.T @ np.diag(std)
    ships, found = [], []
    for i in range(300):
        truth = StraightCourse(T0 + 40_000.0 * i, 9e3 * (-1) ** i, 50.0, 8.0)
        error = std * (mixing @ rng.normal(size=4))
        motion = StraightCourse(
            truth.cpa_time + error[0],
            truth.cpa_range_m + error[1],
            truth.course_deg + error[2],
            8.0 + error[3],
        )
        ships.append(ship(truth, i + 1, radius=15e3))
        found.append(Track(0.0, 1.0, motion, covariance, 10.0))
    minutes = detections(times=T0 + 3600.0 * np.arange(-10, 3400))
    held = evaluate(minutes, found, ships).coverage
    for name in ("cpa_time_s", "cpa_distance_m", "course_deg", "speed_mps", "joint"):
        assert held[name]["tracks"] == 300
        assert held[name]["50_percent"] == pytest.approx(0.5, abs=0.09)
        assert held[name]["90_percent"] == pytest.approx(0.9, abs=0.05)


def test_ambiguous_azimuths_are_compared_modulo_180():
    azimuth, distance, rate = heard(FIRST)
    table = detections(azimuth + 180.0, distance, rate)
    half = evaluate(table, tracks(), [ship(FIRST)], delay, DetectionCriteria(azimuth_period_deg=180.0))
    assert half.ships[0].azimuth_smad_deg < 0.1 and "180°" in half.notes[-1]
    assert evaluate(table, tracks(), [ship(FIRST)], delay).ships[0].azimuth_n == 0


def test_a_track_known_up_to_half_a_turn_is_its_ships_on_either_side():
    opposite = replace(FIRST, course_deg=FIRST.course_deg + 180.0)
    azimuth, distance, rate = heard(FIRST)
    given = detections(azimuth, distance, rate), tracks(opposite), [ship(FIRST)], delay
    assert evaluate(*given).missed == (1,)
    found = evaluate(*given, DetectionCriteria(azimuth_period_deg=180.0))
    assert found.missed == () and found.false_tracks == ()
    assert abs(found.ships[0].course_error_deg) < 0.5 and abs(found.ships[0].cpa_azimuth_error_deg) < 0.5
    marked = given[1].assign(ambiguity_deg=180.0)
    assert evaluate(given[0], marked, *given[2:]).missed == ()
    assert evaluate(given[0], marked.assign(ambiguity_deg=360.0), *given[2:]).missed == (1,)
    # Going the other way past the same place is no turn about the station.
    reverse = tracks(FIRST).assign(course_deg=FIRST.course_deg + 90.0)
    half = DetectionCriteria(azimuth_period_deg=180.0)
    assert evaluate(given[0], reverse, *given[2:], half).missed == (1,)


def test_table_and_json():
    azimuth, distance, rate = heard(FIRST)
    result = evaluate(
        detections(azimuth + 2, distance, rate), tracks(FIRST), [ship(FIRST), ship(SECOND, 2)], delay
    )
    lines = result.table().splitlines()
    assert lines[0].split() == ["azimuth", "range", "tracker,", "absolute", "errors"]
    assert lines[3].split()[:4] == ["1", "SHIP", "1", str(result.ships[0].azimuth_n)]
    assert "\n1 track: 1 of 2 ships matched, 1 missed (2), 0 false" in result.table()
    assert "1 tracks" not in result.table()
    both = evaluate(detections(azimuth), tracks(FIRST, SECOND), [ship(FIRST)], delay).table()
    assert "\n2 tracks: 1 of 1 ship matched, 0 missed, 1 false (2)" in both
    assert max(map(len, lines)) <= 120
    plain = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert plain["ships"][1]["cpa_time_error_s"] is None and plain["missed"] == [2]


def test_nothing_at_all():
    result = evaluate(detections(times=np.empty(0)), tracks(), [], delay)
    assert result.ships == () and np.isnan(result.total.azimuth_smad_deg)
    assert "All" in result.table() and result.to_json()["tracks"] == 0
    nobody = evaluate(detections(12.0), tracks(FIRST), [], delay)
    assert nobody.false_tracks == (1,) and "no ship" in nobody.notes[0]
    assert nobody.minutes["azimuth"]["wrong_or_false_per_hour"] == pytest.approx(60.0)


def test_smad_of_gaussian_errors_is_their_deviation():
    assert smad(np.random.default_rng(0).normal(0, 3, 100_000)) == pytest.approx(3, rel=0.01)


class TestFolder:
    @pytest.fixture
    def folder(self, tmp_path):
        from obsnet.pipeline import RunConfig
        from obsnet.tables import TRACK_COLUMNS, detections_csv

        place = (-21.3732, 54.1294)
        times = T0 + np.arange(-20_000.0, 20_001, 300)
        from pyproj import Proj

        east, north = FIRST.position(times)
        lon, lat = Proj(proj="aeqd", lat_0=place[0], lon_0=place[1], datum="WGS84")(east, north, inverse=True)
        ais = pd.DataFrame({"mmsi": 7, "time": from_posix(times), "lon": lon, "lat": lat})
        write_plain(ais, tmp_path / "ais.csv")
        (reference,) = reference_tracks(ais, place)
        info = {
            "station": {"latitude": place[0], "longitude": place[1], "depth_m": 4340.0},
            "config": to_dict(RunConfig()),
        }
        (tmp_path / "run.json").write_text(json.dumps(info))
        from obsnet.evaluation.folder import _delay_of_run

        azimuth, distance, rate = reference.heard(MINUTES, _delay_of_run(info["config"], 4340.0))
        (tmp_path / "detections.csv").write_text(detections_csv(detections(azimuth, distance, rate)))
        tracks(FIRST).reindex(columns=TRACK_COLUMNS).to_csv(tmp_path / "tracks.csv", index=False)
        return tmp_path

    def test_round_trip(self, folder):
        row = evaluate_folder(folder, folder / "ais.csv").ships[0]
        assert (row.mmsi, row.track) == (7, 1)
        assert row.azimuth_smad_deg < 0.05 and row.range_smad_m < 1.0
        assert abs(row.cpa_time_error_s) < 1.0 and abs(row.cpa_distance_error_m) < 1.0

    def test_bad_rows_of_ais_are_counted(self, folder):
        assert not any("AIS" in note for note in evaluate_folder(folder, folder / "ais.csv").notes)
        with (folder / "ais.csv").open("a") as file:
            file.write("7,soon,54,-21\n7,2013-05-21T10:00:00Z,,\n")
        found = evaluate_folder(folder, folder / "ais.csv")
        assert "dropped: 1 no readable time, 1 no position" in found.table()

    @pytest.mark.parametrize(
        ("ship_type", "said"),
        [
            (None, "1 ship left out as no merchant (1 of unknown type)"),
            ("30", "1 ship left out as no merchant (0 of unknown type)"),
            ("70", ""),
        ],
    )
    def test_ships_left_out_as_no_merchants_are_counted(self, folder, ship_type, said):
        ais = pd.read_csv(folder / "ais.csv")
        ais.assign(ship_type=ship_type).to_csv(folder / "ais.csv", index=False)
        found = evaluate_folder(folder, folder / "ais.csv", merchant_only=True)
        assert len(found.ships) == (0 if said else 1)
        assert said in found.table() and ("left out" in found.table()) == bool(said)

    def test_a_run_without_ships_is_no_error(self, folder):
        header = (folder / "tracks.csv").read_text().splitlines()[0]
        (folder / "tracks.csv").write_text(header + "\n")
        assert evaluate_folder(folder, folder / "ais.csv").missed == (1,)

    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("detections.csv", None, "cannot read .*detections.csv: No such file"),
            ("detections.csv", "", "detections.csv is not a table"),
            (
                "detections.csv",
                "time,coverage\n",
                "lacks the column azimuth_deg, range_m, range_rate_mps; found time",
            ),
            (
                "detections.csv",
                "time,coverage,azimuth_deg,range_m,range_rate_mps\nsoon,1,,,\n",
                "detections.csv is not a table of obsnet: .*soon",
            ),
            (
                "detections.csv",
                "time,coverage,azimuth_deg,range_m,range_rate_mps\n2013-05-21T00:00:00Z,1,north,,\n",
                "detections.csv is not a table of obsnet: .*north",
            ),
            ("tracks.csv", "track\n1\n", "tracks.csv lacks the column cpa_time"),
            ("run.json", None, "cannot read .*run.json"),
            ("run.json", "{", "cannot read .*run.json"),
            ("run.json", "{}", "does not describe a run"),
        ],
    )
    def test_failures_are_one_line(self, folder, name, content, message):
        (folder / name).unlink()
        if content is not None:
            (folder / name).write_text(content)
        with pytest.raises(LayoutError, match=message) as caught:
            evaluate_folder(folder, folder / "ais.csv")
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("limit", ["max_cpa_m", "max_range_m"])
    @pytest.mark.parametrize("value", [-5e3, 0.0, np.nan])
    def test_distances_are_above_zero(self, folder, limit, value):
        with pytest.raises(ConfigError, match="distances above 0"):
            evaluate_folder(folder, folder / "ais.csv", **{limit: value})

    def test_not_a_folder(self, tmp_path):
        with pytest.raises(LayoutError, match="is not a folder"):
            evaluate_folder(tmp_path / "none", tmp_path)


def test_bad_parameters_and_tables():
    with pytest.raises(ConfigError, match="range_gate_m must be positive, found -1"):
        DetectionCriteria(range_gate_m=-1)
    with pytest.raises(ConfigError, match="azimuth_period_deg must be 180 or 360"):
        DetectionCriteria(azimuth_period_deg=90)
    with pytest.raises(ConfigError, match="gate speed_mps must be positive"):
        MatchGates(speed_mps=0)
    with pytest.raises(LayoutError, match="the detections lack range_m; found"):
        evaluate(detections().drop(columns="range_m"), tracks(), [])
    with pytest.raises(LayoutError, match="the tracks lack speed_mps"):
        evaluate(detections(), tracks(FIRST).drop(columns="speed_mps"), [])


def test_a_ship_that_turns_is_scored_against_its_course_at_cpa():
    """The line through all AIS of a ship that turned an hour after CPA is nowhere its course; both are told."""
    turning = BentCourse(T0, 10e3, 60.0, 7.0, turn_s=3600.0, turn_deg=40.0)
    reference = replace(
        ship(FIRST), east_m=(place := turning.position(ship(FIRST).time))[0], north_m=place[1]
    )
    result = evaluate(detections(), tracks(FIRST), [reference], delay)
    (row,) = result.ships
    assert row.track == 1
    assert abs(row.cpa_time_error_s) < 1.0 and abs(row.cpa_distance_error_m) < 1.0
    assert abs(row.course_error_deg) < 0.1 and abs(row.speed_error_mps) < 0.01
    assert result.against_lines["course_error_deg"] > 10.0
    assert "against straight lines" in result.table()
