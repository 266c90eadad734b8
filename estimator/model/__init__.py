"""A rig as frozen data in SI units, and the linear algebra and bearing theory that follow from it."""

from .bearing_theory import Theory, kinematics, taylor, theory
from .effect import Effect, EffectParameter
from .recorder import AntiAlias
from .rig import (
    BEARING_NODES,
    CAP_DIRECTIONS,
    KEYS_OF_ISO_PART,
    LINEAR_UNITS,
    MOTION_UNITS,
    BearingGeometry,
    Channel,
    CustomLaw,
    EffectUse,
    MachineClass,
    Model,
    Setting,
    Shaft,
)
from .rotor import assemble
from .rotor_matrices import RotorMatrices, reduced_rotor

__all__ = [
    "AntiAlias",
    "BearingGeometry",
    "Channel",
    "CustomLaw",
    "CAP_DIRECTIONS",
    "Effect",
    "EffectParameter",
    "EffectUse",
    "KEYS_OF_ISO_PART",
    "MOTION_UNITS",
    "MachineClass",
    "Model",
    "BEARING_NODES",
    "RotorMatrices",
    "Setting",
    "Shaft",
    "Theory",
    "LINEAR_UNITS",
    "assemble",
    "kinematics",
    "reduced_rotor",
    "taylor",
    "theory",
]
