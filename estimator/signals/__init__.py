"""Samples turned into band-limited motion, block spectra, the shaft angle and channel responses."""
