"""Cepstrogram and clutter filter: echoes at their delay, statistics of noise, and an output that no split can change."""

import numpy as np
import pytest
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import from_posix
from obsnet.signals.cepstrogram import (
    CepstrogramConfig,
    ClutterFilter,
    cepstrogram,
    knee,
    leading_basis,
    noise_std,
)

N = 1024
HOP = 10.24


def noise_spectra(rng, frames, transfer=1.0):
    """Hann-windowed white noise, frame by frame, times a transfer function of frequency."""
    window = np.hanning(N + 1)[:-1]
    p = np.fft.rfft(rng.standard_normal((frames, N)) * window, axis=1) * transfer
    time = 1_369_123_200.0 + HOP * np.arange(frames)
    return xr.Dataset(
        {"p": (("frequency", "time"), p.T.astype(np.complex64))},
        coords={"frequency": np.arange(N // 2 + 1) * 50.0 / N, "time": from_posix(time)},
    )


def test_noise_follows_equation_15():
    spectra = noise_spectra(np.random.default_rng(0), 3000)
    values = cepstrogram(spectra)
    quefrency = values["quefrency"].values
    expected = noise_std(quefrency, N)
    measured = values.values.std(axis=1)
    inside = slice(5, -5)
    np.testing.assert_allclose(measured[inside], expected[inside], rtol=0.10)
    assert abs(values.values[20:-5].mean()) < 1e-3


def test_echo_appears_at_its_delay_with_half_its_amplitude():
    """log|1 + a exp(−iωτ)| = a cos(ωτ) + …: the cepstrum holds a/2 at τ."""
    frequency = np.arange(N // 2 + 1) * 50.0 / N
    delay, echo = 2.56, 0.2
    transfer = 1.0 + echo * np.exp(-2j * np.pi * frequency * delay)
    values = cepstrogram(noise_spectra(np.random.default_rng(1), 2000, transfer)).mean("time")
    assert float(values["quefrency"][int(abs(values.values[20:]).argmax()) + 20]) == pytest.approx(delay)
    assert float(values.sel(quefrency=delay, method="nearest")) == pytest.approx(echo / 2, rel=0.1)


def test_gain_moves_the_zeroth_quefrency_alone():
    spectra = noise_spectra(np.random.default_rng(2), 4)
    louder = spectra * np.complex64(1000.0)
    difference = cepstrogram(louder).values - cepstrogram(spectra).values
    assert np.allclose(difference[0], np.log(1000.0), atol=1e-3)
    assert abs(difference[1:]).max() < 1e-4


def test_missing_hydrophone_is_named():
    with pytest.raises(LayoutError, match="hydrophone"):
        cepstrogram(noise_spectra(np.random.default_rng(3), 2).rename(p="down"))


@pytest.mark.parametrize("clutter", ["svd", "mean"])
def test_clutter_goes_and_a_moving_echo_stays(clutter):
    rng = np.random.default_rng(4)
    cepstra = cepstrogram(noise_spectra(rng, 1500))
    quefrency = cepstra["quefrency"].values
    cepstra.values[100] += 0.3
    ridge = np.linspace(200, 300, 1500).astype(int)
    cepstra.values[ridge, np.arange(1500)] += 0.1
    filtered = ClutterFilter(CepstrogramConfig(clutter=clutter))(cepstra).values
    late = slice(400, None)
    assert abs(filtered[100, late].mean()) < 0.03
    on_ridge = filtered[ridge[late], np.arange(1500)[late]]
    assert on_ridge.mean() > 0.08
    assert filtered[400, late].std() == pytest.approx(noise_std(quefrency, N)[400], rel=0.1)


@pytest.mark.parametrize("clutter", ["svd", "mean"])
def test_output_does_not_depend_on_the_split(clutter):
    cepstra = cepstrogram(noise_spectra(np.random.default_rng(5), 700))
    cepstra.values[:, 300:320] = np.nan
    config = CepstrogramConfig(clutter=clutter, clutter_window_s=1800.0)
    whole = ClutterFilter(config)(cepstra).values
    for cuts in ([1, 29, 30, 31, 500], [350], [17, 100, 310, 311, 640]):
        filtering = ClutterFilter(config)
        parts = np.split(np.arange(700), cuts)
        joined = np.concatenate([filtering(cepstra.isel(time=part)).values for part in parts], axis=1)
        np.testing.assert_allclose(joined, whole, atol=2e-6)


def test_output_forgets_what_lies_before_the_window():
    cepstra = cepstrogram(noise_spectra(np.random.default_rng(6), 600))
    config = CepstrogramConfig(clutter_window_s=1800.0)
    whole = ClutterFilter(config)(cepstra).values
    late = ClutterFilter(config)(cepstra.isel(time=slice(200, None))).values
    np.testing.assert_allclose(late[:, 250:], whole[:, 450:], atol=2e-6)


@pytest.mark.parametrize("clutter", ["svd", "mean"])
def test_before_the_clutter_is_known_its_mean_goes(clutter):
    cepstra = cepstrogram(noise_spectra(np.random.default_rng(7), 600))
    quefrency = cepstra["quefrency"].values
    cepstra.values[100] += 0.3
    early = slice(1, ClutterFilter.WARM_UP_FRAMES)
    filtered = ClutterFilter(CepstrogramConfig(clutter=clutter))(cepstra).values
    assert np.isnan(filtered[:, 0]).all()
    assert not np.isnan(filtered[:, 1:]).any()
    assert abs(filtered[100, early].mean()) < 0.03
    spread = filtered[200:480, early].std() / noise_std(quefrency, N)[200:480].mean()
    assert spread == pytest.approx(1.0, abs=0.05)


def test_a_dead_hydrophone_leaves_nothing_in_memory():
    cepstra = cepstrogram(noise_spectra(np.random.default_rng(9), 600))
    cepstra.values[:] = np.nan
    filtering = ClutterFilter()
    assert np.isnan(filtering(cepstra).values).all()
    assert not filtering._frames


def test_basis_is_the_leading_singular_vectors():
    rng = np.random.default_rng(8)
    frames = rng.standard_normal((600, 300)) * 0.3
    for strength in (40.0, 9.0, 4.0):
        frames += strength * np.outer(rng.standard_normal(600), rng.standard_normal(300)) / 10.0
    basis = leading_basis(frames.T @ frames, len(frames))
    _, singular, vectors = np.linalg.svd(frames)
    keep = knee(singular)
    assert keep >= 2 and basis.shape == (300, keep)
    np.testing.assert_allclose(basis @ basis.T, vectors[:keep].T @ vectors[:keep], atol=1e-4)


def test_wrong_window_is_refused():
    with pytest.raises(ConfigError, match="clutter_step_s"):
        CepstrogramConfig(clutter_window_s=60.0, clutter_step_s=600.0)
