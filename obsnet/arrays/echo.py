"""The surface echo of a click: its delay and the angle of arrival in, the animal's range and depth out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from obsnet.errors import ConfigError, LayoutError


@dataclass(frozen=True)
class EchoRanges:
    """Position of each source from its surface echo; arrays (n,), NaN where no echo was found.

    Attributes
    ----------
    delay_s : echo after the direct click, s.
    range_m, range_std_m : horizontal distance, m.
    depth_m : depth of the source below the surface, m.
    echo_of : int array (n,), the click of which this one is the echo, −1 for none.
    """

    delay_s: np.ndarray
    range_m: np.ndarray
    range_std_m: np.ndarray
    depth_m: np.ndarray
    echo_of: np.ndarray


def echo_range(
    delay_s: np.ndarray, elevation_deg: np.ndarray, array_depth_m: float, sound_speed_mps: float = 1500.0
) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal range and depth of a source from the delay of its surface echo (straight rays, flat
    surface).

    The source is at slant distance R and elevation φ, so z = R sin φ above an array at depth h; its image in
    the surface is 2h − z above the array. The echo's path is longer by Δ = c × delay::

        (R + Δ)² = d² + (2h − z)² = R² + 4h² − 4 h R sin φ   ⇒   R = (4h² − Δ²) / (2Δ + 4h sin φ)
        d = R cos φ = (4h² − Δ²) cos φ / (2Δ + 4h sin φ)

    The paper's eq. 4 prints 2Δ − 4h sin φ, which holds only for elevations counted downwards; with its own
    convention (positive towards the surface) it puts a source overhead at a negative or a wrong range.

    Parameters
    ----------
    delay_s, elevation_deg : arrays that broadcast.
    array_depth_m : h, m.

    Returns
    -------
    range_m, depth_m : horizontal range and depth below the surface, m; NaN where no source below the surface
        has this delay at this elevation.

    Raises
    ------
    ConfigError
        The array's depth or the sound speed is not positive.

    >>> distance, depth = echo_range(1.0, 30.0, 2000.0)
    >>> round(float(distance)), round(float(depth))
    (1701, 1018)
    """
    if not (np.isfinite(array_depth_m) and array_depth_m > 0 and sound_speed_mps > 0):
        raise ConfigError(
            f"a surface echo needs an array below the surface and a positive sound speed, found depth "
            f"{array_depth_m!r} m and {sound_speed_mps!r} m/s"
        )
    longer = np.asarray(delay_s, float) * sound_speed_mps
    elevation = np.deg2rad(np.asarray(elevation_deg, float))
    divisor = 2.0 * longer + 4.0 * array_depth_m * np.sin(elevation)
    possible = (longer > 0) & (longer < 2.0 * array_depth_m) & (divisor > 0)
    slant = np.where(possible, 4.0 * array_depth_m**2 - longer**2, np.nan) / np.where(possible, divisor, 1.0)
    return slant * np.cos(elevation), array_depth_m - slant * np.sin(elevation)


def echo_elevation(range_m: np.ndarray, depth_m: np.ndarray, array_depth_m: float) -> np.ndarray:
    """Elevation [deg] from which the surface echo of a source arrives: that of its image."""
    return np.rad2deg(np.arctan2(array_depth_m + np.asarray(depth_m, float), np.asarray(range_m, float)))


def surface_echoes(
    time: np.ndarray,
    azimuth_deg: np.ndarray,
    elevation_deg: np.ndarray,
    covariance: np.ndarray,
    array_depth_m: float,
    sound_speed_mps: float = 1500.0,
    false_rejection: float = 0.01,
    max_range_m: float = 20_000.0,
) -> EchoRanges:
    """Pair each click with its surface echo among the later ones, and range it.

    The paper labelled echoes by hand. Here a later event is a click's echo when it comes within 2h/c from the
    same azimuth and from the elevation of the image that its own delay predicts: both within the angles'
    errors, by a χ² of two degrees of freedom. Of several candidates the best is taken, and an event is the
    echo of one click only. A click and the next one of the same animal differ from a click and its echo by
    the elevation, so the pair is left alone where the two elevations cannot be told apart.

    Parameters
    ----------
    time : array (n,), s, ascending.
    azimuth_deg, elevation_deg : arrays (n,), deg; events with NaN take no part.
    covariance : array (n, 2, 2), deg².
    max_range_m : beyond this no echo is believed, m.

    Raises
    ------
    LayoutError
        Times do not ascend. ConfigError: as `echo_range`.
    """
    time = np.asarray(time, float)
    if np.any(np.diff(time) < 0):
        raise LayoutError("clicks must be in the order of time; sort them first")
    blank = np.full(len(time), np.nan)
    result = EchoRanges(blank, blank.copy(), blank.copy(), blank.copy(), np.full(len(time), -1))
    gate = chi2.isf(false_rejection, 2)
    last = np.searchsorted(time, time + 2.0 * array_depth_m / sound_speed_mps)
    first, second = _candidates(last)
    if not len(first):
        return result
    delay = time[second] - time[first]
    distance, depth = echo_range(delay, elevation_deg[first], array_depth_m, sound_speed_mps)
    spread = _elevation_slope(delay, elevation_deg[first], array_depth_m, sound_speed_mps)
    predicted = echo_elevation(distance, depth, array_depth_m)
    rise = elevation_deg[second] - predicted
    rise_variance = covariance[second, 1, 1] + spread**2 * covariance[first, 1, 1]
    level = np.cos(np.deg2rad(elevation_deg[first]))
    turn = (azimuth_deg[second] - azimuth_deg[first] + 180.0) % 360.0 - 180.0
    turn_variance = covariance[first, 0, 0] + covariance[second, 0, 0]
    mismatch = rise**2 / rise_variance + turn**2 / turn_variance
    apart = (predicted - elevation_deg[first]) ** 2 > gate * (
        covariance[first, 1, 1] + covariance[second, 1, 1]
    )
    good = apart & (mismatch < gate) & (distance < max_range_m) & (level > 0)
    for k in np.flatnonzero(good)[np.argsort(mismatch[good])]:
        i, j = first[k], second[k]
        if result.echo_of[j] >= 0 or result.echo_of[i] >= 0 or np.isfinite(result.delay_s[[i, j]]).any():
            continue
        result.echo_of[j] = i
        result.delay_s[i], result.range_m[i], result.depth_m[i] = delay[k], distance[k], depth[k]
        slope = _range_slope(delay[k], elevation_deg[i], array_depth_m, sound_speed_mps)
        result.range_std_m[i] = abs(slope) * np.sqrt(covariance[i, 1, 1])
    return result


def _candidates(last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs (i, j) with i < j < last[i]."""
    counts = np.maximum(last - np.arange(len(last)) - 1, 0)
    first = np.repeat(np.arange(len(last)), counts)
    offset = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    return first, first + 1 + offset


def _range_slope(delay_s: np.ndarray, elevation_deg: np.ndarray, depth: float, speed: float) -> np.ndarray:
    """Derivative of the range by elevation, m/deg."""
    above, _ = echo_range(delay_s, np.asarray(elevation_deg) + 0.01, depth, speed)
    below, _ = echo_range(delay_s, np.asarray(elevation_deg) - 0.01, depth, speed)
    return (above - below) / 0.02


def _elevation_slope(
    delay_s: np.ndarray, elevation_deg: np.ndarray, depth: float, speed: float
) -> np.ndarray:
    """Derivative of the echo's predicted elevation by the click's elevation, at a given delay."""
    above, below = (
        echo_elevation(*echo_range(delay_s, np.asarray(elevation_deg) + step, depth, speed), depth)
        for step in (0.01, -0.01)
    )
    return (above - below) / 0.02
