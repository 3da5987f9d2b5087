import numpy as np
import pytest

from obsnet.arrays.beamforming import Beamformer, HydrophoneArray, odd_signal, odd_spectrum
from obsnet.arrays.sea_noise import NoiseSector, SeaNoise
from obsnet.errors import ConfigError, WaveformError

CARRIER, RATE, N = 750.0, 375.0, 64


def line(count=8, **settings):
    return HydrophoneArray.line(count, 0.93, **settings)


@pytest.mark.parametrize("carrier", [0.0, CARRIER])
@pytest.mark.parametrize("azimuth", [-47.0, 0.0, 13.3, 120.0])
def test_delays_are_orthogonal_to_rounding(carrier, azimuth):
    rng = np.random.default_rng(1)
    array = HydrophoneArray(rng.normal(size=(5, 3)))
    matrix = Beamformer(array, RATE, 16, [0.0], carrier).matrix(azimuth)
    np.testing.assert_allclose(matrix.T @ matrix, 5 * np.eye(16), atol=1e-12)


def test_power_is_the_energy_of_the_aligned_sum():
    beams = Beamformer(line(4), RATE, 16, np.arange(-60.0, 61.0, 20.0), CARRIER)
    batches = np.random.default_rng(2).normal(size=(3, 16, 4))
    dense = [
        [np.sum((beams.matrix(azimuth).T @ batch.ravel()) ** 2) for azimuth in beams.azimuth_deg]
        for batch in batches
    ]
    np.testing.assert_allclose(beams.power(batches), dense, rtol=1e-5)


def test_a_whole_sample_of_delay_shifts_the_batch():
    array = HydrophoneArray([[0.0, 0.0, 0.0], [0.0, -8.0, 0.0]])
    signal = np.random.default_rng(3).normal(size=32)
    received = Beamformer(array, 375.0, 32, [0.0]).delay(signal, 0.0)
    np.testing.assert_allclose(received[:, 0], signal, atol=1e-12)
    np.testing.assert_allclose(received[2:, 1], signal[:-2], atol=1e-12)
    np.testing.assert_allclose(received[:2, 1], -signal[-2:], atol=1e-12)


def test_the_beam_finds_a_demodulated_plane_wave_written_out_in_time():
    truth = 23.0
    array = line()
    time = np.arange(N) / RATE
    batch = np.zeros((N, 8))
    rng = np.random.default_rng(5)
    for baseband in np.arange(10.0, 180.0, 7.3):
        start = rng.uniform(0, 2 * np.pi)
        for hydrophone, delay in enumerate(array.delays_s(truth)):
            passband = 2 * np.pi * (CARRIER + baseband) * (time - delay)
            batch[:, hydrophone] += np.cos(passband - 2 * np.pi * CARRIER * time + start)
    beams = Beamformer(array, RATE, N, np.arange(-90.0, 91.0), CARRIER)
    power = beams.power(batch[None])[0]
    assert beams.azimuth_deg[power.argmax()] == truth
    assert power.max() == pytest.approx(8 * (batch**2).sum(), rel=0.02)
    ignorant = Beamformer(array, RATE, N, np.arange(-90.0, 91.0), 0.0).power(batch[None])[0]
    aside = beams.azimuth_deg == truth - 25.0
    assert power[aside] < 0.15 * power.max(), "the aperture counts in wavelengths at sea"
    assert ignorant[aside] > 0.5 * ignorant.max()


def test_a_source_in_the_east_reaches_the_eastern_hydrophone_first():
    delays = line(2).delays_s(90.0)
    assert delays[1] < 0 < delays[0]
    assert delays[0] - delays[1] == pytest.approx(0.93 / 1500.0)


def test_elevation_shortens_the_horizontal_delay_and_a_source_above_reaches_the_shallow_one_first():
    array = HydrophoneArray([[3.0, 0.0, 0.0], [0.0, 0.0, 6.0]])
    np.testing.assert_allclose(array.delays_s(90.0, 60.0) * 1500.0, [-1.5, 6.0 * np.sin(np.pi / 3)])


def test_a_line_cannot_tell_its_sides_apart():
    np.testing.assert_allclose(line().delays_s(20.0), line().delays_s(160.0), atol=1e-18)


def test_odd_bins_keep_energy_and_invert():
    signal = np.random.default_rng(4).normal(size=(3, 10))
    spectrum = odd_spectrum(signal)
    np.testing.assert_allclose(2 * (np.abs(spectrum) ** 2).sum(axis=-1), (signal**2).sum(axis=-1))
    np.testing.assert_allclose(odd_signal(spectrum), signal, atol=1e-12)


def test_beams_matched_to_the_whitening_keep_orthogonality_and_point_at_the_whitened_wave():
    array = line(4)
    sea = SeaNoise(0.01, 0.2, sectors=(NoiseSector(-20.0, 8.0, 0.8),))
    model = sea.noise_model(array, RATE, CARRIER, order=6)
    grid = np.arange(-60.0, 61.0, 0.5)
    matched = Beamformer(array, RATE, N, grid, CARRIER, whitening=model)
    plain = Beamformer(array, RATE, N, grid, CARRIER)
    matrix = matched.matrix(7.0)
    np.testing.assert_allclose(matrix.T @ matrix, 4 * np.eye(N), atol=1e-12)

    truth = -35.0
    transfer = model.transfer((plain.frequency_hz - CARRIER) / RATE)
    white = np.einsum("fij,jf->fi", transfer, plain.phases(truth))
    batch = odd_signal(white.T).T[None]
    assert grid[matched.power(batch)[0].argmax()] == truth
    pulled = grid[plain.power(batch)[0].argmax()]
    assert pulled < truth - 0.5, "unmatched beams are pulled away from the noise"


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: HydrophoneArray([[0.0, 0.0, 0.0]]), "2 rows at least"),
        (lambda: HydrophoneArray([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]), "finite"),
        (lambda: line(sound_speed_mps=0.0), "sound speed"),
        (lambda: HydrophoneArray.line(1, 1.0), "2 hydrophones"),
        (lambda: Beamformer(line(), RATE, 15, [0.0]), "even number"),
        (lambda: Beamformer(line(), 0.0, 16, [0.0]), "sampling rate"),
    ],
)
def test_impossible_arrays_are_refused(build, message):
    with pytest.raises(ConfigError, match=message):
        build()


def test_batches_of_another_shape_are_refused():
    with pytest.raises(WaveformError, match=r"dims \(batch, 16, 8\), found \(2, 16, 7\)"):
        Beamformer(line(), RATE, 16, [0.0]).power(np.zeros((2, 16, 7)))
