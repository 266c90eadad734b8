"""Tones, harmonics, impact trains and parametric stiffness of a machine."""

from .machine_survey import MachineSurvey, ShaftSpeed, StrikeTrain, Tone
from .survey import strikes_of_block, survey_machine
from .tones import joined_bands

__all__ = ["MachineSurvey", "ShaftSpeed", "StrikeTrain", "Tone", "joined_bands", "strikes_of_block", "survey_machine"]
