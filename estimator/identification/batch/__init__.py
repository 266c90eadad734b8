"""Fit of a record: by Gram matrices where that is enough, else the full fit."""

from .full_fit import FullFit, fit_all_effects
from .spectral import fit_spectral

__all__ = ["FullFit", "fit_spectral", "fit_all_effects"]
