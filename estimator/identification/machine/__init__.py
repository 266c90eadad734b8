"""Tones, orders and strikes in the measured signal."""

from .machine_survey import MachineSurvey, ShaftSpeed, StrikeTrain, Tone
from .speed import RATE_CONTRADICTED, RATE_UNCONFIRMED, RECORD_SOURCE, SPEED_CONTRADICTED
from .survey import survey_machine
from .tones import is_mains_multiple, joined_bands

__all__ = [
    "RATE_CONTRADICTED",
    "RATE_UNCONFIRMED",
    "RECORD_SOURCE",
    "SPEED_CONTRADICTED",
    "MachineSurvey",
    "ShaftSpeed",
    "StrikeTrain",
    "Tone",
    "is_mains_multiple",
    "joined_bands",
    "survey_machine",
]
