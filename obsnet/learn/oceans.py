"""Oceans to train on: what the sound really does at a station, and the propagation table that its owner believes in.

The two differ as they do at a real station: depth, sound speed and bottom are known with errors, and real paths have
strengths and phases that no half-space predicts. A detector that trains on these pairs cannot lean on the twin's habits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation
from obsnet.ocean.sound_speed import Munk, SoundSpeed

TRAINING_DEPTHS_M = ((1500.0, 2700.0), (3100.0, 5500.0))
"""Depths of training stations; those in between are left for tests of depths never seen."""
TWIN_RANGE_M, RANGE_STEP_M = 130_000.0, 70.0


@dataclass(frozen=True)
class OceanSpread:
    """How wide oceans are drawn, and how wrong the believed table is (standard deviations).

    Parameters
    ----------
    gain_db, ripple_db : of each path's strength, constant and waving with range.
    phase_deg : of each path's phase per meeting with the bottom.
    roughness_s : of each path's delay per meeting with the bottom.
    depth_m, depth_share : of the believed depth, as a length and as a share.
    speed_mps : of the believed sound speed.
    default_share : share of the stations that believe in the default profile, whatever the truth.
    """

    gain_db: float = 2.5
    ripple_db: float = 1.5
    phase_deg: float = 25.0
    roughness_s: float = 0.002
    depth_m: float = 8.0
    depth_share: float = 0.002
    speed_mps: float = 2.5
    default_share: float = 0.15


@dataclass(frozen=True)
class Ocean:
    """A station's `depth_m`, the table by which sound `truly` travels, and the one that is `believed`."""

    depth_m: float
    truth: xr.Dataset
    believed: xr.Dataset


def draw_ocean(
    generator: np.random.Generator, depth_m: float | None = None, spread: OceanSpread = OceanSpread()
) -> Ocean:
    """Draw an ocean; the depth too where none is given, from `TRAINING_DEPTHS_M`."""
    if depth_m is None:
        low, high = TRAINING_DEPTHS_M[int(generator.random() < 0.6)]
        depth_m = float(generator.uniform(low, high))
    profile, bottom = draw_profile(generator), draw_bottom(generator)
    ranges = np.arange(0.0, TWIN_RANGE_M + 1.0, RANGE_STEP_M)
    truth = roughened(propagation(profile, depth_m, bottom, ranges), generator, spread)
    supposed = (
        SoundSpeed.munk()
        if generator.random() < spread.default_share
        else _shifted(profile, generator, spread)
    )
    known_bottom = bottom if generator.random() < 0.3 else Bottom()
    error = generator.normal(0.0, spread.depth_m) + depth_m * generator.normal(0.0, spread.depth_share)
    believed = propagation(supposed, depth_m + float(error), known_bottom, ranges)
    return Ocean(depth_m, truth, believed)


def draw_profile(generator: np.random.Generator) -> SoundSpeed:
    """Draw a sound-speed profile: Munk's form of any strength, or water of one speed."""
    if generator.random() < 0.2:
        return SoundSpeed.constant(float(generator.uniform(1480.0, 1530.0)))
    axis, scale = float(generator.uniform(1476.0, 1504.0)), float(generator.uniform(800.0, 1500.0))
    deep_gradient = float(generator.uniform(0.015, 0.018))
    munk = Munk(
        axis_speed_mps=axis,
        axis_depth_m=float(generator.uniform(500.0, 1400.0)),
        scale_m=scale,
        epsilon=deep_gradient * scale / (2.0 * axis),
        mixed_layer_m=float(generator.uniform(0.0, 80.0)),
    )
    return SoundSpeed.munk(munk, 7000.0)


def draw_bottom(generator: np.random.Generator) -> Bottom:
    """Draw a bottom from soft sediment to basalt."""
    p_speed = float(np.exp(generator.uniform(np.log(1550.0), np.log(4500.0))))
    hardness = (p_speed - 1550.0) / 2950.0
    return Bottom(
        p_speed_mps=p_speed,
        s_speed_mps=p_speed * float(generator.uniform(0.0, 0.3 + 0.2 * hardness)),
        density_kgm3=float(generator.uniform(1400.0, 2000.0) + 800.0 * hardness),
    )


def roughened(table: xr.Dataset, generator: np.random.Generator, spread: OceanSpread) -> xr.Dataset:
    """Propagation table with other strengths, phases and small delays of each path, as a real bottom gives them."""
    ranges = table["range"].values
    factor = np.ones(table["pressure"].shape, complex)
    later = np.zeros(len(factor))
    for k, number in enumerate(table["path"].values):
        bounces = (int(number) - 1) // 2
        waves = generator.uniform(2e3, 15e3, 4)[:, None]
        phases = generator.uniform(0.0, 2 * np.pi, 4)[:, None]
        ripple = np.sqrt(0.5) * np.cos(2 * np.pi * ranges / waves + phases).sum(axis=0)
        level = generator.normal(0.0, spread.gain_db) + spread.ripple_db * ripple
        turn = np.deg2rad(spread.phase_deg) * np.sqrt(bounces) * generator.normal()
        factor[k] = 10 ** (level / 20) * np.exp(1j * turn)
        later[k] = spread.roughness_s * np.sqrt(bounces) * generator.normal()
    return table.assign(
        pressure=table["pressure"] * factor, delay=table["delay"] + xr.DataArray(later, dims=("path",))
    )


def _shifted(profile: SoundSpeed, generator: np.random.Generator, spread: OceanSpread) -> SoundSpeed:
    """The same profile with an error that is constant and one that fades with depth."""
    constant, shallow = generator.normal(0.0, spread.speed_mps, 2)
    depth = np.unique(np.concatenate([profile.depth_m, np.linspace(0.0, 2000.0, 41)]))
    speed = profile.speed(depth) + constant + shallow * np.exp(-depth / 500.0)
    return SoundSpeed(f"{profile.name}, in error", depth, speed)
