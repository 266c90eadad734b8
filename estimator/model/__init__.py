"""A rig as frozen data in SI units, and the linear algebra and bearing theory that follow from it."""

from .bearing_theory import Theory, kinematics, taylor, theory
from .effect import Effect, EffectParameter
from .recorder import AntiAlias
from .rig import (
    DIRECTIONS,
    MOTION,
    NODES,
    UNITS,
    BearingGeometry,
    Channel,
    CustomLaw,
    EffectUse,
    LineBand,
    Model,
    Setting,
    Shaft,
)

__all__ = [
    "AntiAlias",
    "BearingGeometry",
    "Channel",
    "CustomLaw",
    "DIRECTIONS",
    "Effect",
    "EffectParameter",
    "EffectUse",
    "LineBand",
    "MOTION",
    "Model",
    "NODES",
    "Setting",
    "Shaft",
    "Theory",
    "UNITS",
    "kinematics",
    "taylor",
    "theory",
]
