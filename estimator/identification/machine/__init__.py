"""Tones, harmonics, impact trains and parametric stiffness of a machine."""

from .machine_survey import MachineSurvey, ShaftSpeed, StrikeTrain, Tone
from .survey import survey_machine
from .tones import joined_bands

__all__ = ["MachineSurvey", "ShaftSpeed", "StrikeTrain", "Tone", "joined_bands", "survey_machine"]
