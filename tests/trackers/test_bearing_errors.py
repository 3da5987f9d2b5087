import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.bearing_errors import BearingErrors, correlation, estimate_correlation

TIME = np.arange(0.0, 200.0)


def test_models_are_the_equations_of_the_paper():
    lag = np.array([0.0, 30.0, 75.0, 150.0, 300.0])
    np.testing.assert_allclose(correlation(lag, 150.0, "linear"), [1, 0.8, 0.5, 0, 0])
    np.testing.assert_allclose(correlation(lag[1:], 150.0, "sinc"), np.sin(lag[1:] / 150) / (lag[1:] / 150))
    np.testing.assert_allclose(correlation(lag, 150.0, "exponential"), np.exp(-((lag / 75.0) ** 2)))


def test_no_correlation_is_the_diagonal():
    np.testing.assert_array_equal(BearingErrors(3.0, 0.0).covariance(TIME), 9.0 * np.eye(len(TIME)))


def test_lowpass_model_is_the_autocorrelation_of_filtered_noise():
    rng = np.random.default_rng(0)
    sections = butter(6, 1 / (2 * 40.0), fs=1.0, output="sos")
    noise = sosfilt(sections, rng.standard_normal(400_000))[1000:]
    measured = [
        np.mean(noise[: len(noise) - lag] * noise[lag:]) / np.mean(noise**2) for lag in (10, 25, 40, 80)
    ]
    np.testing.assert_allclose(
        correlation(np.array([10, 25, 40, 80]), 40.0, "butterworth"), measured, atol=0.05
    )


@pytest.mark.parametrize("model", ["sinc", "exponential", "butterworth"])
def test_smooth_models_are_singular_without_the_nugget_and_conditioned_with_it(model):
    bare = BearingErrors(2.0, 150.0, model, nugget=0.0).covariance(TIME)
    assert np.linalg.cond(bare) > 1e12
    errors = BearingErrors(2.0, 150.0, model)
    values = np.linalg.eigvalsh(errors.covariance(TIME))
    assert values.min() >= 0.999 * errors.white_share * 2.0**2
    assert values.max() / values.min() <= len(TIME) / errors.white_share
    np.testing.assert_allclose(np.diag(errors.covariance(TIME)), 4.0)


@pytest.mark.parametrize("correlation_s", [1.5, 50.0, 150.0, 1e4])
def test_linear_model_needs_no_nugget(correlation_s):
    covariance = BearingErrors(2.0, correlation_s).covariance(TIME)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.linalg.cond(covariance) < 1e8


@pytest.mark.parametrize("model", ["linear", "sinc", "exponential", "butterworth"])
def test_draws_have_the_covariance(model):
    errors = BearingErrors(2.0, 60.0, model)
    time = np.arange(0.0, 120.0, 10.0)
    drawn = errors.sample(time, 40_000, np.random.default_rng(1))
    np.testing.assert_allclose(np.cov(drawn.T), errors.covariance(time), atol=0.12)


def test_each_bearing_may_have_its_own_deviation():
    std = np.linspace(1.0, 4.0, len(TIME))
    errors = BearingErrors(1.0, 50.0)
    np.testing.assert_allclose(
        errors.covariance(TIME, std), np.diag(std) @ errors.covariance(TIME) @ np.diag(std)
    )


@pytest.mark.parametrize("true", [BearingErrors(2.0, 150.0), BearingErrors(5.0, 60.0, nugget=0.4)])
def test_passages_give_back_size_and_correlation(true):
    time = np.arange(0.0, 900.0, 10.0)
    passages = list(true.sample(time, 80, np.random.default_rng(2)))
    found = estimate_correlation(passages, [time] * len(passages))
    assert abs(found.std_deg - true.std_deg) < 3 * found.std_uncertainty_deg
    assert abs(found.correlation_s - true.correlation_s) < 3 * found.correlation_uncertainty_s
    assert found.std_uncertainty_deg < 0.1 * true.std_deg
    assert found.correlation_uncertainty_s < 0.2 * true.correlation_s
    assert found.errors.white_share == pytest.approx(true.white_share, abs=0.05)


def test_independent_errors_have_no_correlation():
    time = np.arange(0.0, 900.0, 10.0)
    passages = list(BearingErrors(3.0).sample(time, 40, np.random.default_rng(3)))
    found = estimate_correlation(passages, [time] * 40)
    lagged = (1 - found.errors.white_share) * correlation(np.array([10.0]), found.correlation_s)[0]
    assert abs(lagged) < 0.05
    assert found.std_deg == pytest.approx(3.0, rel=0.05)


def test_false_bearings_and_gaps_do_not_count_as_errors():
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 900.0, 10.0)
    clean = BearingErrors(3.0, 100.0).sample(time, 40, rng)
    spoilt = clean.copy()
    spoilt[rng.random(spoilt.shape) < 0.1] = 120.0
    spoilt[rng.random(spoilt.shape) < 0.1] = np.nan
    one, other = (estimate_correlation(list(values), [time] * 40) for values in (clean, spoilt + 360.0))
    assert other.std_deg == pytest.approx(one.std_deg, rel=0.05)
    assert other.correlation_s == pytest.approx(one.correlation_s, rel=0.15)


def test_one_passage_alone_has_no_uncertainty():
    time = np.arange(0.0, 900.0, 10.0)
    found = estimate_correlation(BearingErrors(2.0, 100.0).sample(time, 1, np.random.default_rng(5))[0], time)
    assert np.isnan(found.std_uncertainty_deg)
    assert found.std_deg > 0


def test_what_is_refused():
    with pytest.raises(ConfigError, match="std_deg must be positive, found 0"):
        BearingErrors(0.0)
    with pytest.raises(ConfigError, match="correlation_s must be zero or positive, found -1"):
        BearingErrors(2.0, -1.0)
    with pytest.raises(ConfigError, match="model must be one of linear, sinc"):
        BearingErrors(2.0, 1.0, "triangle")
    with pytest.raises(ConfigError, match=r"nugget must lie in \[0, 1\], found 2"):
        BearingErrors(2.0, 1.0, nugget=2.0)
    with pytest.raises(LayoutError, match="needs 8 bearings within 45° of the truth, found 3"):
        estimate_correlation(np.zeros(3), np.arange(3.0))
    with pytest.raises(LayoutError, match="passage 0: residuals"):
        estimate_correlation([np.zeros(30)], [np.arange(29.0)])
    with pytest.raises(LayoutError, match="one array of times per passage"):
        estimate_correlation([np.zeros(30), np.zeros(30)], [np.arange(30.0)])
