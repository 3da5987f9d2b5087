"""The background's levels and directions, and the core paper's appendix B: what its statistics do to
azigram and cepstrogram.
"""

import numpy as np
import pytest
from scipy.signal import csd, welch
from scipy.stats import kstest

from obsnet.errors import ConfigError
from obsnet.twin.noise import gaussian_noise
from obsnet.twin.propagate import Field
from obsnet.twin.sea import IMPEDANCE, Ambient, Lobe, add_ambient, add_lobe

RATE = 50.0
FIRST = 50 * 1369130400
NPERSEG = 1024


def background(ambient: Ambient, seconds: float = 3600.0, seed: int = 1) -> Field:
    field = Field.silence(int(seconds * RATE))
    add_ambient(field, FIRST, RATE, ambient, seed)
    return field


def level_db(values: np.ndarray, frequency: float) -> float:
    f, psd = welch(values, RATE, nperseg=4096)
    near = np.abs(f - frequency) < 0.1 * frequency
    return 10 * np.log10(psd[near].mean()) + 120.0


def frames(values: np.ndarray) -> np.ndarray:
    window = np.hanning(NPERSEG + 1)[:-1]
    cut = np.lib.stride_tricks.sliding_window_view(values, NPERSEG)[::NPERSEG]
    return np.fft.rfft(cut * window, axis=1)


@pytest.mark.parametrize("level", [74.0, 90.0])
def test_level_of_the_sea_noise_at_15_hz(level):
    field = background(Ambient(level_db=level, level_spread_db=0.0))
    assert level_db(field.pressure, 15.0) == pytest.approx(level, abs=0.3)


def of_lobe(lobe: Lobe, first: int = FIRST, count: int = 180_000) -> Field:
    field = Field.silence(count)
    add_lobe(field, first, RATE, lobe)
    return field


def azimuth_of(field: Field, part: slice = slice(None)) -> float:
    east, north = (-np.mean(field.pressure[part] * v[part]) for v in (field.east, field.north))
    return float(np.rad2deg(np.arctan2(east, north)) % 360.0)


def test_a_lobe_has_its_level_and_points_to_where_it_comes_from():
    lobe = Lobe(level_db=80.0, azimuth_deg=215.0, width_deg=15.0, elevation_deg=0.0, seed=4)
    field = of_lobe(lobe)
    assert level_db(field.pressure, 15.0) == pytest.approx(80.0, abs=0.3)
    assert azimuth_of(field) == pytest.approx(215.0, abs=1.0)
    # A wave of one direction has E_v = E_p; across the lobe's middle lies the share sin² of its width.
    along, across = np.deg2rad(215.0), np.deg2rad(125.0)
    parts = [field.east * np.sin(angle) + field.north * np.cos(angle) for angle in (along, across)]
    share = np.var(parts[1]) / (np.var(parts[0]) + np.var(parts[1]))
    assert share == pytest.approx(0.5 * (1 - np.exp(-2 * np.deg2rad(15.0) ** 2)), abs=0.01)
    assert np.var(field.pressure) == pytest.approx(
        IMPEDANCE**2 * np.var(np.stack(parts), axis=1).sum(), rel=0.05
    )


def test_a_lobe_turns_swells_and_is_the_same_however_it_is_cut():
    lobe = Lobe(azimuth_deg=350.0, turning_deg_per_h=30.0, since=FIRST / RATE, swell_db=3.0, seed=2)
    field = of_lobe(lobe)
    assert azimuth_of(field, slice(0, 30_000)) == pytest.approx(355.0 - 2.5, abs=4.0)
    assert azimuth_of(field, slice(150_000, None)) == pytest.approx(17.5, abs=4.0)
    minutes = 10 * np.log10(np.mean(field.pressure.reshape(60, 3000) ** 2, axis=1))
    steady = of_lobe(Lobe(seed=2))
    assert (
        np.std(minutes) > np.std(10 * np.log10(np.mean(steady.pressure.reshape(60, 3000) ** 2, axis=1))) + 1.0
    )
    part = of_lobe(lobe, FIRST + 40_000, 30_000)
    for name in ("pressure", "east", "north", "down"):
        expected = getattr(field, name)[40_000:70_000]
        np.testing.assert_allclose(getattr(part, name), expected, atol=2e-3 * np.std(expected))


def test_spectrum_falls_as_asked_and_carries_the_microseism():
    ambient = Ambient(80.0, slope_db=24.0, level_spread_db=0.0, microseism_db=150.0, microseism_hz=0.2)
    pressure = background(ambient, 7200.0).pressure
    fall = level_db(pressure, 20.0) - level_db(pressure, 10.0)
    assert fall == pytest.approx(-24.0 * np.log10(2.0), abs=0.4)
    f, psd = welch(pressure, RATE, nperseg=8192)
    peak = 10 * np.log10(psd[(f > 0.1) & (f < 0.4)].max()) + 120.0
    assert peak == pytest.approx(150.0, abs=1.5)
    assert abs(f[1:][np.argmax(psd[1:])] - 0.2) < 0.05


def test_pressure_psd_says_what_is_made():
    ambient = Ambient(level_spread_db=0.0)
    f, psd = welch(background(ambient).pressure, RATE, nperseg=2048)
    inside = (f > 1.0) & (f < 22.0)
    ratio = psd[inside] / ambient.pressure_psd(f[inside])
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert np.abs(np.log(ratio)).max() < 0.4


def test_isotropic_noise_has_uncorrelated_components_of_a_third_of_the_energy():
    field = background(Ambient.isotropic(80.0), 7200.0)
    parts = [field.pressure, field.east * IMPEDANCE, field.north * IMPEDANCE, field.down * IMPEDANCE]
    power = np.array([np.var(part) for part in parts]) / np.var(field.pressure)
    np.testing.assert_allclose(power, [1.0, 1 / 3, 1 / 3, 1 / 3], rtol=0.02)
    correlation = np.corrcoef(parts) - np.eye(4)
    assert np.abs(correlation).max() < 0.01  # 330 000 independent samples: standard error 0.002


def test_noise_comes_from_above():
    ambient = Ambient(vertical_coherence=0.5, directional_fraction=0.0, seismometer_noise_db=-200.0)
    field = background(ambient)
    f, cross = csd(field.pressure, field.down, RATE, nperseg=1024)
    _, p = welch(field.pressure, RATE, nperseg=1024)
    _, v = welch(field.down, RATE, nperseg=1024)
    inside = (f > 2.0) & (f < 22.0)
    coherence = (cross / np.sqrt(p * v))[inside]
    assert coherence.real.mean() == pytest.approx(0.5, abs=0.02)
    assert abs(coherence.imag.mean()) < 0.01


@pytest.mark.parametrize("fraction", [0.3, 0.8])
def test_directional_share_of_the_noise_comes_from_its_azimuth(fraction):
    ambient = Ambient.isotropic(80.0)
    ambient = Ambient(
        **{**ambient.__dict__, "directional_fraction": fraction, "directional_azimuth_deg": 212.0}
    )
    field = background(ambient)
    flux = IMPEDANCE * np.array([np.mean(field.pressure * field.east), np.mean(field.pressure * field.north)])
    source = np.rad2deg(np.arctan2(-flux[0], -flux[1])) % 360.0
    assert source == pytest.approx(212.0, abs=1.5)
    expected = fraction * np.cos(np.deg2rad(ambient.directional_elevation_deg)) * np.var(field.pressure)
    assert np.hypot(*flux) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("width", [10.0, 40.0])
def test_noise_from_a_sector_points_to_its_middle_and_is_less_focused(width):
    changed = {
        "directional_fraction": 1.0, "directional_azimuth_deg": 212.0, "directional_width_deg": width,
        "directional_elevation_deg": 0.0,
    }  # fmt: skip
    field = background(Ambient(**{**Ambient.isotropic(80.0).__dict__, **changed}))
    east, north = IMPEDANCE * field.east, IMPEDANCE * field.north
    flux = np.array([np.mean(field.pressure * east), np.mean(field.pressure * north)])
    assert np.rad2deg(np.arctan2(-flux[0], -flux[1])) % 360.0 == pytest.approx(212.0, abs=1.5)
    spread = np.deg2rad(width)
    assert np.hypot(*flux) / np.var(field.pressure) == pytest.approx(np.exp(-(spread**2) / 2), rel=0.03)
    across = np.var(east * np.cos(np.deg2rad(212.0)) - north * np.sin(np.deg2rad(212.0)))
    assert across / np.var(field.pressure) == pytest.approx((1 - np.exp(-2 * spread**2)) / 2, rel=0.06)


def test_chorus_adds_a_hump_at_the_whales_pitch():
    quiet = background(Ambient(level_spread_db=0.0))
    loud = background(Ambient(level_spread_db=0.0, chorus_db=96.0))
    gain = level_db(loud.pressure, 20.0) - level_db(quiet.pressure, 20.0)
    assert gain > 8.0
    assert abs(level_db(loud.pressure, 12.0) - level_db(quiet.pressure, 12.0)) < 0.3


def wrapped_cauchy_resultant(angles: np.ndarray) -> float:
    """Maximum-likelihood mean resultant length of a wrapped Cauchy law of known direction 0, by
    bisection of the score.
    """

    def score(r: float) -> float:
        return float(
            np.mean(
                -2 * r / (1 - r * r) + (2 * np.cos(angles) - 2 * r) / (1 - 2 * r * np.cos(angles) + r * r)
            )
        )

    low, high = 0.0, 1.0 - 1e-9
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if score(middle) > 0 else (low, middle)
    return low


def azimuth_errors(snr_db: float, hours: float = 2.0) -> np.ndarray:
    """Azimuth errors [rad] per cell of a Gaussian plane wave in noise of equal PSD on pressure and both
    velocities.
    """
    ambient = Ambient(**{**Ambient.isotropic(80.0).__dict__, "horizontal_share": 1.0})
    field = background(ambient, hours * 3600.0)

    def colour(_frequency, z):
        return z * np.float32(1e-6 * 10 ** ((80.0 + snr_db) / 20))

    ship = gaussian_noise((99,), FIRST, field.pressure.size, RATE, colour)[0]
    pressure = frames(field.pressure + ship)
    along, across = frames(field.north - ship / IMPEDANCE), frames(field.east)
    keep = slice(20, 450)
    intensity = np.conj(pressure)[:, keep] * -across[:, keep], np.conj(pressure)[:, keep] * -along[:, keep]
    return np.arctan2(intensity[0].real, intensity[1].real).ravel()


def test_azimuth_noise_at_high_snr_is_the_exact_law_of_a_gaussian_ratio():
    """Error ≈ Re(conj(s) n)/|s|², s and n complex Gaussian: √(2 SNR) times it is Student's t with two
    degrees of freedom.
    """
    errors = azimuth_errors(40.0)
    scaled = errors[::3] * np.sqrt(2 * 1e4)
    assert kstest(scaled, "t", args=(2,)).statistic < 0.01


def test_circular_variance_falls_as_the_root_of_the_snr():
    """The paper's 1 − R = 1/√SNR: its exponent; the likeliest wrapped Cauchy of the exact law has 0.55
    of its factor.
    """
    spread = [1 - wrapped_cauchy_resultant(azimuth_errors(snr, 0.5)) for snr in (20.0, 40.0)]
    assert spread[0] / spread[1] == pytest.approx(10.0, rel=0.05)
    assert spread[1] * 100.0 == pytest.approx(0.55, abs=0.03)


def test_cepstrum_of_noise_has_the_papers_standard_deviation():
    """Eq. 15: σ(τ) = (0.625 + 0.2 cos(πτ/τ_s))/√N for a Hann window; normal bins of zero mean."""
    field = Field.silence(100 * 6 * 3600)
    add_ambient(field, 2 * FIRST, 100.0, Ambient.isotropic(80.0), 1)
    cut = np.lib.stride_tricks.sliding_window_view(field.pressure, 2 * NPERSEG)[::NPERSEG]
    window = np.hanning(2 * NPERSEG + 1)[:-1]
    spectra = np.abs(np.fft.rfft(cut * window, axis=1))[:, : NPERSEG // 2 + 1]  # below the filter's edge
    cepstrum = np.fft.irfft(np.log(spectra), axis=1)[:, : NPERSEG // 2]
    tau = np.arange(NPERSEG // 2) / (NPERSEG // 2)
    sigma = (0.625 + 0.2 * np.cos(np.pi * tau)) / np.sqrt(NPERSEG)
    ratio = cepstrum.std(axis=0) / sigma
    for third in np.split(ratio[8:-4], [166, 333]):
        assert third.mean() == pytest.approx(1.0, abs=0.03)
    normal = cepstrum[:, 30:480] / cepstrum[:, 30:480].std(axis=0)
    assert abs(np.mean(normal[::2] ** 4) - 3.0) < 0.1
    assert np.abs(normal.mean(axis=0)).mean() < 2.0 / np.sqrt(cepstrum.shape[0])


def test_bad_shares_are_refused():
    with pytest.raises(ConfigError, match="directional_fraction must lie between 0 and 1"):
        Ambient(directional_fraction=1.5)
    with pytest.raises(ConfigError, match="vertical_coherence"):
        Ambient(vertical_coherence=-0.1)
