"""Trackers: likelihood maps, or the detections read off them, in; tracks and existence probabilities out."""
