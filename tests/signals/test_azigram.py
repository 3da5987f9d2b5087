"""Azigram: plane waves point back to their source, on simulated spectra and on a real ship."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.io import wavfile

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import from_posix
from obsnet.signals.azigram import AzigramConfig, azigram

REFERENCE = Path(__file__).parents[2] / "../shared/reference"


def plane_wave(azimuth_deg, frames=40, noise=0.0, seed=0):
    """Spectra of a wave from `azimuth_deg`: positive pressure is compression, so velocity points away from the source."""
    rng = np.random.default_rng(seed)

    def draw():
        return rng.standard_normal((60, frames)) + 1j * rng.standard_normal((60, frames))

    p = draw()
    east, north = -p * np.sin(np.deg2rad(azimuth_deg)), -p * np.cos(np.deg2rad(azimuth_deg))
    variables = {"p": p + noise * draw(), "east": east + noise * draw(), "north": north + noise * draw()}
    return xr.Dataset(
        {name: (("frequency", "time"), values.astype(np.complex64)) for name, values in variables.items()},
        coords={"frequency": np.linspace(5, 25, 60), "time": from_posix(10.24 * np.arange(frames))},
    )


def degrees(phasor):
    return np.rad2deg(np.angle(phasor)) % 360


@pytest.mark.parametrize("azimuth", [0.5, 45.0, 130.0, 229.0, 359.0])
def test_plane_wave_points_to_its_source(azimuth):
    result = azigram(plane_wave(azimuth))
    np.testing.assert_allclose(degrees(result.values), azimuth, atol=0.01)
    np.testing.assert_allclose(abs(result.values), 1.0, atol=1e-5)
    assert result["frequency"].values.min() >= 11 and result["frequency"].values.max() <= 24


def test_reversed_hydrophone_turns_it_round():
    spectra = plane_wave(70.0)
    spectra["p"] = -spectra["p"]
    np.testing.assert_allclose(degrees(azigram(spectra).values), 250.0, atol=0.01)


def test_gain_leaves_it_unchanged():
    spectra = plane_wave(70.0, noise=0.3)
    louder = spectra * np.complex64(1e4)
    np.testing.assert_allclose(azigram(louder).values, azigram(spectra).values, atol=1e-5)


def test_circular_variance_follows_appendix_b():
    """At high SNR 1 − R goes with 1/√SNR (noise over signal amplitude), as a wrapped Cauchy's does."""

    def variance(noise):
        result = azigram(plane_wave(120.0, frames=2000, noise=noise))
        error = np.deg2rad(np.abs((degrees(result.values) - 120 + 180) % 360 - 180))
        return 1 - np.exp(-np.median(error))

    assert variance(0.1) / variance(0.05) == pytest.approx(2.0, rel=0.05)
    assert 0.04 < variance(0.1) < 0.1


def test_average_measures_the_mean_resultant_length():
    scattered = azigram(plane_wave(200.0, frames=300, noise=3.0), AzigramConfig(average_frames=9))
    focused = azigram(plane_wave(200.0, frames=300, noise=0.1), AzigramConfig(average_frames=9))
    assert abs(scattered.values).mean() < 0.7 < 0.95 < abs(focused.values).mean()


def test_polarisation_knows_the_axis_alone():
    spectra = plane_wave(70.0).drop_vars("p")
    result = azigram(spectra)
    assert result.attrs["ambiguity_deg"] == 180
    np.testing.assert_allclose(degrees(result.values), 140.0, atol=0.01)
    np.testing.assert_allclose(azigram(plane_wave(250.0).drop_vars("p")).values, result.values, atol=1e-4)


def test_gaps_stay_nan():
    spectra = plane_wave(70.0)
    spectra["p"][:, 7] = np.nan
    result = azigram(spectra, AzigramConfig(average_frames=5))
    assert np.isnan(result.values[:, 7]).all() and not np.isnan(result.values[:, 6]).any()


def test_missing_components_are_named():
    with pytest.raises(LayoutError, match="north missing"):
        azigram(plane_wave(10.0).drop_vars("north"))
    with pytest.raises(LayoutError, match="hydrophone"):
        azigram(plane_wave(10.0).drop_vars("p"), AzigramConfig(method="intensity"))
    with pytest.raises(ConfigError, match="no spectral bin"):
        azigram(plane_wave(10.0), AzigramConfig(fmin_hz=100.0, fmax_hz=120.0))


@pytest.mark.skipif(not REFERENCE.exists(), reason="reference data not here")
def test_real_ship_lies_where_its_operator_heard_it():
    """A directional sonobuoy's product of pressure and velocity points to the source; the operator read 229°.

    The azimuth is the most likely one under wrapped Cauchys of R = 0.9.
    """
    phasors = []
    for path in sorted(REFERENCE.glob("difar_vessel_*.wav")):
        rate, samples = wavfile.read(path)
        frames = np.lib.stride_tricks.sliding_window_view(samples.astype(float), 1024, axis=0)[::512]
        spectra = np.fft.rfft(frames * np.hanning(1024), axis=-1).transpose(1, 2, 0)
        p, east, north = spectra
        array = xr.Dataset(
            {
                name: (("frequency", "time"), values.astype(np.complex64))
                for name, values in (("p", -p), ("east", east), ("north", north))
            },
            coords={
                "frequency": np.arange(513) * rate / 1024,
                "time": from_posix(np.arange(p.shape[1]) * 512 / rate),
            },
        )
        phasors.append(azigram(array, AzigramConfig(fmin_hz=1000.0, fmax_hz=1250.0)).values)
    measured = np.angle(np.concatenate(phasors, axis=1))[..., None]
    grid = np.arange(0.0, 360.0, 0.5)
    density = 0.19 / (1.81 - 1.8 * np.cos(measured - np.deg2rad(grid)))
    found = grid[np.log(density).sum(axis=(0, 1)).argmax()]
    assert abs(found - 229.0) < 2.0
