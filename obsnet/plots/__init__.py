"""Pictures of a run: the report, and the core paper's figures 3, 5, 6, 7 and 8."""

from obsnet.plots.figures import FIGURES, draw
from obsnet.plots.report import report

__all__ = ["FIGURES", "draw", "report"]
