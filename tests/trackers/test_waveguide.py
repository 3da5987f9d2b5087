import numpy as np
import pytest
from scipy.optimize import minimize

from obsnet.errors import ConfigError
from obsnet.ocean.bottom import Bottom
from obsnet.trackers.waveguide import Hearing, ImageModel


def shortest(source_depth, receiver_depth, range_m, surfaces):
    """Length of the path that touches the given depths in turn: least time over the places where it does."""

    def length(places):
        x = np.concatenate([[0.0], places, [range_m]])
        z = np.concatenate([[source_depth], surfaces, [receiver_depth]])
        return np.hypot(np.diff(x), np.diff(z)).sum()

    if not surfaces:
        return length([])
    start = np.linspace(0, range_m, len(surfaces) + 2)[1:-1]
    return minimize(length, start, method="BFGS", options={"gtol": 1e-9}).fun


def test_image_delays_are_those_of_the_shortest_reflected_paths():
    water, receiver, source, distance, speed = 65.0, 22.0, 9.0, 140.0, 1508.0
    reflections = {
        "direct": [],
        "surface": [0.0],
        "bottom": [water],
        "bottom-surface": [water, 0.0],
        "surface-bottom": [0.0, water],
        "surface-bottom-surface": [0.0, water, 0.0],
        "bottom-surface-bottom": [water, 0.0, water],
        "bottom-surface-bottom-surface": [water, 0.0, water, 0.0],
    }
    paths = tuple(reflections)
    times = {p: shortest(source, receiver, distance, reflections[p]) / speed for p in paths}
    model = ImageModel(water, speed, paths)
    found = model.tdoas(np.array([distance]), np.array([source]), receiver)[0]
    assert len(found) == 28
    for pair, delay in zip(model.pairs, found, strict=True):
        first, second = pair.split(",")
        assert delay == pytest.approx(abs(times[first] - times[second]), abs=1e-8)


def test_no_paths_from_outside_the_water():
    model = ImageModel(65.0, 1508.0)
    delays = model.tdoas(np.array([-1.0, 100.0, 100.0, 100.0]), np.array([0.0, -1.0, 66.0, 65.0]), 20.0)
    np.testing.assert_array_equal(np.isnan(delays).all(axis=1), [True, True, True, False])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1500.0), "water depth must be positive"),
        ((65.0, np.nan), "sound speed must be positive"),
        ((65.0, 1500.0, ("direct", "botom")), "unknown path 'botom'"),
        ((65.0, 1500.0, ("direct", "direct")), "two different paths"),
    ],
)
def test_bad_waveguides_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        ImageModel(*arguments)


@pytest.mark.parametrize("depth", [None, -1.0, 66.0, np.nan])
def test_a_receiver_out_of_the_water_is_refused(depth):
    with pytest.raises(ConfigError, match="receiver's depth must lie in the water"):
        ImageModel(65.0, 1508.0).tdoas(np.array([100.0]), np.array([0.0]), depth)


TWO_BOUNCES = ("direct", "bottom", "bottom-surface", "bottom-surface-bottom", "bottom-surface-bottom-surface")
SILT = Bottom(p_speed_mps=1575.0, s_speed_mps=80.0, density_kgm3=1700.0, water_density_kgm3=1000.0)
CLAY = Bottom(p_speed_mps=1490.0, s_speed_mps=0.0, density_kgm3=1450.0, water_density_kgm3=1000.0)


def heard(bottom, source_depth=4.0, floor=0.04, paths=TWO_BOUNCES):
    hearing = Hearing(bottom, source_depth, 3000.0, np.array([1e-3, 0.1]), np.array([floor, floor]))
    return ImageModel(73.0, 1508.0, paths, bounces_apart=1, hearing=hearing)


def test_pairs_of_successive_bounces_begin_with_those_of_the_paper():
    pairs = heard(SILT).pairs
    assert pairs[:3] == ImageModel(73.0, 1508.0).pairs and len(pairs) == 8
    assert not any(pair.startswith("direct,bottom-surface-bottom") for pair in pairs)


def test_visibility_is_that_of_paths_summed_frequency_by_frequency():
    """Energy of source and image, path by path, over the band; no closed form."""
    model, floor, receiver = heard(SILT), 0.04, 18.0
    frequency = np.arange(0.5, 3000.0, 1.0)
    for distance in (150.0, 900.0, 2500.0):
        energy = []
        for multiple, sign in ((0, 1), (2, -1), (2, 1), (4, -1), (4, 1)):
            image = multiple * 73.0 + sign * receiver
            length = np.hypot(distance, image)
            reflection = abs(SILT.reflection(np.array([distance / length / 1508.0]), 1508.0)[0])
            lag = 2 * 4.0 * abs(image) / length / 1508.0
            pressure = 1.0 - np.exp(-2j * np.pi * frequency * lag)
            energy.append(np.mean(np.abs(pressure) ** 2) * reflection**multiple / length**2)
        energy = np.array(energy)
        for pair, found in zip(model.pairs, model.visibility(np.array([distance]), receiver)[0], strict=True):
            a, b = (TWO_BOUNCES.index(path) for path in pair.split(","))
            amplitude = np.sqrt(energy[a] * energy[b]) / energy.sum()
            assert found == pytest.approx(amplitude**2 / (amplitude**2 + floor**2), rel=0.02, abs=1e-3)


def test_cepstrum_of_two_paths_has_the_amplitude_that_visibility_assumes():
    """ln |1 + a exp(-iωτ)|² has a peak of height a at τ, and a pair as high as the floor is seen half as often."""
    distance, receiver = 4.0, 40.0
    lengths = np.hypot(distance, [receiver, 2 * 73.0 - receiver])
    reflection = abs(SILT.reflection(np.array([distance / lengths[1] / 1508.0]), 1508.0)[0])
    weak = reflection * lengths[0] / lengths[1]
    step = 1.0 / 8192
    turns = np.exp(-2j * np.pi * np.arange(8192) * step * 100)
    height = np.fft.ifft(np.log(np.abs(1.0 + weak * turns) ** 2)).real[100]
    assert abs(height) == pytest.approx(weak, rel=1e-6) and weak < 0.2
    # So deep a source does not interfere with its image.
    seen = heard(SILT, 500.0, weak, ("direct", "bottom")).visibility(np.array([distance]), receiver)
    assert seen[0, 0] == pytest.approx(0.5, abs=0.04)


def test_the_surface_takes_the_direct_sound_and_the_bottom_decides_on_a_second_bounce():
    near, far = np.array([400.0]), np.array([2500.0])
    direct, second = 0, 7
    silt = heard(SILT)
    assert silt.pairs[direct] == "direct,bottom"
    assert silt.pairs[second] == "bottom-surface-bottom,bottom-surface-bottom-surface"
    assert silt.visibility(near, 15.0)[0, direct] > 0.9 > 0.5 > silt.visibility(far, 8.0)[0, direct]
    assert silt.visibility(far, 8.0)[0, second] > 0.9
    assert heard(CLAY).visibility(near, 15.0)[0, second] < 0.1


def test_visibility_is_a_factor_everywhere():
    at = np.array([0.0, 1e-6, 1.0, 50e3])
    for receiver in (0.0, 20.0, 73.0):
        seen = heard(SILT).visibility(at, receiver)
        assert seen.shape == (4, 8) and (seen >= 0).all() and (seen <= 1).all()
    np.testing.assert_array_equal(ImageModel(73.0, 1508.0).visibility(at), np.ones((1, 3)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((SILT, 0.0, 3000.0, [0.001], [0.1]), "source_depth_m must be positive"),
        ((SILT, 4.0, 3000.0, [0.001, 0.002], [0.1]), "one amplitude for each delay"),
        ((SILT, 4.0, 3000.0, [0.002, 0.001], [0.1, 0.1]), "increasing delays and positive amplitudes"),
        ((SILT, 4.0, 3000.0, [0.001], [0.0]), "increasing delays and positive amplitudes"),
    ],
)
def test_bad_hearing_is_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        Hearing(*arguments[:3], np.array(arguments[3]), np.array(arguments[4]))


def test_paths_that_hearing_would_count_twice_and_lonely_paths_are_refused():
    with pytest.raises(ConfigError, match="leave out the paths that begin there"):
        heard(SILT, paths=("direct", "surface"))
    with pytest.raises(ConfigError, match="no two of"):
        ImageModel(73.0, 1508.0, ("direct", "bottom-surface-bottom"), bounces_apart=1)
