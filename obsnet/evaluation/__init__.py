"""Detections and tracks of a run in, the core paper's Table I and what it lacks out."""

from obsnet.evaluation.detections import DetectionCriteria, minute_scores
from obsnet.evaluation.folder import evaluate_folder
from obsnet.evaluation.score import evaluate
from obsnet.evaluation.table import Evaluation, ShipScore
from obsnet.evaluation.tracks import MatchGates, match_tracks

__all__ = [
    "DetectionCriteria",
    "Evaluation",
    "MatchGates",
    "ShipScore",
    "evaluate",
    "evaluate_folder",
    "match_tracks",
    "minute_scores",
]
