"""Compact hydrophone arrays: a different sensor that also ends in an azimuth map."""
