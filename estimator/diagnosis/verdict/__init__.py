"""Gates, the verdict of a diagnosis, and the ladder of improvements."""

from .diagnosis import Diagnosis, diagnose, diagnose_point, no_law
from .improvement import Improvement, improve, rung

__all__ = ["Diagnosis", "Improvement", "diagnose", "diagnose_point", "improve", "no_law", "rung"]
