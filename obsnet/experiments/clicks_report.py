"""Table and figure of the click experiment: its outcome in, obsnet's numbers beside the paper's out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsnet.arrays.arrival import directions
from obsnet.arrays.clicks import ClickRecord
from obsnet.arrays.compact import CompactArray
from obsnet.experiments import montecarlo
from obsnet.experiments.click_scenes import QUANTISATION_S, AnimalPath
from obsnet.experiments.click_scores import audible, own_tdoas
from obsnet.experiments.clicks_result import CUTOFF_DEG
from obsnet.kinematics import wrap180
from obsnet.trackers.association import Association

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from obsnet.experiments.clicks_result import Result

TRUTH, TRACK, POINT, CLUTTER = "#000000", "#0068A8", "#D55E00", "0.75"


def lines(result: Result) -> list[str]:
    """Lines of text: obsnet's numbers beside the paper's."""
    values = result.to_json()
    pair, tracks, wav = values, values["two_animals"], values["recordings"]
    rows = [
        ("one animal in clutter (simulated)", "obsnet", "paper"),
        ("  smoother, azimuth RMSE", _deg(pair["azimuth_rmse_deg"]), "1.4° *"),
        ("  smoother, elevation RMSE", _deg(pair["elevation_rmse_deg"]), "1.5° *"),
        ("  regression without clutter, azimuth RMSE", _deg(pair["regression_azimuth_rmse_deg"]), "1.6° *"),
        (
            "  regression without clutter, elevation RMSE",
            _deg(pair["regression_elevation_rmse_deg"]),
            "1.8° *",
        ),
        (
            "  regression in clutter, azimuth RMSE",
            _deg(pair["regression_in_clutter_azimuth_rmse_deg"]),
            "spurious",
        ),
        ("  clutter rejected", f"{pair['clutter_rejected']:.2%}", "all"),
        ("  the animal's TDOAs lost", f"{pair['clicks_lost']:.2%}", "none"),
        ("  smoother's errors over those it states", f"{pair['error_over_stated']:.2f} †", "-"),
        ("two animals in clutter (simulated)", "", ""),
        (f"  OSPA, cut off at {tracks['ospa_cutoff_deg']:g}°", _deg(tracks["ospa_deg"]), "future work"),
        ("  time with the right number of tracks", f"{tracks['right_number']:.1%}", "future work"),
        ("two animals, whole recordings (simulated)", "", ""),
        ("  clicks found", f"{wav['clicks_found']:.1%}", "-"),
        ("  false clicks a minute", f"{wav['false_clicks']:.2f}", "-"),
        ("  point by point, azimuth / elevation RMSE", _both(wav, "click_"), "-"),
        ("  smoother, azimuth / elevation RMSE", _both(wav, ""), "-"),
        ("  smoother's errors over those it states", f"{wav['error_over_stated']:.2f}", "-"),
        ("  tracks an animal", f"{wav['tracks_per_animal']:.2f}", "-"),
        ("  ranges from echoes, within 10 %", f"{wav['echo_ranges_within_10_percent']:.1%}", "20 by hand"),
        ("  their RMSE", f"{wav['range_rmse_percent']:.2f} %", "-"),
    ]
    wide = [max(len(row[column]) for row in rows) for column in range(3)]
    body = ["  ".join([row[0].ljust(wide[0]), row[1].rjust(wide[1]), row[2].rjust(wide[2])]) for row in rows]
    return [
        f"Clicks on a compact array, simulated: {result.runs} runs, {wav['runs']} recordings",
        *body,
        "* the paper gives the largest half axis of its confidence regions on real data, not an error",
        "† rounding to samples makes stairs, errors that last; interpolated correlations have none",
    ]


def draw(result: Result, path: str | Path) -> None:
    """Write a figure like the paper's figures 4, 5, 7 and 8, from the first run of each scenario."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from obsnet.experiments.clicks import simulated_record

    figure = Figure(figsize=(11, 12), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 2)
    seed = montecarlo.seeds(1, result.seed)[0]
    _clutter_panels(axes[0, 0], axes[1, 0], axes[2, 0], np.random.default_rng(seed))
    _two_animal_panels(axes[0, 1], axes[1, 1], axes[2, 1], np.random.default_rng(seed), result)
    array = CompactArray.tetrahedron()
    paths, record, _, _ = simulated_record(np.random.default_rng(seed), array)
    _range_panel(axes[3, 0], record, paths)
    _map_panel(axes[3, 1], record, paths)
    for axis in axes.flat:
        axis.grid(True, color="0.92")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlabel("time (s)")
    figure.suptitle("Clicks on a 1 m tetrahedron, simulated", size=12)
    figure.savefig(path, dpi=130)


def _clutter_panels(tdoa: Axes, azimuth: Axes, elevation: Axes, rng: np.random.Generator) -> None:
    """TDOAs with clutter, azimuth and elevation of one animal."""
    from obsnet.experiments.clicks import clutter_scene, tracked

    scene, array, pairs = clutter_scene(rng)
    found, _ = tracked(scene, array, pairs, clicking=0.95, seed=rng)
    count = [len(value) for value in scene.value]
    time, value, owner = (
        np.repeat(scene.time, count),
        np.concatenate(scene.value),
        np.concatenate(found.owner),
    )
    tdoa.plot(time[owner < 0], 1e3 * value[owner < 0], ".", ms=2, color=CLUTTER, label="called clutter")
    tdoa.plot(time[owner >= 0], 1e3 * value[owner >= 0], ".", ms=2.5, color=TRACK, label="the animal's")
    tdoa.set_ylabel("TDOA (ms)")
    tdoa.set_title("One animal: TDOAs of three pairs, with clutter", size=10, loc="left")
    tdoa.legend(loc="upper right", fontsize=8, framealpha=0.9, markerscale=4)
    fit = directions(own_tdoas(scene, 3), array, pairs, np.eye(3) * QUANTISATION_S**2)
    truth = scene.paths[0].direction(scene.time, array.mean_depth_m)
    _angle_panel(azimuth, scene.time, np.unwrap(truth[0], period=360.0), fit.azimuth_deg, found, 0)
    _angle_panel(elevation, scene.time, truth[1], fit.elevation_deg, found, 1)
    azimuth.set_ylabel("azimuth (deg)")
    elevation.set_ylabel("elevation (deg)")
    azimuth.set_title("Its azimuth: regression without clutter, smoother with it", size=10, loc="left")
    elevation.set_title("Its elevation", size=10, loc="left")
    azimuth.legend(fontsize=8, framealpha=0.9)


def _angle_panel(
    axis: Axes, time: np.ndarray, truth: np.ndarray, points: np.ndarray, found: Association, angle: int
) -> None:
    """One angle (0: azimuth, 1: elevation) by regression and smoother, drawn around the truth without a seam."""
    near = truth + wrap180(points - truth)
    axis.plot(time, near, "o", ms=2.5, mfc="none", color=POINT, label="regression")
    for track in found.tracks:
        centre = truth[np.searchsorted(time, track.time)]
        said = (track.azimuth_deg, track.elevation_deg)[angle]
        axis.plot(track.time, centre + wrap180(said - centre), color=TRACK, lw=2.2, label="smoother")
    axis.plot(time, truth, "--", color=TRUTH, lw=0.9, label="truth")


def _two_animal_panels(
    azimuth: Axes, elevation: Axes, error: Axes, rng: np.random.Generator, result: Result
) -> None:
    """Azimuth and elevation of two animals, and OSPA over all runs."""
    from obsnet.experiments.clicks import tracked, two_animal_scene

    scene, array, pairs = two_animal_scene(rng)
    found, _ = tracked(scene, array, pairs, clicking=0.9, seed=rng)
    alive = audible(scene)
    for axis, number, name in ((azimuth, 0, "azimuth (deg)"), (elevation, 1, "elevation (deg)")):
        for track, colour in zip(found.tracks, (TRACK, POINT, "#D9A400", "#666666") * 9, strict=False):
            said = (track.azimuth_deg, track.elevation_deg)[number]
            axis.plot(track.time, _broken(said), color=colour, lw=2.4)
        for path, heard in zip(scene.paths, alive, strict=True):
            angle = path.direction(scene.time, array.mean_depth_m)[number]
            axis.plot(scene.time, np.where(heard, _broken(angle), np.nan), "--", color=TRUTH, lw=0.9)
        axis.set_ylabel(name)
    azimuth.set_title("Two animals in the same clutter: tracks, truth dashed", size=10, loc="left")
    elevation.set_title("Their elevations", size=10, loc="left")
    values = np.array([outcome["ospa"] for outcome in result.two_animals])
    error.plot(scene.time, values.mean(axis=0), color=TRACK, lw=1.4)
    error.set_ylabel("OSPA (deg)")
    error.set_ylim(bottom=0.0)
    error.set_title(f"OSPA, mean of {len(values)} runs, cut off at {CUTOFF_DEG:g}°", size=10, loc="left")


def _range_panel(axis: Axes, record: ClickRecord, paths: list[AnimalPath]) -> None:
    """Ranges from surface echoes of a recording, with the true ones."""
    ranged = np.isfinite(record.echoes.range_m)
    axis.errorbar(
        record.time[ranged],
        record.echoes.range_m[ranged],
        2.0 * record.echoes.range_std_m[ranged],
        fmt="o",
        ms=3,
        lw=0.8,
        color=TRACK,
        label="from the echo, ± 2 σ",
    )
    for number, path in enumerate(paths):
        distance = np.linalg.norm(path.at(record.time)[:, :2], axis=1)
        axis.plot(record.time, distance, "--", color=TRUTH, lw=0.9, label="truth" if number == 0 else None)
    axis.set_ylabel("horizontal range (m)")
    axis.set_title("Ranges from surface echoes found in a recording", size=10, loc="left")
    axis.legend(fontsize=8)


def _map_panel(axis: Axes, record: ClickRecord, paths: list[AnimalPath]) -> None:
    """Azimuth map of a recording."""
    times = np.arange(5.0, record.end, 2.0)
    maps = record.azimuth_map(times)
    llr = np.maximum(maps["azimuth_llr"].values.T, 0.0)
    image = axis.pcolormesh(times, maps["azimuth"].values, llr, cmap="Greys", shading="nearest")
    truth = [path.direction(times, record.array.mean_depth_m)[0] for path in paths]
    for azimuth in truth:
        axis.plot(times, _broken(azimuth), "--", color=POINT, lw=0.9)
    axis.set_ylim(max(np.min(truth) - 20.0, 0.0), min(np.max(truth) + 20.0, 360.0))
    axis.figure.colorbar(image, ax=axis, label="log-likelihood ratio")
    axis.set_ylabel("azimuth (deg)")
    axis.set_title("Azimuth map of the same recording, truth dashed", size=10, loc="left")


def _broken(angle: np.ndarray) -> np.ndarray:
    """Angles with a gap where they cross the seam at 360°."""
    return np.where(np.abs(np.diff(angle, prepend=angle[:1])) > 180.0, np.nan, angle)


def _deg(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}°"


def _both(values: dict[str, Any], prefix: str) -> str:
    return f"{_deg(values[prefix + 'azimuth_rmse_deg'])} / {_deg(values[prefix + 'elevation_rmse_deg'])}"
