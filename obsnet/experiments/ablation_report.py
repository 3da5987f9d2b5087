"""The ablation's files in, its table and figures out: thresholds from validation, scores of the test records alone."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import expit, logit

from obsnet.errors import OutputError
from obsnet.evaluation.detections import smad
from obsnet.experiments.ablation import ROWS, Maker, Outcome, Plan, add_variant, results, run
from obsnet.experiments.ablation_minutes import RANGE_LIMIT_M
from obsnet.experiments.ablation_records import KINDS
from obsnet.output import write_text
from obsnet.plots.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WRONG_PER_HOUR, FALSE_PER_HOUR = 1.0, 0.5
"""What a detector may get wrong over all validation records, and in any of them without a ship: its threshold is the lowest that keeps to both."""
REACH_BIN_M = 5000.0
RELIABILITY_ROWS = ("analytic", "analytic recalibrated", "learned both")
COLOURS = (BLUE, SKY, GREEN, YELLOW, ORANGE, VERMILLION, PURPLE)


def main(makers: Mapping[str, Maker], description: str | None = None) -> None:
    """Command line of ``train/ablate.py``: run what is missing in a folder, then write the table and the figure.

    Parameters
    ----------
    makers : generators of records by name.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--folder", required=True, help="records and results; a study goes on where it stopped"
    )
    parser.add_argument("--out", required=True, help="folder for ablation.csv, ablation.txt and ablation.png")
    parser.add_argument("--seeds", type=int, default=2, help="test records of each kind and generator")
    parser.add_argument("--validation-seeds", type=int, default=1)
    parser.add_argument("--hours", type=float, default=4.0)
    parser.add_argument("--report-only", action="store_true", help="write from what is there")
    parser.add_argument(
        "--variant",
        nargs=3,
        action="append",
        default=[],
        metavar=("NAME", "SENSOR", "MODEL"),
        help="another model's row",
    )
    # Whatever kinds are tested, thresholds are of all.
    for name, choices in (("kinds", KINDS), ("rows", ROWS), ("generators", makers)):
        parser.add_argument(f"--{name}", nargs="+", choices=list(choices), default=list(choices))
    given = parser.parse_args()
    for variant in given.variant:
        add_variant(*variant)
        given.rows.append(variant[0])
    chosen = {name: makers[name] for name in given.generators}
    numbers = given.seeds, given.validation_seeds, given.hours
    plan = Plan(chosen, tuple(given.kinds), *numbers, tuple(given.rows), validation_kinds=KINDS)
    if not given.report_only:
        run(plan, given.folder, lambda done, total: print(f"{done:.0f} of {total:.0f} records", flush=True))
    print(text(write(plan, given.folder, given.out)))


def thresholds(
    validation: list[Outcome], wrong_per_hour: float = WRONG_PER_HOUR, false_per_hour: float = FALSE_PER_HOUR
) -> dict[str, float]:
    """Lowest log presence ratio of each sensor with at most so many wrong or false minutes an hour, pooled over records, and in
    each record without a ship at most `false_per_hour`.
    """
    chosen = {}
    for sensor in ("azimuth", "range"):
        pooled = [minutes for _, _, minutes, _ in validation if f"{sensor}_llr" in minutes]
        if not pooled:
            continue
        empty = [minutes for minutes in pooled if minutes["range_true_m"].isna().all()]
        limits = [_threshold(minutes, sensor, false_per_hour) for minutes in empty]
        chosen[sensor] = max([_threshold(pd.concat(pooled), sensor, wrong_per_hour), *limits])
    return chosen


def _threshold(minutes: pd.DataFrame, sensor: str, wrong_per_hour: float) -> float:
    """Lowest log presence ratio of a sensor with at most so many wrong or false minutes an hour."""
    hours = float(minutes["covered"].sum()) / 60.0
    wrong = np.sort(minutes.loc[minutes[f"{sensor}_right"] == 0, f"{sensor}_llr"].dropna().to_numpy())[::-1]
    allowed = int(wrong_per_hour * hours)
    return float(wrong[allowed]) if allowed < len(wrong) else -np.inf


def table(plan: Plan, folder: str | Path) -> pd.DataFrame:
    """One line for each row, generator and kind (and ``all`` kinds), of the test records.

    Returns
    -------
    DataFrame with columns row, generator, kind, hours, and for azimuth and range each `_right` (share of the minutes with a ship; for range
    those with one within 50 km), `_wrong_per_hour` (wrong, or false), `_smad` (of the right ones), `_nll`, `_threshold`; reach_km (furthest bin
    of 5 km in which half of the azimuths are right), ships found, missed, false tracks, medians of the tracks' errors, cpu_seconds of a record.

    Raises
    ------
    OutputError : the folder holds no result of the plan.
    """
    tests, validation = results(plan, folder, False), results(plan, folder, True)
    lines = []
    for name, outcomes in tests.items():
        limits = thresholds(validation.get(name, []))
        for generator in plan.generators:
            for kind in (*plan.kinds, "all"):
                chosen = [o for o in outcomes if o[0] == generator and kind in (o[1], "all")]
                if chosen:
                    lines.append(
                        {"row": name, "generator": generator, "kind": kind, **_scores(chosen, limits)}
                    )
    if not lines:
        raise OutputError(f"{folder} holds no result of this ablation; run it first")
    return pd.DataFrame(lines)


def _scores(outcomes: list[Outcome], limits: dict[str, float]) -> dict[str, float]:
    minutes = pd.concat([o[2] for o in outcomes])
    minutes = minutes[minutes["covered"] == 1]
    hours = len(minutes) / 60.0
    line: dict[str, float] = {"hours": hours}
    for sensor, unit, there in (
        ("azimuth", "deg", minutes["range_true_m"].notna()),
        ("range", "m", minutes["range_true_m"] <= 50e3),
    ):
        said = minutes[f"{sensor}_llr"] > limits.get(sensor, np.inf)
        right = said & (minutes[f"{sensor}_right"] == 1)
        line[f"{sensor}_right"] = float(right[there].mean()) if there.any() else np.nan
        line[f"{sensor}_wrong_per_hour"] = float((said & ~right).sum() / hours)
        line[f"{sensor}_smad_{unit}"] = smad(minutes.loc[right, f"{sensor}_error"].to_numpy(float))
        line[f"{sensor}_nll"] = float(minutes[f"{sensor}_nll"].mean())
        line[f"{sensor}_threshold"] = limits.get(sensor, np.nan)
        if sensor == "azimuth":
            line["reach_km"] = _reach(minutes["range_true_m"].to_numpy(float), right.to_numpy())
    return line | _tracks([o[3] for o in outcomes])


def _reach(range_m: np.ndarray, right: np.ndarray) -> float:
    """End of the furthest bin of range up to which, in every bin with an hour of minutes or more, half are right [km]."""
    reach = np.nan
    for first in np.arange(0.0, 130e3, REACH_BIN_M):
        inside = (range_m >= first) & (range_m < first + REACH_BIN_M)
        if inside.sum() < 10:
            continue
        if right[inside].mean() < 0.5:
            break
        reach = (first + REACH_BIN_M) / 1e3
    return float(reach)


def _tracks(summaries: list[dict[str, Any]]) -> dict[str, float]:
    errors = pd.DataFrame([ship for s in summaries for ship in s["ships"]])
    line = {name: float(sum(s[name] for s in summaries)) for name in ("found", "missed", "false")}
    for name in ("cpa_time_error_s", "cpa_distance_error_m", "course_error_deg"):
        values = errors[name].astype(float).abs() if name in errors else pd.Series(dtype=float)
        line[f"median_{name}"] = float(values.median()) if values.notna().any() else np.nan
    seconds = [s["seconds"] for s in summaries if np.isfinite(s["seconds"])]
    return line | {"cpu_seconds": float(np.mean(seconds)) if seconds else np.nan}


def text(scores: pd.DataFrame) -> str:
    """The table as text, one block for each generator and kind."""
    columns = {
        "azimuth_right": "az right", "azimuth_wrong_per_hour": "wrong/h", "azimuth_smad_deg": "SMAD deg", "reach_km": "reach km",
        "azimuth_nll": "NLL cell", "range_right": "range right", "range_wrong_per_hour": "wrong/h ", "range_smad_m": "SMAD m",
        "range_nll": "NLL min", "found": "found", "missed": "missed", "false": "false", "median_cpa_time_error_s": "CPA s",
        "median_cpa_distance_error_m": "CPA m", "median_course_error_deg": "course deg", "cpu_seconds": "CPU s",
    }  # fmt: skip
    blocks = []
    for (generator, kind), block in scores.groupby(["generator", "kind"], sort=False):
        shown = block.set_index("row")[list(columns)].rename(columns=columns)
        blocks.append(
            f"{generator}: {kind} ({block['hours'].max():.0f} h, simulated)\n{shown.round(3).to_string(na_rep='-')}"
        )
    return "\n\n".join(blocks)


def write(plan: Plan, folder: str | Path, out: str | Path) -> pd.DataFrame:
    """Write ablation.csv, ablation.txt, ablation.png and reliability.png into `out`."""
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    scores = table(plan, folder)
    write_text(out / "ablation.csv", scores.to_csv(index=False, float_format="%.5g"))
    write_text(out / "ablation.txt", text(scores) + "\n")
    draw(scores, out / "ablation.png")
    draw_reliability(results(plan, folder, False), out / "reliability.png")
    return scores


def reliability(minutes: pd.DataFrame, sensor: str) -> pd.DataFrame:
    """How often a ship is there by how probable a detector says it is, in ten bins of probability.

    Parameters
    ----------
    minutes : of `obsnet.experiments.ablation_minutes.minute_table`, of one detector; a ship is there for range within 50 km. The
        prior odds of a ship are the minutes' own.

    Returns
    -------
    DataFrame with columns said (mean probability), seen (share of minutes with a ship), minutes; bins without minutes are left out.
    """
    minutes = minutes[minutes[f"{sensor}_llr"].notna()]
    nearest = minutes["range_true_m"]
    there = (nearest <= RANGE_LIMIT_M if sensor == "range" else nearest.notna()).to_numpy()
    share = np.clip(there.mean(), 0.01, 0.99)
    said = expit(minutes[f"{sensor}_llr"].to_numpy(float) + logit(share))
    table = pd.DataFrame({"said": said, "seen": there, "bin": np.minimum((10 * said).astype(int), 9)})
    return table.groupby("bin").agg(said=("said", "mean"), seen=("seen", "mean"), minutes=("seen", "size"))


def draw_reliability(outcomes: Mapping[str, list[Outcome]], path: Path) -> None:
    """What rows say of presence against what is so, for each generator and sensor, with the expected calibration error."""
    rows = [name for name in RELIABILITY_ROWS if name in outcomes]
    generators = list(dict.fromkeys(o[0] for name in rows for o in outcomes[name]))
    if not rows:
        return
    made = figure(5.0 * len(generators), 9.0)
    for number, (sensor, generator) in enumerate((s, g) for s in ("azimuth", "range") for g in generators):
        axes = made.add_subplot(2, len(generators), number + 1, aspect="equal")
        axes.plot([0, 1], [0, 1], color="black", lw=0.8, ls=":")
        for name, colour, mark in zip(rows, (BLUE, ORANGE, VERMILLION), "sD^o", strict=False):
            minutes = pd.concat([o[2] for o in outcomes[name] if o[0] == generator])
            bins = reliability(minutes[minutes["covered"] == 1], sensor)
            error = np.average((bins["said"] - bins["seen"]).abs(), weights=bins["minutes"])
            axes.plot(bins["said"], bins["seen"], color=colour, lw=0.8)
            size = 6.0 + 200.0 * bins["minutes"] / bins["minutes"].sum()
            axes.scatter(
                bins["said"],
                bins["seen"],
                s=size,
                c=colour,
                marker=mark,
                alpha=0.8,
                label=f"{name}: {error:.2f}",
            )
        axes.set_xlabel(f"probability of a ship, said by {sensor}")
        axes.set_ylabel("share of minutes with one")
        axes.set_title(f"{generator} (simulated), {sensor}; calibration error", fontsize=9, loc="left")
        axes.legend(fontsize=8, loc="best", markerscale=0.5)
    made.tight_layout()
    made.savefig(path)


def draw(scores: pd.DataFrame, path: str | Path) -> None:
    """Bars of the right and the wrong minutes of every row on every kind, one column of panels for each generator."""
    generators = list(dict.fromkeys(scores["generator"]))
    names = list(dict.fromkeys(scores["row"]))
    made = figure(7.5 * len(generators), 11.0)
    panels = (
        ("azimuth_right", "azimuth: share of minutes right", (0.0, 1.0)),
        ("azimuth_wrong_per_hour", "azimuth: wrong or false an hour", None),
        ("range_right", "range: share of minutes right", (0.0, 1.0)),
        ("range_wrong_per_hour", "range: wrong or false an hour", None),
    )
    for column, generator in enumerate(generators):
        block = scores[scores["generator"] == generator]
        for row, (value, title, limits) in enumerate(panels):
            axes = made.add_subplot(len(panels), len(generators), row * len(generators) + column + 1)
            _bars(axes, block, names, value)
            axes.set_title(f"{generator} (simulated), {title}", fontsize=9, loc="left")
            if limits is not None:
                axes.set_ylim(*limits)
            axes.tick_params(labelsize=7)
    made.tight_layout(rect=(0.0, 0.03, 1.0, 1.0))
    handles, labels = made.axes[0].get_legend_handles_labels()
    made.legend(handles, labels, fontsize=8, ncols=len(labels), loc="lower center", frameon=False)
    made.savefig(path)


def _bars(axes: Axes, block: pd.DataFrame, names: list[str], value: str) -> None:
    kinds = list(dict.fromkeys(block["kind"]))
    width = 0.8 / len(names)
    for number, name in enumerate(names):
        rows = block[block["row"] == name].set_index("kind").reindex(kinds)
        place = np.arange(len(kinds)) + (number - len(names) / 2 + 0.5) * width
        axes.bar(place, rows[value], width, color=COLOURS[number % len(COLOURS)], label=name)
    axes.set_xticks(np.arange(len(kinds)), [kind.replace("_", "\n") for kind in kinds], fontsize=6)
    axes.spines[["top", "right"]].set_visible(False)
