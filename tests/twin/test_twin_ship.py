import numpy as np
import pytest
from scipy.signal import welch

from obsnet.errors import ConfigError
from obsnet.twin.ship import Emission, LineSeries, Ship

FIRST = 100 * 1369130400
QUIET = Ship(level_spread_db=0.0, modulation=0.0, ripple_db=0.0)


def emitted(ship: Ship, seconds: float = 1800.0, rate: float = 500.0, passband: float = 250.0) -> np.ndarray:
    return Emission(ship, rate, passband).samples(int(FIRST / 100 * rate), int(seconds * rate))


def test_broadband_level_is_the_source_level():
    ship = Ship.random(4).with_lines(())
    ship = Ship(**{**ship.__dict__, "source_level_db": 191.0, "level_spread_db": 0.0})
    f, psd = welch(emitted(ship).real, 500.0, nperseg=4096)
    band = (f >= 5.0) & (f <= 100.0)
    assert 10 * np.log10(psd[band].sum() * f[1]) + 120.0 == pytest.approx(191.0, abs=0.3)


def test_psd_is_the_spectrum_level():
    f, psd = welch(emitted(QUIET).real, 500.0, nperseg=1024)
    for hertz in (8.0, 15.0, 24.0, 60.0, 100.0):
        near = np.abs(f - hertz) < 1.0
        measured = 10 * np.log10(psd[near].mean()) + 120.0
        assert measured == pytest.approx(float(QUIET.spectrum_level_db(np.array(hertz))), abs=0.5)
    high = QUIET.spectrum_level_db(np.array([100.0, 1000.0]))
    assert high[0] - high[1] == pytest.approx(33.0, abs=0.5)


def test_a_line_has_its_frequency_and_level():
    series = LineSeries(2.0, (6, 9), (185.0, 175.0), rate_spread=0.0)
    ship = Ship(**{**QUIET.__dict__, "source_level_db": 100.0, "lines": (series,)})
    signal = emitted(ship, 3600.0, 100.0, 50.0)
    spectrum = np.abs(np.fft.fft(signal)) / signal.size
    hertz = np.fft.fftfreq(signal.size, 0.01)
    for frequency, level in ((12.0, 185.0), (18.0, 175.0)):
        near = np.abs(hertz - frequency) < 0.05
        power = np.sum(spectrum[near] ** 2) / 2
        assert abs(hertz[near][np.argmax(spectrum[near])] - frequency) < 1e-3
        assert 10 * np.log10(power) + 120.0 == pytest.approx(level, abs=3.0)  # its own slow level is ± 2 dB


def test_lines_of_one_shaft_wander_together():
    series = LineSeries(1.7, (5, 10), (185.0, 185.0), rate_spread=2e-3)
    ship = Ship(**{**QUIET.__dict__, "source_level_db": 100.0, "lines": (series,)})
    signal = emitted(ship, 3600.0, 100.0, 50.0)
    time = np.arange(signal.size) / 100.0
    rates = []
    for k in (5, 10):
        low = signal * np.exp(-2j * np.pi * 1.7 * k * time)
        smooth = low.reshape(-1, 200).mean(axis=1)
        rates.append(np.diff(np.unwrap(np.angle(smooth))) / 2 / np.pi / 2.0 / k)
    assert np.std(rates[0]) > 3e-4 * 1.7
    np.testing.assert_allclose(rates[0], rates[1], atol=3e-4)


def test_modulation_is_at_the_blade_rate_and_keeps_the_power():
    series = LineSeries(1.5, (4,), (60.0,), rate_spread=0.0)
    still = Ship(**{**QUIET.__dict__, "blades": 4, "lines": (series,)})
    beating = Ship(**{**still.__dict__, "modulation": 0.5})
    plain, modulated = emitted(still, 1800.0, 100.0, 50.0), emitted(beating, 1800.0, 100.0, 50.0)
    assert np.var(modulated) == pytest.approx(np.var(plain), rel=0.02)
    envelope = np.abs(modulated) ** 2
    spectrum = np.abs(np.fft.rfft(envelope - envelope.mean()))
    hertz = np.fft.rfftfreq(envelope.size, 0.01)
    band = (hertz > 2.0) & (hertz < 20.0)
    assert hertz[band][np.argmax(spectrum[band])] == pytest.approx(6.0, abs=1e-3)


def test_any_part_of_the_emission_equals_the_cut_from_the_whole():
    emission = Emission(Ship.random(8), 100.0, 50.0)
    whole, part = emission.samples(FIRST, 60_000), emission.samples(FIRST + 17_011, 20_000)
    np.testing.assert_allclose(part, whole[17_011:37_011], atol=1e-3 * np.abs(whole).std())


def test_random_ships_are_merchant_ships_and_reproducible():
    ships = [Ship.random(seed) for seed in range(40)]
    assert Ship.random(3) == ships[3] and ships[3] != ships[4]
    levels = np.array([ship.source_level_db for ship in ships])
    assert 192.0 < levels.mean() < 196.0 and levels.min() > 180.0 and levels.max() < 208.0
    for ship in ships:
        shaft, levels = ship.lines[0], np.array(ship.lines[0].levels_db)
        hertz = shaft.rate_hz * np.array(shaft.harmonics)
        excess = levels - ship.spectrum_level_db(hertz) - 10 * np.log10(0.073)
        assert 10.0 < excess.max() < 45.0 and excess.min() >= 3.9


def test_bad_ships_are_refused():
    with pytest.raises(ConfigError, match="source_depth_m must lie between 0 and 100 m, found -1"):
        Ship(source_depth_m=-1.0)
    with pytest.raises(ConfigError, match="modulation"):
        Ship(modulation=2.0)
    with pytest.raises(ConfigError, match="a level per harmonic, found 1 for 2"):
        LineSeries(1.0, (1, 2), (170.0,))
    with pytest.raises(ConfigError, match="must be positive"):
        LineSeries(0.0, (1,), (170.0,))
