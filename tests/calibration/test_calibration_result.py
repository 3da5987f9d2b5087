import numpy as np
import pytest

from obsnet.calibration import Calibration, CalibrationConfig, Orientation, Polarity, Position
from obsnet.calibration.result import moved
from obsnet.errors import ConfigError, OutputError, StationError
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.signals.station import Channel, Station

CALIBRATION = Calibration(
    "YV.RR03",
    3,
    Orientation(123.4, 0.7, 4500),
    Polarity(-1, -12.0),
    Position(-21.37, 54.13, 120.0, -80.0, 15.0, 20.0, 0.2),
    Amplitudes.default().scaled_to(3000.0),
    ("1-3", "3-5"),
    ("one note: °",),
    ((11.5, 123.0, 80), (12.5, 124.0, 90)),
)


def station(code="YV.RR03"):
    made = [("BDH", "pressure", None), ("BH1", "motion", 0.0), ("BH2", "motion", 90.0)]
    channels = tuple(Channel(f"{code}.00.{name}", kind, azimuth) for name, kind, azimuth in made)
    return Station(code, -21.3732, 54.1294, 4340.0, channels)


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.json"])
def test_files_give_back_what_was_written(tmp_path, name):
    CALIBRATION.write(tmp_path / name)
    assert Calibration.read(tmp_path / name) == CALIBRATION
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_parts_that_were_not_determined_stay_so(tmp_path):
    bare = Calibration("YV.RR03", 1, None, None, None, Amplitudes.table_ii())
    bare.write(tmp_path / "bare.yaml")
    again = Calibration.read(tmp_path / "bare.yaml")
    assert again == bare
    assert again.apply(station()) == station()


def test_a_station_takes_its_calibration():
    applied = CALIBRATION.apply(station())
    assert applied.orientation_deg == pytest.approx(123.4)
    assert [c.azimuth_deg for c in applied.horizontals] == pytest.approx([123.4, 213.4])
    assert applied.pressure.polarity == -1
    assert (applied.latitude, applied.longitude) == (-21.37, 54.13)
    assert applied.depth_m == 4340.0


def test_a_calibration_of_another_station_is_refused():
    with pytest.raises(StationError, match=r"is of YV\.RR03, the station is YV\.RR04"):
        CALIBRATION.apply(station("YV.RR04"))


def test_the_table_says_what_was_measured():
    text = CALIBRATION.table()
    for part in (
        "123.4° ± 0.7°",
        "reversed",
        "+120 ± 15 m east, -80 ± 20 m north",
        "measured",
        "note: one note",
    ):
        assert part in text


def test_offsets_are_metres_on_the_ground():
    latitude, longitude = moved(station(), 1000.0, -500.0)
    assert (latitude + 21.3732) * 110.7e3 == pytest.approx(-500.0, rel=2e-3)
    assert (longitude - 54.1294) * 111.32e3 * np.cos(np.deg2rad(21.3732)) == pytest.approx(1000.0, rel=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("station: YV.RR03", ""), "lacks station"),
        (("std_deg", "std_degg"), "did you mean 'std_deg'"),
        (("azimuth_deg: 123.4", "azimuth_deg: north"), "azimuth_deg must be a number"),
        (("passages", "passagess"), "unknown key 'passagess'"),
        (("alpha: 4.0", "alpha: x"), "amplitudes need"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, message):
    path = tmp_path / "calibration.yaml"
    CALIBRATION.write(path)
    text = path.read_text(encoding="utf-8")
    assert change[0] in text
    path.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        Calibration.read(path)


def test_what_cannot_be_read_or_written_is_said(tmp_path):
    with pytest.raises(ConfigError, match="cannot read"):
        Calibration.read(tmp_path / "absent.yaml")
    (tmp_path / "list.yaml").write_text("- 1\n- 2\n")
    with pytest.raises(ConfigError):
        Calibration.read(tmp_path / "list.yaml")
    with pytest.raises(OutputError, match="cannot write the calibration"):
        CALIBRATION.write(tmp_path / "absent" / "calibration.yaml")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fmin_hz": 30.0}, "fmin_hz must be > 0 and below fmax_hz"),
        ({"search_step_m": 0.0}, "search_step_m"),
        ({"isolation": 0.5}, "isolation"),
        ({"average_s": -1.0}, "average_s"),
        ({"pairs": ()}, "path pair"),
    ],
)
def test_bad_configurations_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        CalibrationConfig(**values)
