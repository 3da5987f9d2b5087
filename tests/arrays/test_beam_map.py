import numpy as np
import pytest

from obsnet.arrays.beam_map import BeamMapConfig, azimuth_map
from obsnet.arrays.beamforming import Beamformer, HydrophoneArray
from obsnet.arrays.sea_noise import NoiseSector, SeaNoise
from obsnet.detectors.maps import azimuth_presence
from obsnet.errors import ConfigError, WaveformError
from obsnet.trackers.bernoulli import AzimuthTrackerConfig, track_azimuth

N, RATE, CARRIER, TRUTH = 64, 375.0, 750.0, -37.0
BEAMS = Beamformer(HydrophoneArray.line(8, 0.93), RATE, N, np.arange(-90.0, 91.0), CARRIER)
MODEL = SeaNoise(0.05, 0.35, sectors=(NoiseSector(20.0, 8.0, 0.6),)).noise_model(
    BEAMS.array, RATE, CARRIER, 6
)


def record(rng, batches=480, start=240, snr_db=-14.0):
    samples = MODEL.simulate(batches * N, rng).reshape(batches, N, 8)
    source = 10 ** (snr_db / 20) * rng.normal(size=(batches - start, N))
    samples[start:] += BEAMS.delay(source, TRUTH)
    return samples.reshape(-1, 8)


def test_a_source_below_the_noise_shows_at_its_azimuth_and_only_while_it_is_there():
    maps = azimuth_map(record(np.random.default_rng(1)), 1e9, BEAMS, MODEL)
    presence = azimuth_presence(maps["azimuth_llr"].values)
    assert maps.sizes["time"] == 8
    assert (presence[:4] < 0).all() and (presence[4:] > 3).all()
    best = maps["azimuth"].values[maps["azimuth_llr"].values[4:].argmax(axis=1)]
    assert np.abs(best - TRUTH).max() < 5.0
    assert maps["azimuth_coverage"].values[0] == pytest.approx(58 / 59), "the first batch has no past"
    assert (maps["azimuth_coverage"].values[1:] == 1).all()
    seconds = (maps["time"].values - np.datetime64("2001-09-09T01:46:40")) / np.timedelta64(1, "s")
    np.testing.assert_allclose(seconds[:2], np.array([0.5, 1.5]) * 59 * N / RATE, atol=1e-6)


def test_the_bernoulli_filter_tracks_from_the_map():
    maps = azimuth_map(record(np.random.default_rng(2)), 0.0, BEAMS, MODEL)
    config = AzimuthTrackerConfig(interval_s=59 * N / RATE, weight=1.0)
    times = (np.arange(8) + 0.5) * config.interval_s
    track = track_azimuth(times, maps["azimuth_llr"].values, maps["azimuth"].values, config)
    assert (track.existence[:4] < 0.5).all() and track.existence[-1] > 0.9
    assert track.azimuth_deg[-1] == pytest.approx(TRUTH % 360.0, abs=4.0)


def test_gaps_cost_their_own_batches_only():
    samples = record(np.random.default_rng(3))
    whole = azimuth_map(samples, 0.0, BEAMS, MODEL)
    holed = samples.copy()
    holed[59 * N : 2 * 59 * N] = np.nan
    holed[5 * 59 * N + 10] = np.nan
    maps = azimuth_map(holed, 0.0, BEAMS, MODEL)
    assert np.isnan(maps["azimuth_llr"].values[1]).all() and maps["azimuth_coverage"][1] == 0.0
    assert maps["azimuth_coverage"][5] == pytest.approx(58 / 59)
    np.testing.assert_allclose(maps["azimuth_llr"][3], whole["azimuth_llr"][3], rtol=1e-4)
    assert float(maps["azimuth_llr"][5].max()) == pytest.approx(
        float(whole["azimuth_llr"][5].max()), rel=0.06
    )


def test_records_that_cannot_serve_are_refused():
    with pytest.raises(WaveformError, match=r"dims \(time, 8\)"):
        azimuth_map(np.zeros((100, 7)), 0.0, BEAMS, MODEL)
    with pytest.raises(WaveformError, match="do not fill one window"):
        azimuth_map(np.zeros((100, 8)), 0.0, BEAMS, MODEL)
    with pytest.raises(ConfigError, match="degrees of freedom"):
        BeamMapConfig(degrees_of_freedom=2.0)
