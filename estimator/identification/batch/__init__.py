"""Fit of a whole record."""

from .full_fit import Whole, fit_whole
from .spectral import fit

__all__ = ["Whole", "fit", "fit_whole"]
