"""Stribeck friction: dry friction that is largest where sliding begins.

vs is given, so that the law is linear in its free parameters. A search for vs is not well posed: below about three
standard deviations of the velocity that lies outside the band, the smoothed force of the law is not that of the law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    if v == 0.0:
        return 0.0
    r = v / p[2]
    friction = p[0] + p[1] * math.exp(-r * r)
    return friction if v > 0.0 else -friction


STRIBECK = Effect(
    name="stribeck",
    kind="force",
    parameters=(
        amplitude("fc", "N", "friction force at high sliding velocity"),
        amplitude("df", "N", "excess of static over sliding friction, fs - fc"),
        searched(
            "vs", "m/s", "velocity over which the excess falls off; given, not fitted", (1e-5, 1.0, 5e-4), given=True
        ),
    ),
    equation="(fc + df exp(-(v / vs)^2)) sgn v",
    signature=(
        "damping falls as the level rises, faster than with dry friction alone; the missing force is a step in "
        "velocity that decays to a lower plateau; vs is the rig file's, fc and df are fitted to it"
    ),
    confused_with=("coulomb", "quadratic_damping"),
    distinguish=(
        "friction falls with sliding velocity, where Coulomb friction is constant and quadratic damping rises; it may "
        "drive stick-slip"
    ),
    reference="Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30(7), 1994, 1083-1138 (Stribeck curve)",
    check=(
        "equivalent viscous damping of a Gaussian velocity is sqrt(2 / pi) (fc / sigma + df / (sigma (1 + 2 sigma^2 / "
        "vs^2)))"
    ),
    on_machine=(
        "a lip seal or a plain bush that runs dry or in mixed lubrication, squeal or stick-slip at low speed: check "
        "the lubricant and the lip of the seal"
    ),
    force=force,
    refines="coulomb",
)
