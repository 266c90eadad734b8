"""Forces on the two bearings that are correlated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def shape(f_hz: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.float64]:
    """Cross spectrum over sqrt(S1 S2): the same at every frequency."""
    return np.full(len(f_hz), float(p[0]))


CORRELATED_FORCE = Effect(
    name="correlated_force",
    kind="excitation",
    parameters=(
        searched("rho", "1", "correlation of the forces on both bearings in this direction", (-0.99, 0.99, 0.5)),
    ),
    equation="cross spectrum of the forces = rho sqrt(S1 S2)",
    signature=(
        "the inferred excitations of the two bearings are coherent in this direction; no channel fails against "
        "its own state"
    ),
    confused_with=("pedestal", "sensor_gain", "line"),
    distinguish="coherence of the inferred forces over the whole band with no delay; no force depends on a state",
    reference="Bendat and Piersol, Random Data, 4th ed., Wiley 2010 (multiple inputs, ordinary coherence)",
    check="coherence of the simulated forces is rho^2",
    on_machine=(
        "foundation or belt shakes both bearings, or one process force acts on the whole rotor: measure on the "
        "foundation"
    ),
    scope="bearings",
    shape=shape,
    found_by="coherence",
    typical={"rho": (0.15, 0.4)},
)
