"""Excitation spectra, modes, sensor noise and recorder filter."""

from .survey import Mode, StructureSurvey, bearing_mode, survey_structure

__all__ = ["Mode", "StructureSurvey", "bearing_mode", "survey_structure"]
