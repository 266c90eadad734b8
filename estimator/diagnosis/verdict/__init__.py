"""The layers of a diagnosis, gates, the verdict, and the ladder of improvements."""

from .bearing import NO_LAW_CODES, BearingJudgement, judge_bearing
from .diagnose import Diagnosis, diagnose
from .improvement import Improvement, improve
from .ladder import rung

__all__ = [
    "NO_LAW_CODES",
    "BearingJudgement",
    "Diagnosis",
    "Improvement",
    "diagnose",
    "improve",
    "judge_bearing",
    "rung",
]
