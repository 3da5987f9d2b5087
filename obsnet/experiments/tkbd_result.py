"""What the track-before-detect experiment found: outcomes of runs in; numbers, a table and a figure out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsnet.experiments.approach import Truth
from obsnet.trackers.track_before_detect import BearingTrack

CONFIRMED = 0.9
CUTOFF_DEG = 30.0
ON_TARGET_DEG = 10.0
TRACK_S = 1.0

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (3, 2)))
PAPER_SNR_DB = {"TVAR14": -9.0, "TVAR0": -5.0, "GVAR14": -8.0, "CFAR": -5.0, "CFARVAR14": -5.0}

PAPER_GAIN_DB = 4.0


@dataclass(frozen=True)
class Outcome:
    """One tracker in one run.

    A track is a target confirmed (q > 0.9) for a second on end. On target is less than 10° off; a track
    elsewhere, or where there is no target, is false. `confirmation_db` is the true SNR when the first track
    on the target is a second old, infinite if there is none; `held` the share of the time from then on in
    which it is confirmed on the target.
    """

    existence: np.ndarray
    ospa_deg: np.ndarray
    snr_db: np.ndarray
    confirmation_db: float
    held: float
    false: bool
    azimuth_rmse_deg: float


def track_batches(interval_s: float) -> int:
    """Batches on end for which a target must be confirmed to be a track."""
    return int(np.ceil(TRACK_S / interval_s))


def sustained(condition: np.ndarray, length: int) -> np.ndarray:
    """Where `condition` has held for `length` entries on end, this one included.

    >>> sustained(np.array([1, 1, 0, 1, 1, 1], bool), 3).tolist()
    [False, False, False, False, False, True]
    """
    total = np.concatenate([[0], np.cumsum(condition)])
    held = np.zeros(len(condition), bool)
    held[length - 1 :] = total[length:] - total[:-length] == length
    return held


def single_target_ospa(truth_deg: np.ndarray, azimuth_deg: np.ndarray, confirmed: np.ndarray) -> np.ndarray:
    """OSPA of order 1 against time where there is one target at most and one estimate at most (eqs 37–39).

    Parameters
    ----------
    truth_deg : array, dims (batch,); NaN where there is no target.
    azimuth_deg : array, dims (batch,)
    confirmed : bool array, dims (batch,)
    """
    error = np.minimum(np.abs(azimuth_deg - truth_deg), CUTOFF_DEG)
    return np.where(np.isnan(truth_deg), CUTOFF_DEG * confirmed, np.where(confirmed, error, CUTOFF_DEG))


def outcome(truth: Truth, track: BearingTrack, knows_snr: bool = True) -> Outcome:
    """Judge a tracker's output against the truth."""
    length = track_batches(float(truth.time_s[1] - truth.time_s[0]))
    confirmed = track.existence > CONFIRMED
    error = np.abs(track.azimuth_deg - truth.azimuth_deg)
    on_target = confirmed & (error < ON_TARGET_DEG)
    tracked = sustained(on_target, length)
    first = int(np.argmax(tracked)) if tracked.any() else None
    return Outcome(
        existence=track.existence.astype(np.float16),
        ospa_deg=single_target_ospa(truth.azimuth_deg, track.azimuth_deg, confirmed).astype(np.float16),
        snr_db=np.where(on_target & knows_snr, track.snr_db, np.nan).astype(np.float16),
        confirmation_db=np.inf if first is None else float(truth.snr_db[first]),
        held=0.0 if first is None else float(on_target[first:].mean()),
        false=bool(sustained(confirmed & ~on_target, length).any()),
        azimuth_rmse_deg=float(np.sqrt(np.mean(error[on_target] ** 2))) if on_target.any() else np.nan,
    )


@dataclass(frozen=True)
class Result:
    """All runs.

    Attributes
    ----------
    outcomes : tuple, one per run, of dicts by tracker
    power : array, dims (batch, azimuth)
        Raw beam power of the first run, for the figure.
    whitened_snr_db : array, dims (batch,)
        True SNR after whitening: what trackers of whitened samples estimate.
    akaike_order : int
        Order of the noise model that Akaike's criterion chooses on target-free samples.
    elapsed_s : float
    """

    runs: int
    seed: int
    truth: Truth
    outcomes: tuple[dict[str, Outcome], ...]
    power: np.ndarray
    azimuth_deg: np.ndarray
    whitened_snr_db: np.ndarray
    akaike_order: int
    elapsed_s: float

    @property
    def trackers(self) -> list[str]:
        """Names, in the order of the contenders."""
        return list(self.outcomes[0])

    def values(self, tracker: str, name: str) -> np.ndarray:
        """Attribute `name` of a tracker's outcomes, dims (run, …)."""
        return np.array([getattr(run[tracker], name) for run in self.outcomes])

    def confirmation_db(self, tracker: str) -> float | None:
        """Median true SNR at confirmation; None where half of the runs never confirm."""
        median = float(np.median(self.values(tracker, "confirmation_db")))
        return median if np.isfinite(median) else None

    @property
    def gain_db(self) -> float | None:
        """SNR by which TVAR14 confirms below CFAR."""
        if not {"TVAR14", "CFAR"} <= set(self.trackers):
            return None
        ours, theirs = self.confirmation_db("TVAR14"), self.confirmation_db("CFAR")
        return None if ours is None or theirs is None else theirs - ours

    def false_tracks(self, tracker: str) -> float:
        """Share of runs with a false track, before the target or beside it."""
        return float(self.values(tracker, "false").mean())

    def confirmed_runs(self, tracker: str) -> float:
        """Share of runs in which the target is tracked at all."""
        return float(np.isfinite(self.values(tracker, "confirmation_db")).mean())

    def held(self, tracker: str) -> float:
        """Median share of the time after confirmation in which the target is confirmed."""
        return float(np.median(self.values(tracker, "held")))

    def mean_ospa_deg(self, tracker: str) -> float:
        """OSPA, mean over runs and over the time with a target [deg]."""
        return float(self.values(tracker, "ospa_deg")[:, self.truth.present].mean(dtype=float))

    def azimuth_rmse_deg(self, tracker: str) -> float | None:
        """Root mean square azimuth error while on target, median over runs [deg]."""
        return _median(self.values(tracker, "azimuth_rmse_deg"))

    def snr_bias_db(self, tracker: str) -> float | None:
        """Estimated minus true SNR, both after whitening, while on target; median [dB].

        None for trackers of detections, which do not know it; of little meaning for TVAR0, whose whitening is
        another.
        """
        return _median(self.values(tracker, "snr_db") - self.whitened_snr_db)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers: the paper's trackers by statistic, others under `beyond_the_paper`."""
        papers = [name for name in self.trackers if name in PAPER_SNR_DB]
        others = [name for name in self.trackers if name not in PAPER_SNR_DB]
        return {
            "experiment": "tkbd",
            "simulated": True,
            "runs": self.runs,
            "seed": self.seed,
            **self._statistics(papers),
            "gain_db": self.gain_db,
            "paper_snr_at_confirmation_db": PAPER_SNR_DB,
            "paper_gain_db": PAPER_GAIN_DB,
            "beyond_the_paper": self._statistics(others),
            "lowest_snr_db": float(np.nanmin(self.truth.snr_db)),
            "akaike_order": self.akaike_order,
            "elapsed_s": self.elapsed_s,
        }

    def _statistics(self, names: list[str]) -> dict[str, dict[str, float | None]]:
        statistics: dict[str, Callable[[str], float | None]] = {
            "snr_at_confirmation_db": self.confirmation_db,
            "false_tracks": self.false_tracks,
            "confirmed_runs": self.confirmed_runs,
            "held": self.held,
            "mean_ospa_deg": self.mean_ospa_deg,
            "azimuth_rmse_deg": self.azimuth_rmse_deg,
            "snr_bias_db": self.snr_bias_db,
        }
        return {key: {name: statistic(name) for name in names} for key, statistic in statistics.items()}

    def table(self) -> str:
        """The numbers of obsnet beside the paper's, as plain text."""
        head = ("tracker", "SNR at confirmation", "paper", "held", "false tracks", "OSPA", "azimuth RMSE")
        rows = [head]
        for name in self.trackers:
            rows.append(
                (
                    name,
                    _number(self.confirmation_db(name), "dB"),
                    _number(PAPER_SNR_DB[name], "dB") if name in PAPER_SNR_DB else "",
                    f"{self.held(name):.0%}",
                    f"{self.false_tracks(name):.0%} of runs",
                    _number(self.mean_ospa_deg(name), "deg"),
                    _number(self.azimuth_rmse_deg(name), "deg"),
                )
            )
        widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        lowest = float(np.nanmin(self.truth.snr_db))
        return "\n".join(
            [
                f"Track-before-detect, simulated approach, {self.runs} runs, seed {self.seed}",
                *lines,
                f"TVAR14 confirms {_number(self.gain_db, 'dB')} below CFAR (paper: {PAPER_GAIN_DB:g} dB). "
                f"The approach begins at {lowest:.1f} dB: no tracker can confirm below that.",
                f"Akaike's criterion chooses a noise model of order {self.akaike_order} (truth: 14).",
            ]
        )

    def plot(self, path: str | Path) -> None:
        """Draw the paper's figure 5: beam power, OSPA, SNR and existence against time."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 11), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, sharex=True)
        self._plot_power(axes[0])
        time_s, truth = self.truth.time_s, self.truth
        for number, name in enumerate(self.trackers):
            style = {
                "color": COLOURS[number % len(COLOURS)],
                "linestyle": LINES[number % len(LINES)],
                "lw": 1.4,
            }
            axes[1].plot(time_s, self.values(name, "ospa_deg").mean(axis=0, dtype=float), **style)
            axes[2].plot(time_s, _column_median(self.values(name, "snr_db")), **style)
            existence = self.values(name, "existence").astype(float)
            axes[3].plot(time_s, existence.mean(axis=0), label=name, **style)
            low, high = np.quantile(existence, [0.1, 0.9], axis=0)
            axes[3].fill_between(time_s, low, high, color=style["color"], alpha=0.12, lw=0)
        axes[1].set(ylabel="OSPA [deg]", ylim=(0, CUTOFF_DEG + 1))
        axes[2].plot(time_s, truth.snr_db, color="black", lw=1.0, label="true, at a hydrophone")
        axes[2].plot(
            time_s, self.whitened_snr_db, color="0.5", lw=2.5, label="true, after whitening", zorder=0
        )
        axes[2].set(ylabel="SNR [dB]")
        axes[2].legend(loc="upper left", frameon=False)
        axes[3].axhline(CONFIRMED, color="black", lw=0.8, ls=":")
        axes[3].set(ylabel="existence", ylim=(-0.02, 1.02), xlabel="time [s]", xlim=(time_s[0], time_s[-1]))
        for axis in axes[1:]:
            axis.axvline(time_s[np.argmax(truth.present)], color="0.6", lw=0.8)
        figure.legend(
            *axes[3].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        figure.savefig(path, dpi=150)

    def _plot_power(self, axis: Any) -> None:
        level = 10.0 * np.log10(self.power.T / np.median(self.power))
        span = {"vmin": -6.0, "vmax": 10.0}
        image = axis.pcolormesh(
            self.truth.time_s, self.azimuth_deg, level, cmap="cividis", rasterized=True, **span
        )
        axis.plot(
            self.truth.time_s, self.truth.azimuth_deg, color="white", ls="--", lw=1.2, label="true azimuth"
        )
        axis.set(
            ylabel="azimuth [deg]", title=f"Simulated approach, {self.runs} runs; beam power of the first"
        )
        axis.legend(loc="lower right", frameon=False, labelcolor="white")
        axis.figure.colorbar(image, ax=axis, label="beam power [dB]")


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known.astype(float))) if len(known) else None


def _column_median(values: np.ndarray) -> np.ndarray:
    """Median over the runs that know it, NaN where fewer than half do."""
    known = np.isfinite(values)
    enough = known.sum(axis=0) * 2 >= len(values)
    median = np.full(values.shape[1], np.nan)
    median[enough] = np.nanmedian(values[:, enough].astype(float), axis=0)
    return median


def _number(value: float | None, unit: str) -> str:
    return "never" if value is None else f"{value:.1f} {unit}"
