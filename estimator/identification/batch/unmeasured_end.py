"""A shaft with bearings that are not measured: their unknown motion acts on the measured ones through the shaft."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimator.errors import DataError
from estimator.model.rig import Model
from estimator.model.rotor import rotor_matrices
from estimator.results import Message

from .thresholds import LIMITS


def unmeasured_end_messages(model: Model, kL: Mapping[str, float]) -> tuple[Message, ...]:
    """A message if an unmeasured bearing acts on a measured one through the shaft. kL : by place, N/m.

    Raises DataError where it acts strongly through the modes of a given rotor.
    """
    matrices = rotor_matrices(model)
    if matrices is None:
        return ()
    most, lacking = 0.0, ""
    for place, stiffness in kL.items():
        mass = model.cap_mass(place)
        others = [f"{n}.{place[-1]}" for n in matrices.bearings if f"{n}.{place[-1]}" not in (place, *model.places)]
        rotor = matrices.at((place, *others))
        if rotor is None or not others or mass is None or stiffness <= 0.0:
            continue
        through = np.abs(rotor.dynamic(np.array([np.sqrt(stiffness / mass)]))[0, 0, 1:]) / stiffness
        if through.max() > max(most, LIMITS.min_shaft_stiffness_rel):
            most, lacking = float(through.max()), others[int(np.argmax(through))][:-2]
    if not lacking:
        return ()
    acts = (
        f"{lacking} is not measured, but its motion acts through the shaft on the bearing that is ({100 * most:.0f} % "
        "of the stiffness there, at the resonance)"
    )
    if model.rotor is not None and most > LIMITS.max_rotor_stiffness_rel:
        raise DataError(f"{acts}: measure all bearings, or leave out the shaft")
    text = f"{acts}. The fit takes it for excitation, and no value is reliable: measure all bearings"
    return (Message("end_unmeasured", text, lacking),)
