"""Excitation spectra, modes, sensor noise and recorder filter."""

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
