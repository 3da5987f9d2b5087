import numpy as np
import pytest
from scipy.io import wavfile

from obsnet.arrays.clicks import ClickConfig, ClickMapConfig, CompactArray, DetectorConfig, process
from obsnet.config import build
from obsnet.errors import ConfigError, WaveformError
from obsnet.kinematics import wrap180

RATE = 96_000
ARRAY = CompactArray.tetrahedron(depth_m=300.0)
FIVE = CompactArray((0.0, 1.3, -0.7, 0.2, 0.9), (0.0, 0.4, 1.1, -0.9, 0.3), (100.0, 100.2, 99.1, 99.6, 98.7))
DIRECTIONS = ((5.0, 20.0), (355.0, 55.0), (120.0, 5.0), (250.0, -15.0), (180.0, 70.0), (90.0, 35.0))


def recording(array, directions, amplitude=8.0, seed=0, duration_s=4.0):
    """Simulated clicks, one each 0.6 s from 0.5 s on, in white noise of standard deviation 1."""
    rng = np.random.default_rng(seed)
    samples = rng.normal(0.0, 1.0, (array.count, int(duration_s * RATE)))
    centre = array.positions.mean(axis=0)
    time = np.arange(samples.shape[1]) / RATE
    for k, (azimuth, elevation) in enumerate(directions):
        azimuth, elevation = np.deg2rad((azimuth, elevation))
        towards = np.array(
            [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), -np.sin(elevation)]
        )
        arrival = 0.5 + 0.6 * k - (array.positions - centre) @ towards / array.sound_speed_mps
        for row, moment in enumerate(arrival):
            lag = time - moment
            near = np.abs(lag) < 2e-3
            pulse = np.exp(-0.5 * (lag[near] * 2 * np.pi * 2500.0) ** 2) * np.cos(
                2 * np.pi * 12e3 * lag[near]
            )
            samples[row, near] += amplitude * pulse
    return samples


def write(path, samples):
    wavfile.write(path, RATE, np.round(samples.T / np.abs(samples).max() * 30_000).astype(np.int16))
    return path


@pytest.mark.parametrize("array", [ARRAY, FIVE])
def test_directions_of_clicks_in_a_wav_file(tmp_path, array):
    path = write(tmp_path / "array.wav", recording(array, DIRECTIONS))
    record = process(path, array, ClickConfig(echoes=False), starttime=1000.0)
    frame = record.frame()
    assert len(frame) == len(DIRECTIONS) and frame.accepted.all()
    np.testing.assert_allclose(frame.time, 1000.5 + 0.6 * np.arange(len(DIRECTIONS)), atol=5e-4)
    truth = np.array(DIRECTIONS)
    turn, rise = wrap180(frame.azimuth_deg - truth[:, 0]), frame.elevation_deg - truth[:, 1]
    assert (np.abs(turn) < 4.0 * frame.azimuth_std_deg).all() and (
        np.abs(rise) < 4.0 * frame.elevation_std_deg
    ).all()
    assert frame.elevation_std_deg.max() < 1.0
    assert (record.start, record.end) == (1000.0, 1004.0)


def test_gain_and_the_order_of_hydrophones_do_not_matter():
    samples = recording(ARRAY, DIRECTIONS)
    first = process((RATE, samples), ARRAY)
    order = [2, 0, 3, 1]
    shuffled = CompactArray(
        *(tuple(np.array(values)[order]) for values in (ARRAY.east_m, ARRAY.north_m, ARRAY.depth_m))
    )
    second = process((RATE, 1e-3 * samples[order]), shuffled)
    np.testing.assert_allclose(
        wrap180(first.directions.azimuth_deg - second.directions.azimuth_deg), 0.0, atol=1e-3
    )
    np.testing.assert_allclose(first.directions.elevation_deg, second.directions.elevation_deg, atol=1e-3)


def test_the_stairs_are_there_only_where_asked_for():
    samples = recording(ARRAY, DIRECTIONS, amplitude=60.0)
    stairs = process((RATE, samples), ARRAY, ClickConfig(interpolation="none"))
    np.testing.assert_allclose(stairs.tdoa * RATE, np.round(stairs.tdoa * RATE), atol=1e-9)
    smooth = process((RATE, samples), ARRAY)
    truth = np.array([ARRAY.tdoa(*direction, smooth.pairs) for direction in DIRECTIONS])
    assert np.abs(smooth.tdoa - truth).max() < 0.15 / RATE < np.abs(stairs.tdoa - truth).max()


def test_channels_name_the_hydrophones():
    samples = recording(ARRAY, DIRECTIONS)
    wide = np.vstack([np.zeros(samples.shape[1]), samples[::-1]])
    with pytest.raises(WaveformError, match="has 5 channels and the array 4 hydrophones"):
        process((RATE, wide), ARRAY)
    record = process((RATE, wide), ARRAY, ClickConfig(channels=(5, 4, 3, 2)))
    np.testing.assert_array_equal(record.tdoa, process((RATE, samples), ARRAY).tdoa)


def test_a_hydrophone_that_hears_nothing_can_be_spared():
    samples = recording(FIVE, DIRECTIONS)
    samples[2] = 0.0
    assert len(process((RATE, samples), FIVE).time) == 0
    record = process((RATE, samples), FIVE, ClickConfig(DetectorConfig(min_hydrophones=4), echoes=False))
    assert len(record.time) == len(DIRECTIONS)
    assert np.isnan(record.tdoa[:, (record.pairs == 2).any(axis=1)]).all()
    np.testing.assert_allclose(record.directions.elevation_deg, np.array(DIRECTIONS)[:, 1], atol=2.0)


def test_a_gap_is_no_silence():
    samples = recording(ARRAY, DIRECTIONS)
    samples[1, RATE : 3 * RATE] = np.nan
    record = process((RATE, samples), ARRAY, starttime=50.0)
    np.testing.assert_allclose(record.gaps, [[51.0, 53.0]], atol=1e-4)
    assert len(record.time) == 2
    maps = record.azimuth_map(np.array([52.0]), config=ClickMapConfig(window_s=4.0))
    assert float(maps["azimuth_coverage"][0]) == pytest.approx(0.5, abs=1e-4)
    assert np.isnan(
        record.azimuth_map(np.array([52.0]), config=ClickMapConfig(window_s=1.0))["azimuth_llr"]
    ).all()


@pytest.mark.parametrize("samples", [np.zeros((4, RATE)), np.random.default_rng(1).normal(size=(4, RATE))])
def test_nothing_heard_is_an_empty_record(samples):
    record = process((RATE, samples), ARRAY)
    assert not record.direct.any()
    assert len(record.frame()) == len(record.time)
    maps = record.azimuth_map(np.array([0.5]))
    assert (maps["azimuth_llr"].values < 0.0).all()


def test_the_record_ends_in_an_azimuth_map():
    record = process((RATE, recording(ARRAY, [(217.0, 30.0)] * 6)), ARRAY)
    maps = record.azimuth_map(np.array([2.0]), np.arange(0.0, 360.0, 0.5))
    assert float(maps["azimuth"][int(maps["azimuth_llr"].values[0].argmax())]) == pytest.approx(
        217.0, abs=0.5
    )
    assert float(maps["azimuth_llr"].max()) > 5.0 > float(maps["azimuth_llr"].sel(azimuth=100.0)[0])


def test_parameters_out_of_range_are_named():
    for values, message in (
        ({"click_s": 0.0}, "click_s must be positive"),
        ({"timing_std_s": -1.0}, "timing_std_s must be at least 0"),
        ({"false_rejection": 1.0}, "false_rejection must lie"),
        ({"max_range_m": 0.0}, "max_range_m must be positive"),
    ):
        with pytest.raises(ConfigError, match=message):
            ClickConfig(**values)


def test_the_configuration_is_built_from_plain_values():
    values = {
        "detector": {"min_hydrophones": 3, "margin": 0.1},
        "channels": [2, 1, 4, 3],
        "interpolation": "none",
    }
    config = build(ClickConfig, values)
    assert (config.channels, config.detector.margin, config.interpolation) == ((2, 1, 4, 3), 0.1, "none")
    with pytest.raises(ConfigError, match="interpolation must be one of none, parabolic, upsampled"):
        build(ClickConfig, {"interpolation": "cubic"})
