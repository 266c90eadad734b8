"""Gates, the verdict of a diagnosis, and the ladder of improvements."""

from .diagnosis import NO_LAW_CODES, Diagnosis, diagnose, diagnose_point
from .improvement import Improvement, improve, rung

__all__ = ["NO_LAW_CODES", "Diagnosis", "Improvement", "diagnose", "diagnose_point", "improve", "rung"]
