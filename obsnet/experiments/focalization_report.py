"""The focalization experiment as text and as a figure, beside what the paper says."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsnet.experiments.focalization import SCAN_S, SCENARIOS, SETTLED_SHARE, WARM_UP_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from obsnet.experiments.focalization import Result

PAPER = {
    "kraken": "low error within a few seconds, kept (figure 3a, recorded delays)",
    "marfret": "low error within a few seconds, growing after 250 s (figure 3b, recorded delays)",
    "kraken_listed": "-",
    "marfret_listed": "-",
}
TITLES = {
    "kraken": "Boat within 500 m, 65 m of water,\ndelays detected in simulated sound",
    "marfret": "Cargo ship within 3 km, 73 m of water,\ndelays detected in simulated sound",
    "kraken_listed": "Boat within 500 m, 65 m of water,\ndelays drawn at the listed rates",
    "marfret_listed": "Cargo ship within 3 km, 73 m of water,\ndelays drawn at the listed rates",
}
COLOURS = ("#0068A8", "#D55E00", "#000000")
DASHES = ("-", (0, (5, 2)), (0, (1, 1)))
PAIRS = ("direct, bottom", "direct, bottom-surface", "bottom, bottom-surface")
PLACES = 100


def lines(result: Result) -> list[str]:
    """Numbers of each scenario and setting, then what they say to the paper."""
    text = [
        f"Probabilistic focalization, simulated passages: {result.runs} runs, seed {result.seed}, "
        f"{result.particles} particles.",
        f"RMSE of range over the runs, median over time after {WARM_UP_S:g} s; settled: within "
        f"{SETTLED_SHARE:.0%} of the prior's error for {WARM_UP_S:g} s.",
    ]
    for name, settings in result.to_json().items():
        text += ["", f"{name}   paper: {PAPER[name]}"]
        text += ["  " + _line(name, label, row) for label, row in settings.items()]
    return [*text, "", *_statements(result)]


def _line(name: str, label: str, row: dict[str, Any]) -> str:
    setting = SCENARIOS[name].settings[label]
    chances = "/".join(f"{value:g}" for value in setting.detection_probability)
    text = (
        f"({label}) Pd {chances}, {setting.false_alarms:g} false alarms:".ljust(44)
        + f"RMSE {row['range_rmse_m']:5.0f} m (filter's own {row['filter_std_m']:.0f} m), "
        f"{_when(row['settled_s'])}, worst {row['worst_rmse_m']:.0f} m, last {WARM_UP_S:g} s "
        f"{row['final_rmse_m']:.0f} m"
    )
    if "three_paths_rmse_m" in row:
        text += (
            "\n"
            + f"the paper's three paths: {row['three_paths_rmse_m']:5.0f} m, ".rjust(58)
            + f"{_when(row['three_paths_settled_s'])}, worst {row['three_paths_worst_rmse_m']:.0f} m"
        )
    if "told_rmse_m" in row:
        text += f"; told the labels {row['told_rmse_m']:.0f} m, {_when(row['told_settled_s'])}"
    return text


def _when(settled_s: float | None) -> str:
    return "never settled" if settled_s is None else f"settled at {settled_s:3.0f} s"


def _statements(result: Result) -> list[str]:
    text = []
    for name, settings in result.to_json().items():
        if SCENARIOS[name].sound is not None:
            shares, count = result.heard(name)
            heard = "/".join(f"{share:.2f}" for share in shares)
            text.append(
                f"{name}: the paper's three pairs are heard in {heard} of the scans, {count:.1f} delays a scan."
            )
        else:
            needed = [np.log(PLACES) / row["information_nats"] * SCAN_S for row in settings.values()]
            text.append(
                f"{name}: to tell {PLACES} places in 5 km apart takes any filter that is not told the labels "
                f"about {min(needed):.0f} to {max(needed):.0f} s of such scans."
            )
    return text


def draw(result: Result, path: str | Path) -> None:
    """One column a scenario: delays of one run, mean estimate of range, RMSE against time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(result.tracks), 10), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, len(result.tracks), squeeze=False)
    for column, name in enumerate(result.tracks):
        _delays(axes[0, column], result, name)
        _ranges(axes[1, column], result, name)
        _errors(axes[2, column], result, name)
        axes[0, column].set_title(TITLES[name], fontsize=10)
        for row in range(3):
            axes[row, column].set_xlim(0, SCENARIOS[name].time_s[-1])
            axes[row, column].grid(alpha=0.25)
        axes[2, column].set_xlabel("time (s)")
        axes[2, column].legend(fontsize=8)
    for row, label in enumerate(("delay (ms)", "range (m)", "RMSE of range (m)")):
        axes[row, 0].set_ylabel(label)
    for row in (0, 1):
        axes[row, 0].legend(fontsize=8, loc="upper right")
    figure.suptitle(f"Probabilistic focalization, simulated passages: {result.runs} runs", size=12)
    figure.savefig(path, dpi=130)


def _delays(axes: Axes, result: Result, name: str) -> None:
    scenario, scans = SCENARIOS[name], result.scans[name][0]
    found = [np.empty(0) if scan is None else scan for scan in scans]
    time = np.repeat(scenario.time_s, [len(scan) for scan in found])
    label = "measured, first run" + ("" if scenario.sound else ", setting (i)")
    axes.plot(time, 1e3 * np.concatenate(found), ".", color="0.6", ms=3, label=label)
    for curve, label, colour, dash in zip(scenario.delays().T, PAIRS, COLOURS, DASHES, strict=True):
        axes.plot(scenario.time_s, 1e3 * curve, color=colour, ls=dash, lw=1.6, label=label)
    axes.set_ylim(0, 100)


def _ranges(axes: Axes, result: Result, name: str) -> None:
    scenario = SCENARIOS[name]
    axes.plot(scenario.time_s, scenario.range_m, color="0.6", lw=4, label="true")
    for (label, tracks), colour, dash in zip(result.tracks[name].items(), COLOURS, DASHES, strict=True):
        mean = tracks.range_m.mean(axis=0)
        axes.plot(
            scenario.time_s, mean, color=colour, ls=dash, lw=1.6, label=f"setting ({label}), mean of runs"
        )
    axes.set_ylim(0, None)


def _errors(axes: Axes, result: Result, name: str) -> None:
    scenario = SCENARIOS[name]
    for (label, tracks), colour, dash in zip(result.tracks[name].items(), COLOURS, DASHES, strict=True):
        rmse = tracks.rmse(scenario.range_m)
        axes.plot(scenario.time_s, rmse, color=colour, ls=dash, lw=1.6, label=f"setting ({label})")
    first = next(iter(result.tracks[name].values()))
    axes.plot(scenario.time_s, first.spread(), color="0.6", lw=1.2, label="filter's own std, (i)")
    beside = np.sqrt(np.mean((first.beside_m - scenario.range_m) ** 2, axis=0))
    label = "the paper's three paths, (i)" if scenario.sound else "told the labels, (i)"
    axes.plot(scenario.time_s, beside, color="#009E73", lw=1.2, label=label)
    axes.set_yscale("log")
    axes.set_ylim(1, 3000)
