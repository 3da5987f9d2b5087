"""The bearings-only experiment as text and as a figure, beside what the paper says."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsnet.experiments.bearings import SPEED_MPS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from obsnet.experiments.bearings import Result

CURVES = {
    1: ("correlation_s", "τ = {:g} s"),
    2: ("observation_s", "T = {:g} s"),
    3: ("speed_std_mps", "σ$_v$ = {:g} m/s"),
}
GREY, DASHED = "0.3", (0, (4, 2))
COLOURS = ("#000000", "#0068A8", "#D55E00", "#D9A400")
"""Four that differ in lightness too, for print in grey."""

TITLES = {
    1: "Figure 1: correlation of bearing errors (T = 200 s, speed known)",
    2: "Figure 2: observation time (τ = 150 s, speed known)",
    3: "Figure 3: speed errors (T = 200 s, τ = 150 s)",
}


def lines(result: Result) -> list[str]:
    """The figures' numbers, then the paper's statements with obsnet's beside them."""
    text = [
        f"Bearings-only motion analysis, simulated bearings: {result.runs} runs a point, seed {result.seed}.",
        "RMSE / Cramér-Rao bound of the whole matrix; * where curvature makes the range estimate inefficient "
        "(then the error expected with it in brackets).",
    ]
    for figure, (key, _) in CURVES.items():
        text += ["", TITLES[figure]]
        values = sorted({row[key] for row in result.select(figure)})
        for value in values:
            text.append(f"  {key} = {value:g}")
            text += ["    " + _line(row) for row in result.select(figure, **{key: value})]
    return [*text, "", *statements(result)]


def _line(row: dict[str, Any]) -> str:
    star = "" if row["efficient"] else f" * ({row['expected_range_m']:.0f})"
    ignoring, theory = row["rmse_range_ignoring_m"], row["theory_range_ignoring_m"]
    return (
        f"CPA {row['cpa_distance_m']:4.0f} m"
        f"   course {row['rmse_course_deg']:5.2f} / {row['crb_course_deg']:5.2f}°"
        f"   correlation ignored {ignoring:5.1f} / {theory:5.1f} m"
        f"   range {row['rmse_range_m']:5.1f} / {row['crb_range_m']:5.1f} m{star}"
    )


def statements(result: Result) -> list[str]:
    """What the paper says, and what these runs say to it."""
    pairs = _bounds_said(result) + _speeds_said(result) + _errors_said(result)
    return ["Paper", *[line for said, found in pairs for line in (f"  {said}", f"    obsnet: {found}")]]


def _bounds_said(result: Result) -> list[tuple[str, str]]:
    efficient = [row for row in result.rows if row["efficient"]]
    curved = [row for row in result.rows if not row["efficient"]]
    known = [row for row in result.rows if row["speed_std_mps"] == 0]
    correlated = [row for row in known if row["efficient"] and row["correlation_s"] > 0]
    return [
        (
            "RMSE of range and heading are close to the bound",
            f"range {_span(efficient, 'rmse_range_m', 'crb_range_m')} of the whole bound, "
            f"course {_span(efficient, 'rmse_course_deg', 'crb_course_deg')}, "
            f"at the {len(efficient)} efficient of {len(result.rows)} points; "
            f"range {_span(curved, 'rmse_range_m', 'crb_range_m')} at the others, "
            f"{_span(curved, 'rmse_range_m', 'expected_range_m')} of what curvature makes of it",
        ),
        (
            "ignoring correlation costs only a small amount",
            f"range RMSE {_span(correlated, 'rmse_range_ignoring_m', 'rmse_range_m')} of the matched one, "
            f"theory {_span(correlated, 'theory_range_ignoring_m', 'crb_range_m')} (efficient points)",
        ),
        (
            "position bound from the position block alone (eq. 28)",
            f"RMSE of the start {_span(known, 'rmse_start_position_m', 'block_start_position_m')} of it, "
            f"{_span(known, 'rmse_start_position_m', 'crb_start_position_m')} of the whole bound; "
            "the range at CPA of a centred passage happens not to suffer",
        ),
    ]


def _speeds_said(result: Result) -> list[tuple[str, str]]:
    rows = [row for row in result.select(3) if row["speed_std_mps"] > 0]
    one = [row for row in rows if row["speed_std_mps"] == 1]
    worst = [row for row in rows if row["speed_std_mps"] == 2]
    share = [(row["cpa_distance_m"] / SPEED_MPS / row["rmse_range_m"]) ** 2 for row in one]
    shares = f"{min(share):.0%} to {max(share):.0%}" if share else "no known part"
    return [
        (
            "above 1 m/s of speed error other factors are negligible",
            f"at 1 m/s the speed makes {shares} of the mean square error of range",
        ),
        (
            "speed errors do not affect heading",
            f"at 2 m/s course {_span(worst, 'rmse_course_deg', 'crb_course_deg')} of the bound without them",
        ),
        (
            "variance d² σ_k² + CRB for ships of scattered speed (eq. 20)",
            f"RMSE {_span(rows, 'rmse_range_ships_m', 'theory_range_ships_m')} of it; "
            "far slow ships hardly change azimuth and come out nearer than it says",
        ),
    ]


def _errors_said(result: Result) -> list[tuple[str, str]]:
    seen = result.recovered
    lowpass = [row for row in result.rows if row["rmse_range_lowpass_m"] is not None]
    return [
        (
            "errors from a sixth-order lowpass, met with the linear covariance",
            f"range RMSE {_span(lowpass, 'rmse_range_lowpass_m', 'expected_range_lowpass_m')} of theory, "
            f"{_span(lowpass, 'rmse_range_lowpass_m', 'rmse_range_m')} of that with linear errors",
        ),
        (
            "σ and τ can be measured on vessels with known positions",
            f"{seen['passages']} simulated passages: "
            f"σ {seen['std_deg']:.2f} ± {seen['std_uncertainty_deg']:.2f}° (true {seen['true_std_deg']:g}), "
            f"τ {seen['correlation_s']:.0f} ± {seen['correlation_uncertainty_s']:.0f} s "
            f"(true {seen['true_correlation_s']:g})",
        ),
        ("171 vessels at sea (figures 6, 7)", "not repeated: their bearings are not public"),
    ]


def _span(rows: list[dict[str, Any]], above: str, below: str) -> str:
    ratios = [row[above] / row[below] for row in rows]
    return f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else "at no point"


def draw(result: Result, path: str | Path) -> None:
    """Figures 1-3 and, beside the third, the position at the start against the whole and the block bound."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 12), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 2)
    for row, number in enumerate(CURVES):
        _panel(axes[row, 0], result, number, "range", "RMSE of range at CPA (m)")
        if number < 3:
            _panel(axes[row, 1], result, number, "course", "RMSE of course (deg)")
    _legend(axes[0, 0])
    _start_panel(axes[2, 1], result)
    figure.suptitle(f"Bearings-only motion analysis, simulated: {result.runs} runs, 7 m/s, σ = 2°", size=12)
    figure.savefig(path, dpi=130)


def _panel(axes: Axes, result: Result, number: int, quantity: str, label: str) -> None:
    key, name = CURVES[number]
    unit = "m" if quantity == "range" else "deg"
    ends = []
    for value, colour in zip(sorted({row[key] for row in result.select(number)}), COLOURS, strict=True):
        rows = result.select(number, **{key: value})
        distance = [row["cpa_distance_m"] for row in rows]
        matched, ignoring, bound, theory = (
            [row[column.format(quantity, unit)] for row in rows]
            for column in ("rmse_{}_{}", "rmse_{}_ignoring_{}", "crb_{}_{}", "theory_{}_ignoring_{}")
        )
        axes.plot(distance, matched, color=colour, lw=1.8)
        axes.plot(distance, ignoring, color=colour, lw=1.2, ls=DASHED)
        axes.plot(distance, bound, "x", color=colour, ms=7, mew=1.8)
        axes.plot(distance, theory, "o", mfc="none", color=colour, ms=7)
        ends.append((matched[-1], name.format(value), colour))
    _finish(axes, TITLES[number], label)
    _name_curves(axes, ends)


def _name_curves(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """Write each curve's name at its end, names at least a line's height apart."""
    low, high = np.log(axes.get_ylim())
    place = -1.0
    for value, name, colour in sorted(ends):
        place = max(float((np.log(value) - low) / (high - low)), place + 0.06)
        where = (2060, place)
        axes.annotate(name, where, xycoords=("data", "axes fraction"), va="center", color=colour, size=9)


def _legend(axes: Axes) -> None:
    handles = [
        axes.plot([], [], color=GREY, lw=1.8, label="RMSE, covariance used")[0],
        axes.plot([], [], "x", color=GREY, ms=7, mew=1.8, label="Cramér-Rao bound, whole matrix")[0],
        axes.plot([], [], color=GREY, lw=1.2, ls=DASHED, label="RMSE, correlation ignored")[0],
        axes.plot([], [], "o", mfc="none", color=GREY, ms=7, label="theory, correlation ignored")[0],
    ]
    axes.legend(handles=handles, fontsize=8, loc="upper left")


def _start_panel(axes: Axes, result: Result) -> None:
    for value, colour in zip((0.0, 150.0), (COLOURS[0], COLOURS[2]), strict=True):
        rows = result.select(1, correlation_s=value)
        distance = [row["cpa_distance_m"] for row in rows]
        error, whole, block = (
            [row[f"{kind}_start_position_m"] for row in rows] for kind in ("rmse", "crb", "block")
        )
        axes.plot(distance, error, color=colour, lw=1.8, label=f"RMSE, τ = {value:g} s")
        axes.plot(distance, whole, "x", color=colour, ms=7, mew=1.8)
        axes.plot(distance, block, "v", mfc="none", color=colour, ms=7)
    axes.plot([], [], "x", color=GREY, mew=1.8, label="bound, whole matrix")
    axes.plot([], [], "v", mfc="none", color=GREY, label="bound, position block (eq. 28)")
    axes.legend(fontsize=8, loc="lower right")
    _finish(axes, "Position at the start (T = 200 s, speed known)", "RMSE of position (m)")


def _finish(axes: Axes, title: str, label: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(450, 2380)
    axes.set_xticks(range(500, 2001, 500))
    axes.set_title(title, size=10, loc="left")
    axes.set_xlabel("CPA distance (m)")
    axes.set_ylabel(label)
    axes.grid(True, which="major", color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
