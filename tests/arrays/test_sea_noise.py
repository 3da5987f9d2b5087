import numpy as np
import pytest

from obsnet.arrays.beamforming import Beamformer, HydrophoneArray
from obsnet.arrays.sea_noise import NoiseSector, SeaNoise
from obsnet.errors import ConfigError

ARRAY = HydrophoneArray.line(8, 0.93)
BAND = np.linspace(750.0, 937.5, 40)


def test_a_narrow_sector_is_a_plane_wave():
    sea = SeaNoise(1e-12, 0.0, sectors=(NoiseSector(30.0, 1e-3, 1.0, slope_db_octave=0.0),))
    density = sea.spectral_density(ARRAY, BAND)[7]
    wave = np.exp(-2j * np.pi * BAND[7] * ARRAY.delays_s(30.0))
    np.testing.assert_allclose(density, np.outer(wave, wave.conj()), atol=1e-6)


def test_diffuse_noise_is_incoherent_half_a_wavelength_apart():
    pair = HydrophoneArray.line(2, 1500.0 / 800.0 / 2.0)
    density = SeaNoise(1e-12, 1.0).spectral_density(pair, np.array([800.0, 400.0]))
    assert abs(density[0, 0, 1]) < 1e-6 * density[0, 0, 0].real
    assert density[1, 0, 1] / density[1, 0, 0] == pytest.approx(2 / np.pi, rel=1e-6)


def test_the_noise_model_is_stable_and_has_the_stated_power():
    sea = SeaNoise(
        0.1, 0.4, sectors=(NoiseSector(-20, 8, 0.4, -9.0), NoiseSector(20, 2, 0.1, 0.0, 800.0, 3.0))
    )
    model = sea.noise_model(ARRAY, 375.0, 750.0, order=14)
    assert model.is_stable
    np.testing.assert_allclose(np.diag(model.autocovariance()), 1.0, rtol=0.02)


def test_simulated_noise_comes_from_its_sector():
    sea = SeaNoise(0.05, 0.2, sectors=(NoiseSector(-35.0, 5.0, 0.75),))
    model = sea.noise_model(ARRAY, 375.0, 750.0, order=14)
    beams = Beamformer(ARRAY, 375.0, 64, np.arange(-90.0, 91.0), 750.0)
    record = model.simulate(300 * 64, np.random.default_rng(1)).reshape(300, 64, 8)
    assert beams.azimuth_deg[beams.power(record).mean(axis=0).argmax()] == pytest.approx(-35.0, abs=3.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"self_noise": 0.0, "diffuse": 1.0}, "self noise"),
        ({"self_noise": 1.0, "diffuse": -1.0}, "negative"),
        ({"self_noise": 1.0, "diffuse": 1.0, "sectors": (NoiseSector(0.0, 0.0, 1.0),)}, "spread"),
    ],
)
def test_impossible_seas_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        SeaNoise(**settings)
