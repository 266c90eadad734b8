"""Fit of a whole record."""

from .full_fit import FullFit, fit_all_effects
from .spectral import fit_spectral

__all__ = ["FullFit", "fit_spectral", "fit_all_effects"]
