"""Excitation spectra, modes, sensor noise, recorder filter and faults of measured paths."""

from .survey import ExcitationSpectrum, Mode, PlaceStructure, PolePoint, StructureSurvey, bearing_mode, survey_structure

__all__ = [
    "ExcitationSpectrum",
    "Mode",
    "PlaceStructure",
    "PolePoint",
    "StructureSurvey",
    "bearing_mode",
    "survey_structure",
]
