from dataclasses import replace

import numpy as np
import pytest

from obsnet.calibration.orientation import downward_flux, rotation
from obsnet.calibration.passages import Heard, Passages

FREQUENCY = 11.0 + np.arange(60) / 20.48 * 4
FRAMES = 700


def passages(turn_deg, courses=((6000.0, 1.0),), directed=0.6, seed=0, snr=30.0, reversed_hydrophone=False):
    """Ships going north past the station, each with its own lines, in noise of which `directed` is from 250°.

    The station believes its azimuths are `turn_deg` less than they are. Unit impedance: v = p u.
    """
    generator = np.random.default_rng(seed)
    time = 1.37e9 + 10.24 * np.arange(FRAMES)
    north = 8.0 * (time - time.mean())
    shape = (FREQUENCY.size, FRAMES)

    def gaussian(power):
        return np.sqrt(power / 2) * (generator.normal(size=shape) + 1j * generator.normal(size=shape))

    p, vx, vy, vz = gaussian(1.0 - directed), gaussian(0.3), gaussian(0.3), gaussian(0.2)

    def add(source, azimuth_deg):
        nonlocal p, vx, vy, vz
        angle = np.deg2rad(azimuth_deg - turn_deg)
        p, vx, vy, vz = (
            p + source,
            vx - source * np.sin(angle),
            vy - source * np.cos(angle),
            vz + 0.2 * source,
        )

    add(gaussian(directed), 250.0)
    places = []
    for number, (east, level) in enumerate(courses):
        tonal = (np.arange(FREQUENCY.size) % 4 == number)[:, None]
        distance = np.hypot(east, north)
        places.append((np.full(FRAMES, east), north))
        power = snr * level * (6000.0 / distance) ** 2 * np.where(tonal, 1.0, 0.05)
        add(np.sqrt(power) * gaussian(1.0), np.rad2deg(np.arctan2(east, north)))
    sign = -1.0 if reversed_hydrophone else 1.0
    intensity = -sign * ((p.conj() * vy).real + 1j * (p.conj() * vx).real)
    far = [(np.full(FRAMES, 1e9), np.zeros(FRAMES))] * (3 - len(places))
    ships = np.array(places + far)
    order = np.argsort(np.hypot(ships[:, 0], ships[:, 1]), axis=0)
    east, north = (np.take_along_axis(ships[:, k], order, axis=0).T for k in (0, 1))
    still = np.zeros(FRAMES)
    heard = Heard(time, east, north, order[0], np.ones(FRAMES, bool), still, still)
    noise = directed * -np.exp(1j * np.deg2rad(250.0 - turn_deg)) * -sign * np.ones(FREQUENCY.size)
    return Passages(
        heard, FREQUENCY, np.abs(p) ** 2, intensity, (sign * (p.conj() * vz).real, np.abs(vz) ** 2),
        np.ones(FREQUENCY.size), noise, np.arange(513) * 0.02, np.zeros((FRAMES, 513)), 1024,
    )  # fmt: skip


def found(given, offset=(0.0, 0.0), std_m=30.0):
    return rotation(
        given, offset, std_m, average_s=60.0, min_snr_db=6.0, min_range_m=2000.0, max_range_m=40e3
    )


def off(angle, truth):
    return abs((angle - truth + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize("turn", [0.0, 63.0, 179.5, -120.0])
def test_rotation_is_found_in_directional_noise_and_its_error_is_said(turn):
    result = found(passages(turn))
    assert off(result.angle_deg, turn) < min(1.0, 4 * result.std_deg)
    assert result.std_deg < 1.0
    assert sum(count for _, _, count in result.by_frequency) == result.cells


def test_a_plain_mean_would_be_pulled_by_the_background():
    # The guard of the test above: what the estimator has to resist is really there.
    given = passages(40.0, snr=6.0)
    azimuth = given.heard.relative_to(0.0, 0.0)[0][:, 0]
    mean = np.sum(given.intensity / np.abs(given.intensity) * np.exp(-1j * np.deg2rad(azimuth)))
    assert off(-np.rad2deg(np.angle(mean)), 40.0) > 3.0
    assert off(found(given).angle_deg, 40.0) < 2.0


def test_a_louder_second_ship_is_told_from_the_first():
    result = found(passages(25.0, courses=((5000.0, 1.0), (-9000.0, 2.0))))
    assert off(result.angle_deg, 25.0) < 2.0


def test_the_stations_true_place_matters():
    given = passages(0.0)
    shifted = replace(given, heard=replace(given.heard, north_m=given.heard.north_m + 700.0))
    assert off(found(shifted).angle_deg, 0.0) > 3.0
    assert off(found(shifted, (0.0, 700.0)).angle_deg, 0.0) < 1.0


def test_a_reversed_hydrophone_turns_the_azimuths_round_and_the_flux_up():
    right, wrong = (passages(10.0, reversed_hydrophone=r) for r in (False, True))
    assert off(found(wrong).angle_deg, 190.0) < 1.0
    assert downward_flux(right) > 5.0
    assert downward_flux(wrong) == pytest.approx(-downward_flux(right))


def test_noise_alone_has_no_orientation():
    given = passages(0.0, snr=0.0)
    result = found(given)
    assert result is None or result.std_deg > 2.0


def test_without_channels_nothing_is_claimed():
    given = passages(0.0)
    assert found(replace(given, intensity=None, background_intensity=None)) is None
    assert downward_flux(replace(given, vertical=None)) is None


def test_gaps_cost_only_themselves():
    given = passages(30.0)
    power, intensity = given.power.copy(), given.intensity.copy()
    power[:, 100:300], intensity[:, 100:300] = np.nan, np.nan
    flux, motion = given.vertical
    broken = replace(given, power=power, intensity=intensity)
    assert off(found(broken).angle_deg, 30.0) < 1.0
    assert downward_flux(replace(broken, vertical=(np.where(np.isnan(power), np.nan, flux), motion))) > 5.0


def test_an_uncertain_place_makes_an_uncertain_orientation():
    given = passages(30.0)
    sure, unsure = found(given, std_m=10.0), found(given, std_m=400.0)
    assert unsure.std_deg > 1.5 > sure.std_deg
    assert off(unsure.angle_deg, 30.0) < 1.0
