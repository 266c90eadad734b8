"""Samples turned into band-limited motion, block spectra, the shaft angle and channel responses."""

from .shaft_angle import measured_phase

__all__ = ["measured_phase"]
