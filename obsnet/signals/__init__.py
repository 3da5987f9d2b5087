"""Waveforms in, representations out: spectra in physical units, azigram, cepstrogram."""
