"""Representations in, likelihood maps out: analytic and learned detectors behind one protocol."""
