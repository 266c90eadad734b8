"""Held-out error, missing force by state, restoring-force curves and the simulated twin."""

from .comparison import Comparison, compare
from .heldout import heldout_nll
from .survey import BearingSurvey, survey_bearing

__all__ = ["BearingSurvey", "Comparison", "compare", "heldout_nll", "survey_bearing"]
