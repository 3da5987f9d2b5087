from functools import partial

import numpy as np
import pytest

from obsnet.arrays.beamforming import Beamformer, HydrophoneArray
from obsnet.arrays.likelihood import BeamLikelihood
from obsnet.errors import ConfigError
from obsnet.trackers.bernoulli_filter import BernoulliConfig
from obsnet.trackers.track_before_detect import BearingTrackerConfig, track

N, M, RATE = 32, 6, 375.0
INTERVAL = N / RATE
CONFIG = BearingTrackerConfig(INTERVAL, bernoulli=BernoulliConfig(particles=400, births=100))


def likelihoods(rng, snr_db, batches=400, start=100):
    """White noise on a line; from batch `start` a white source that turns from -20 deg at 0.05 deg/s."""
    beams = Beamformer(HydrophoneArray.line(M, 0.93), RATE, N, np.arange(-90.0, 91.0, 2.0), 750.0)
    azimuth = -20.0 + 0.05 * INTERVAL * (np.arange(batches) - start)
    azimuth[:start] = np.nan
    samples = rng.normal(size=(batches, N, M))
    source = 10 ** (snr_db / 20) * rng.normal(size=(batches - start, N))
    samples[start:] += beams.delay(source, azimuth[start:])
    beam = BeamLikelihood(-90.0, 2.0, N, M)
    power = beams.power(samples)
    return azimuth, [
        partial(beam, row, energy) for row, energy in zip(power, (samples**2).sum((1, 2)), strict=True)
    ]


def test_a_target_below_the_noise_is_confirmed_and_its_azimuth_and_snr_follow():
    azimuth, batches = likelihoods(np.random.default_rng(1), snr_db=-12.0)
    result = track(batches, CONFIG, np.random.default_rng(2))
    assert (result.existence[:100] < 0.9).all()
    assert (result.existence[160:] > 0.9).all()
    error = (result.azimuth_deg - azimuth)[160:]
    assert np.sqrt(np.mean(error**2)) < 3.0
    assert np.mean(np.abs(error) < 3 * result.azimuth_std_deg[160:]) > 0.9
    assert result.snr_db[300:].mean() == pytest.approx(-12.0, abs=1.5)


def test_missing_batches_lower_no_evidence_but_widen_the_azimuth():
    _, batches = likelihoods(np.random.default_rng(3), snr_db=-8.0, batches=260)
    batches[200:240] = [None] * 40
    result = track(batches, CONFIG, np.random.default_rng(4))
    assert result.existence[199] > 0.99
    assert result.existence[239] == pytest.approx(
        1 - (1 - result.existence[199]) - (1 - CONFIG.bernoulli.survival**40), abs=1e-3
    )
    assert result.azimuth_std_deg[239] > 1.5 * result.azimuth_std_deg[199]
    assert result.existence[-1] > 0.99


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"interval_s": 0.0}, "interval_s"),
        ({"snr_rate_db_s": -1.0}, "snr_rate_db_s"),
        ({"min_snr_db": 0.0, "max_snr_db": 0.0}, "min_snr_db must be below max_snr_db"),
        ({"min_azimuth_deg": 70.0}, "min_azimuth_deg"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        BearingTrackerConfig(**{"interval_s": INTERVAL} | settings)
