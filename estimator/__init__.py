"""Output-only identification of rotors on rolling bearings: the public names.

A rig is a `Model`; `simulate` makes a record of one; `fit`, `compare`, `diagnose` and `improve` take a record; a
`RollingEstimator` takes samples as they arrive. Everything is in SI units. The names are bound at first use, so that
`import estimator` costs no compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .diagnosis.comparison import Comparison, compare
    from .diagnosis.verdict import Diagnosis, Improvement, diagnose, improve
    from .effects import CATALOGUE
    from .errors import DataError, ModelError
    from .identification.fit import fit
    from .identification.rolling import RollingEstimator
    from .model import Channel, Effect, EffectParameter, EffectUse, Model, Setting
    from .results import Estimate, Fit, Parameter
    from .simulation import simulate

__all__ = [
    "CATALOGUE",
    "Channel",
    "Comparison",
    "DataError",
    "Diagnosis",
    "Effect",
    "EffectParameter",
    "EffectUse",
    "Estimate",
    "Fit",
    "Improvement",
    "Model",
    "ModelError",
    "Parameter",
    "RollingEstimator",
    "Setting",
    "compare",
    "diagnose",
    "fit",
    "improve",
    "simulate",
]

_ROOM_OF = {  # public name -> the room that defines it
    "CATALOGUE": "effects",
    "Channel": "model",
    "Comparison": "diagnosis.comparison",
    "DataError": "errors",
    "Diagnosis": "diagnosis.verdict",
    "Effect": "model",
    "EffectParameter": "model",
    "EffectUse": "model",
    "Estimate": "results",
    "Fit": "results",
    "Improvement": "diagnosis.verdict",
    "Model": "model",
    "ModelError": "errors",
    "Parameter": "results",
    "RollingEstimator": "identification.rolling",
    "Setting": "model",
    "compare": "diagnosis.comparison",
    "diagnose": "diagnosis.verdict",
    "fit": "identification.fit",
    "improve": "diagnosis.verdict",
    "simulate": "simulation",
}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
