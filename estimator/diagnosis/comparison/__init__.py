"""Held-out error, missing force by state, restoring-force curves and the simulated twin."""

from .comparison import Comparison, compare
from .heldout import heldout_nll

__all__ = ["Comparison", "compare", "heldout_nll"]
