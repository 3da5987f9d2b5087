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
    "kraken_clear": "as kraken",
}
TITLES = {
    "kraken": "Boat within 500 m, 65 m of water,\ndetected at the listed rates",
    "marfret": "Cargo ship within 3 km, 73 m of water,\ndetected at the listed rates",
    "kraken_clear": "Boat within 500 m, 65 m of water,\neach pair detected every other scan",
}
COLOURS = ("#0068A8", "#D55E00", "#000000")
DASHES = ("-", (0, (5, 2)), (0, (1, 1)))
PAIRS = ("direct, bottom", "direct, bottom-surface", "bottom, bottom-surface")
PLACES = 100


def lines(result: Result) -> list[str]:
    """Numbers of each scenario and setting, then what they say to the paper."""
    text = [
        f"Probabilistic focalization, simulated delays: {result.runs} runs, seed {result.seed}, "
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
    when = "never settled" if row["settled_s"] is None else f"settled at {row['settled_s']:3.0f} s"
    return (
        f"({label}) Pd {chances}, {setting.false_alarms:g} false alarms:".ljust(44)
        + f"RMSE {row['range_rmse_m']:5.0f} m (filter's own {row['filter_std_m']:.0f} m), "
        f"{when}, last {WARM_UP_S:g} s {row['final_rmse_m']:4.0f} m, "
        f"{row['information_nats']:.2f} nats a scan"
    )


def _statements(result: Result) -> list[str]:
    text = []
    for name, settings in result.to_json().items():
        needed = [np.log(PLACES) / row["information_nats"] * SCAN_S for row in settings.values()]
        text.append(
            f"{name}: to tell {PLACES} places in 5 km apart takes about "
            f"{min(needed):.0f} to {max(needed):.0f} s of such scans."
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
        _delays(axes[0, column], name, result.seed)
        _ranges(axes[1, column], result, name)
        _errors(axes[2, column], result, name)
        axes[0, column].set_title(TITLES[name], fontsize=10)
        for row in range(3):
            axes[row, column].set_xlim(0, SCENARIOS[name].time_s[-1])
            axes[row, column].grid(alpha=0.25)
        axes[2, column].set_xlabel("time (s)")
    for row, label in enumerate(("delay (ms)", "range (m)", "RMSE of range (m)")):
        axes[row, 0].set_ylabel(label)
    for row, place in enumerate(("upper right", "upper right", "lower left")):
        axes[row, 0].legend(fontsize=8, loc=place)
    figure.suptitle(f"Probabilistic focalization, simulated delays: {result.runs} runs", size=12)
    figure.savefig(path, dpi=130)


def _delays(axes: Axes, name: str, seed: int) -> None:
    scenario = SCENARIOS[name]
    setting = next(iter(scenario.settings.values()))
    scans = scenario.measurements(setting, np.random.default_rng([seed, 1]))
    time = np.repeat(scenario.time_s, [len(scan) for scan in scans])
    axes.plot(time, 1e3 * np.concatenate(scans), ".", color="0.6", ms=3, label="measured, setting (i)")
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
    spread = next(iter(result.tracks[name].values())).spread()
    axes.plot(scenario.time_s, spread, color="0.6", lw=1.2, label="filter's own std, (i)")
    axes.set_yscale("log")
    axes.set_ylim(1, 3000)
