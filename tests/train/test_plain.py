"""The third generator: courses pass where they say, sound comes from the ship and from above, echoes come when geometry says."""

from dataclasses import replace

import numpy as np
import plain
import pytest

from obsnet.signals.station import Station

SHIP = plain.Ship(180.0, 3000.0, 30.0, 5.0, True, 160.0, 0.0, (), 6.0)
SCENE = replace(plain.draw(1), hours=0.1, ships=(SHIP,), noise_db=-80.0, lobes=0, gaps=0, depth_m=2000.0, sound_speed_mps=1500.0,
                coupling=1.0, orientation_deg=25.0)  # fmt: skip


def test_a_ship_passes_the_station_on_the_side_and_at_the_distance_it_says():
    time = np.arange(-600.0, 960.0)
    east, north = SHIP.east_north(time)
    distance = np.hypot(east, north)
    assert time[distance.argmin()] == SHIP.cpa_s and distance.min() == pytest.approx(3000.0)
    # The station lies to starboard: the ship going to 30° passes it at 300°.
    assert np.rad2deg(np.arctan2(east, north))[distance.argmin()] % 360 == pytest.approx(300.0)


def test_energy_flows_from_the_ship_and_down():
    east, north, up, pressure = plain.field(SCENE)
    middle = slice(150 * 200, 210 * 200)
    flow = [(pressure * v)[middle].mean() for v in (east, north, up)]
    assert np.rad2deg(np.arctan2(-flow[0], -flow[1])) % 360 == pytest.approx(300.0, abs=3.0)
    assert flow[2] < 0


def test_the_first_echo_comes_when_the_images_say():
    pressure = plain.field(SCENE)[3][150 * 200 : 210 * 200]
    spectrum = np.abs(np.fft.rfft(pressure)) ** 2
    frequency = np.fft.rfftfreq(pressure.size, 1 / 200.0)
    # Whitened between 5 and 60 Hz, the autocorrelation holds the echo.
    band = (frequency > 5.0) & (frequency < 60.0)
    smooth = np.convolve(spectrum, np.ones(601) / 601, "same")
    correlation = np.fft.irfft(np.where(band, spectrum / smooth, 0.0))
    delay = (np.hypot(3000.0, 6000.0) - np.hypot(3000.0, 2000.0)) / 1500.0
    lag = np.arange(1.0, 3.0, 1 / 200.0)
    best = lag[np.abs(correlation[200:600]).argmax()]
    assert best == pytest.approx(delay, abs=0.05)


def test_what_is_written_is_a_station_with_its_record(tmp_path):
    plain.write(SCENE, tmp_path)
    station = Station.from_stationxml(tmp_path / "station.xml")
    assert station.depth_m == 2000.0
    assert (tmp_path / "waveforms.mseed").stat().st_size > 0
    assert plain.draw(3) == plain.draw(3) != plain.draw(4)
    assert plain.draw(3, silent=True).ships == ()
