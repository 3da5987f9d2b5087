"""Longitudes from 0 to 360 are those from -180 to 180, and 181 is AIS for none."""

import pytest

from obsnet import ais
from obsnet.errors import AISError


def read(tmp_path, *longitudes, **options):
    rows = (f"1,2013-05-21T10:{n:02d}:00Z,{lon},-21.4\n" for n, lon in enumerate(longitudes))
    (tmp_path / "a.csv").write_text("mmsi,time,lon,lat\n" + "".join(rows))
    return ais.read(tmp_path / "a.csv", **options)


def test_a_ship_crosses_the_date_line_in_either_convention(tmp_path):
    expected = [179.99, 180.0, -179.99, -179.98]
    for longitudes in ([179.99, 180.0, 180.01, 180.02], expected):
        table = read(tmp_path, *longitudes)
        assert table["lon"].tolist() == pytest.approx(expected)
        assert not table.attrs["report"].dropped


@pytest.mark.parametrize("longitude", [210.0, -150.0])
def test_positions_near_a_station_in_either_convention(tmp_path, longitude):
    assert read(tmp_path, 210.1, 210.11, near=(-21.4, longitude))["lon"].tolist() == pytest.approx(
        [-149.9, -149.89]
    )


@pytest.mark.parametrize("longitude", [181, 360.5, -180.5])
def test_what_is_no_longitude_is_no_position(tmp_path, longitude):
    assert read(tmp_path, 54.1, longitude).attrs["report"].dropped == {"no position": 1}
    with pytest.raises(AISError, match="1 no position"):
        read(tmp_path, longitude)
