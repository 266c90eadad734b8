"""Tones, harmonics, impact trains and parametric stiffness of a machine."""

from .machine_survey import MachineSurvey, ShaftSpeed, StrikeTrain, Tone
from .survey import survey_machine

__all__ = ["MachineSurvey", "ShaftSpeed", "StrikeTrain", "Tone", "survey_machine"]
