"""Excitation spectra, sensor noise, recorder filter and faults of transfer functions."""
