import numpy as np
import pytest

from obsnet.arrays import whitening
from obsnet.arrays.whitening import NoiseModel, Whitener
from obsnet.errors import ConfigError, WaveformError


def two_channels():
    """A stable VAR(2) with correlated innovations."""
    coefficients = np.array([[[0.5, 0.2], [-0.3, 0.4]], [[-0.4, 0.0], [0.1, -0.3]]])
    return NoiseModel(coefficients, np.array([[2.0, 0.6], [0.6, 1.0]]))


def written_out(model, innovations):
    """The definition, sample by sample, from a zero past."""
    record = np.zeros_like(innovations)
    for n in range(len(record)):
        past = sum(a @ record[n - k] for k, a in enumerate(model.coefficients, 1) if n >= k)
        record[n] = innovations[n] + past
    return record


def test_whitening_undoes_the_noise_model_exactly():
    model = two_channels()
    white = np.random.default_rng(1).normal(size=(50, 2))
    record = written_out(model, white @ model.square_root())
    np.testing.assert_allclose(Whitener(model)(record), white, atol=1e-12)


def test_whitening_in_batches_is_whitening_as_a_whole():
    model = two_channels()
    record = model.simulate(100, np.random.default_rng(2))
    whole, batched = Whitener(model)(record), Whitener(model)
    parts = [batched(part) for part in np.split(record, [1, 2, 30, 97])]
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-13)


def test_least_squares_is_that_of_lstsq_and_recovers_the_model():
    model = two_channels()
    record = model.simulate(40_000, np.random.default_rng(3))
    fitted = whitening.fit(record, 2)
    design = np.concatenate([record[1:-1], record[:-2]], axis=1)
    oracle = np.linalg.lstsq(design, record[2:], rcond=None)[0].T
    np.testing.assert_allclose(np.concatenate(list(fitted.coefficients), axis=1), oracle, atol=1e-10)
    residual = record[2:] - design @ oracle.T
    np.testing.assert_allclose(fitted.covariance, residual.T @ residual / len(residual))
    np.testing.assert_allclose(fitted.coefficients, model.coefficients, atol=0.03)
    np.testing.assert_allclose(fitted.covariance, model.covariance, atol=0.05)


def test_whitened_noise_is_white():
    model = two_channels()
    record = model.simulate(40_000, np.random.default_rng(4))
    white = Whitener(whitening.fit(record, 2))(record)[10:]
    np.testing.assert_allclose(np.cov(white.T), np.eye(2), atol=0.02)
    for lag in (1, 2, 5):
        assert np.abs(white[lag:].T @ white[:-lag] / len(white)).max() < 0.03
    assert np.abs(record[1:].T @ record[:-1] / len(record)).max() > 0.3


def test_order_zero_whitens_in_space_alone():
    record = two_channels().simulate(20_000, np.random.default_rng(5))
    model = whitening.fit(record, 0)
    assert model.order == 0 and model.is_stable
    np.testing.assert_allclose(model.covariance, record.T @ record / len(record))
    white = Whitener(model)(record)
    np.testing.assert_allclose(white.T @ white / len(white), np.eye(2), atol=1e-9)


def test_akaike_finds_the_order_and_its_terms_are_those_of_the_definition():
    record = two_channels().simulate(5_000, np.random.default_rng(6))
    criterion = whitening.akaike(record, range(6))
    assert min(criterion, key=criterion.get) == 2 == whitening.select_order(record, range(6))
    common = record[5 - 3 :]
    model = whitening.fit(common, 3)
    used = len(record) - 5
    assert criterion[3] == pytest.approx(used * np.log(np.linalg.det(model.covariance)) + 2 * 3 * 4)


def test_stability_is_the_largest_root():
    model = NoiseModel(np.array([[[0.9, 0.0], [5.0, -0.5]]]), np.eye(2))
    assert model.spectral_radius == pytest.approx(0.9)
    assert model.is_stable
    unstable = NoiseModel(np.array([[[1.01]]]), np.eye(1))
    assert not unstable.is_stable
    with pytest.raises(ConfigError, match=r"unstable noise model \(spectral radius 1.0100\)"):
        unstable.simulate(10, np.random.default_rng(0))


def test_spectrum_and_power_of_a_first_order_process_have_their_closed_form():
    model = NoiseModel(np.array([[[0.8]]]), np.array([[2.0]]))
    cycles = np.linspace(0.0, 0.5, 11)
    expected = 2.0 / np.abs(1 - 0.8 * np.exp(-2j * np.pi * cycles)) ** 2
    np.testing.assert_allclose(model.spectral_density(cycles)[:, 0, 0].real, expected)
    assert model.autocovariance()[0, 0] == pytest.approx(2.0 / (1 - 0.64))
    simulated = model.simulate(200_000, np.random.default_rng(7))
    assert simulated.var() == pytest.approx(2.0 / (1 - 0.64), rel=0.03)


def test_yule_walker_finds_the_model_that_has_the_autocovariances():
    model = two_channels()
    cycles = (np.arange(4096) + 0.5) / 4096
    density = model.spectral_density(cycles)
    lags = [(density * np.exp(2j * np.pi * cycles * k)[:, None, None]).mean(axis=0).real for k in range(3)]
    found = whitening.from_autocovariance(np.array(lags))
    np.testing.assert_allclose(found.coefficients, model.coefficients, atol=1e-9)
    np.testing.assert_allclose(found.covariance, model.covariance, atol=1e-9)


def test_the_symmetric_root_changes_the_samples_least():
    rng = np.random.default_rng(8)
    factor = rng.normal(size=(4, 4))
    covariance = factor @ factor.T
    symmetric = NoiseModel(np.zeros((0, 4, 4)), covariance).inverse_square_root()

    def change(whiten):
        return np.trace((whiten - np.eye(4)) @ covariance @ (whiten - np.eye(4)).T)

    others = [np.linalg.inv(np.linalg.cholesky(covariance))]
    others += [np.linalg.qr(rng.normal(size=(4, 4)))[0] @ symmetric for _ in range(20)]
    for other in others:
        np.testing.assert_allclose(other @ covariance @ other.T, np.eye(4), atol=1e-9)
        assert change(symmetric) < change(other)


def test_transfer_is_what_the_filter_does_to_a_plane_wave():
    model = two_channels()
    cycles, phases = 0.17, np.array([1.0, np.exp(-0.7j)])
    wave = np.exp(2j * np.pi * cycles * np.arange(60))[:, None] * phases
    out = Whitener(model)(wave.real) + 1j * Whitener(model)(wave.imag)
    expected = model.transfer(np.array([cycles]))[0] @ phases * np.exp(2j * np.pi * cycles * 59)
    np.testing.assert_allclose(out[-1], expected, atol=1e-12)


def nan_at(record, index):
    record = record.copy()
    record[index, 0] = np.nan
    return record


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (nan_at(np.random.default_rng(9).normal(size=(500, 3)), 7), "1 of 500 samples are missing"),
        (np.random.default_rng(9).normal(size=(10, 3)), "over 11 samples, found 10"),
        (np.random.default_rng(9).normal(size=500), "dims"),
        (
            np.random.default_rng(9).normal(size=(500, 3)) * [1.0, 0.0, 1.0],
            "does not determine a noise model",
        ),
    ],
)
def test_records_that_cannot_serve_are_refused(samples, message):
    with pytest.raises(WaveformError, match=message):
        whitening.fit(samples, 2)


def test_a_channel_that_copies_another_is_refused():
    record = np.random.default_rng(10).normal(size=(500, 2))
    with pytest.raises(WaveformError, match="does not determine a noise model"):
        whitening.fit(record[:, [0, 1, 1]], 1)


def test_a_whitener_refuses_other_channels_and_gaps():
    whitener = Whitener(two_channels())
    with pytest.raises(WaveformError, match=r"dims \(time, 2\), found \(5, 3\)"):
        whitener(np.zeros((5, 3)))
    with pytest.raises(WaveformError, match="whiten each stretch"):
        whitener(np.full((5, 2), np.nan))


@pytest.mark.parametrize(
    ("coefficients", "covariance", "message"),
    [
        (np.zeros((1, 2, 2)), np.eye(3), "coefficients"),
        (np.zeros((1, 2, 2)), np.diag([1.0, 0.0]), "positive definite"),
        (np.zeros((1, 2, 2)), np.array([[1.0, 0.5], [0.0, 1.0]]), "positive definite"),
        (np.full((1, 2, 2), np.nan), np.eye(2), "not finite"),
    ],
)
def test_impossible_models_are_refused(coefficients, covariance, message):
    with pytest.raises(ConfigError, match=message):
        NoiseModel(coefficients, covariance)
