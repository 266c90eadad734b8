"""A shaft with one measured bearing: the motion of the other bearing acts on it through the shaft, unknown."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import shaft_reaction
from estimator.model.rig import BEARING_NODES, Model
from estimator.results import Message

MIN_SHAFT_STIFFNESS_REL = 0.01  # of the stiffness at a place: a weaker coupling through the shaft does not matter


def unmeasured_end_messages(model: Model, kL: Mapping[str, float]) -> tuple[Message, ...]:
    """A message if an unmeasured bearing acts on a measured one through the shaft. kL : by place, N/m."""
    try:
        reaction = shaft_reaction(model)
    except DataError:  # said elsewhere
        return ()
    most, lacking = 0.0, ""
    for place, stiffness in kL.items():
        node, direction = place.split(".")
        other = BEARING_NODES[node == BEARING_NODES[0]]
        mass = model.cap_mass(place)
        if reaction is None or mass is None or stiffness <= 0.0 or f"{other}.{direction}" in model.places:
            continue
        f_hz = np.array([np.sqrt(stiffness / mass) / (2 * np.pi)])
        share = float(np.abs(reaction(f_hz))[0]) / stiffness
        if share > max(most, MIN_SHAFT_STIFFNESS_REL):
            most, lacking = share, other
    if not lacking:
        return ()
    text = (
        f"{lacking} is not measured, but its motion acts through the shaft on the bearing that is ({100 * most:.0f} % "
        "of the stiffness there, at the resonance). The fit takes it for excitation, and no value is reliable: "
        "measure both bearings"
    )
    return (Message("end_unmeasured", text, lacking),)
