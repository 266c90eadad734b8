"""Where a simulation starts: at rest, or as if it had run for ever.

The disc mode of a chain relaxes only through the dampers of the caps, in 14 s to hours, so a start from rest would
show a transient for the whole record. The start is the exact Gaussian of the linear part. Where exp(-H/T) is exactly
stationary the effects are then let in with strong damping on every mass and the noise that goes
with it: the same density, reached in a few periods. Otherwise a short run with the true damping lets them in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.engine.law_loop import force_array
from estimator.errors import ModelError
from estimator.model.rig import Model
from estimator.model.rotor import assemble, linear_covariance

from .plan import Plan

if TYPE_CHECKING:
    from .stepper import Stepper

BURN_S = 0.5  # run before the record where the density is not known
BARRIER = 20.0  # least U/T of a softening model that is let run


def start_state(
    model: Model,
    plan: Plan,
    stepper: Stepper,
    rng: np.random.Generator,
    start: Literal["boltzmann", "rest"],
    first: int,
) -> tuple[Array, Array, Array, int]:
    """x, v (slots,), z and the step number `first` to go on from. Raises ModelError if there is no stationary state."""
    rig, n = plan.rig, len(plan.rig.dofs)
    if start == "rest":
        return stepper.x, stepper.v, stepper.z, first
    if not np.any(rig.S):
        raise ModelError("no force drives the rotor, so there is no stationary state: set S, or start from rest")
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2.0))
    refuse_escape(plan, np.sqrt(np.diag(P)[:n]), np.diag(rig.M) * np.diag(P)[n:])
    w, U = np.linalg.eigh(P / np.sqrt(np.outer(np.diag(P), np.diag(P))))
    u = np.sqrt(np.diag(P)) * (U @ (np.sqrt(np.maximum(w, 0.0)) * rng.standard_normal(2 * n)))
    stepper.x, stepper.v = stepper.slots.vector(u[:n]), stepper.slots.vector(u[n:])
    if plan.acting:
        known = stationarity(model)
        if known.exact and not plan.correlation and not plan.shapes:
            _thermalise(plan, stepper, rng, known.temperature)
        else:
            steps = round(BURN_S / stepper.dt)
            stepper.count = first - steps
            stepper.run_in(rng, steps)
    return stepper.x, stepper.v, stepper.z, first


def _thermalise(plan: Plan, stepper: Stepper, rng: np.random.Generator, temperature: float) -> None:
    """Run with damping 0.5 m w on every mass at the same temperature, for 60 times the slowest damping time."""
    rig = plan.rig
    m, w = np.diag(rig.M), np.sqrt(np.diag(rig.K) / np.diag(rig.M))
    strong = replace(rig, C=np.diag(0.5 * m * w), S=2.0 * 2.0 * temperature * 0.5 * m * w)
    other = type(stepper)(replace(plan, rig=strong), stepper.dt, stepper.scheme, stepper.speed)
    other.x, other.v, other.z = stepper.x, stepper.v, stepper.z
    steps = round(60.0 / (0.5 * w.min()) / stepper.dt)
    while steps > 0:
        other.run_in(rng, min(steps, 65536))
        steps -= 65536
    stepper.x, stepper.v, stepper.z = other.x, other.v, other.z


def refuse_escape(plan: Plan, sigma: Array, temperature: Array) -> None:
    """Raise ModelError where the static force of the effects lets a cap leave its well for good.

    sigma : (n,) m, temperature : (n,) J of each degree of freedom of the linear rotor. The barrier is the highest
    potential on the way out along x; the least of both signs must exceed 20 T (physics.md section 2).
    """
    for i, dof in enumerate(plan.rig.dofs):
        laws = [a for a in plan.acting if a.where[1] == i and a.effect.stationary_density and a.effect.force]
        if not laws or not dof.startswith("bearing"):
            continue
        x = np.linspace(0.0, 60.0 * sigma[i], 6001)
        for side in (1.0, -1.0):
            force = plan.rig.K[i, i] * x
            for a in laws:
                force = force + side * force_array(a.effect, a.p, side * x, s=a.s)
            V = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1])) * (x[1] - x[0])])
            if force[-1] < 0.0 and V.max() < BARRIER * temperature[i]:
                names = ", ".join(a.effect.name for a in laws)
                raise ModelError(
                    f"{dof}: {names} softens without end and has no stationary density (barrier "
                    f"{V.max() / temperature[i]:.1f} T, at least {BARRIER:g} T is needed): weaken it, or use hertz"
                )


@dataclass(frozen=True, slots=True)
class Stationarity:
    """Whether exp(-H/T) is the stationary density: force intensity Q = 2 T C_sym (physics.md section 2).

    temperature : J, the T of the best match; by_dof : J, Q_ii / (2 C_ii) of each damped or driven degree of freedom;
    mismatch : |Q - 2 T C| / |Q| (0: exact). blocking : effects that break it whatever the noise.
    """

    temperature: float
    by_dof: dict[str, float]
    mismatch: float
    blocking: tuple[str, ...]

    @property
    def exact(self) -> bool:
        return self.mismatch < 1e-9 and not self.blocking


def stationarity(model: Model) -> Stationarity:
    """The exact stationary condition of any model. Raises ModelError if the linear part is incomplete."""
    rig = assemble(model)
    Q, C = np.diag(rig.S / 2.0), 0.5 * (rig.C + rig.C.T)
    T = float(np.sum(Q * C) / (2.0 * np.sum(C * C))) if np.any(C) else np.inf
    by_dof = {
        dof: float(Q[i, i] / (2.0 * C[i, i])) if C[i, i] > 0 else np.inf
        for i, dof in enumerate(rig.dofs)
        if Q[i, i] > 0 or C[i, i] > 0
    }
    mismatch = float(np.linalg.norm(Q - 2.0 * T * C) / np.linalg.norm(Q)) if np.any(Q) and np.isfinite(T) else np.inf
    effects = [effect_of(use) for use in model.effects]
    blocking = tuple(e.name for e in effects if not e.stationary_density and e.kind != "sensor")
    return Stationarity(T, by_dof, mismatch, blocking)
