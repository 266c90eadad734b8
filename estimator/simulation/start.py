"""Start of a simulation: at rest, or in the stationary state.

The disc mode of a chain relaxes only through the dampers of the caps, in seconds to hours. A start from rest would show
a transient for the whole record. The state is drawn from the exact Gaussian density of the linear rotor. A run before
the record then lets the effects act. Where exp(-H/T) is the stationary density, this run has strong damping on every
mass and the noise of the same temperature: it reaches the same density in a few periods. Otherwise it is a short run
with the true damping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.engine.law_loop import force_array
from estimator.errors import ModelError
from estimator.model.rig import Model
from estimator.model.rotor import assemble, linear_covariance

from .plan import Plan
from .stepper import Stepper
from .thresholds import LIMITS


def bring_to_start(
    model: Model, stepper: Stepper, rng: np.random.Generator, start: Literal["boltzmann", "rest"], first: int
) -> None:  # fmt: skip
    """Bring a stepper that is at rest to its start, before step number `first`.

    Raises ModelError where there is no stationary state.
    """
    plan, rig, n = stepper.plan, stepper.plan.rig, len(stepper.plan.rig.dofs)
    stepper.count = first
    if start == "rest":
        return
    if not np.any(rig.S):
        raise ModelError("no force drives the rotor, so there is no stationary state: set S, or start from rest")
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2.0))
    refuse_escape(plan, np.sqrt(np.diag(P)[:n]), np.diag(rig.M) * np.diag(P)[n:])
    w, U = np.linalg.eigh(P / np.sqrt(np.outer(np.diag(P), np.diag(P))))
    u = np.sqrt(np.diag(P)) * (U @ (np.sqrt(np.maximum(w, 0.0)) * rng.standard_normal(2 * n)))
    stepper.x[:n], stepper.v[:n] = u[:n], u[n:]
    if not plan.acting:
        return
    known = stationarity(model)
    if known.exact and not plan.correlation and not plan.shapes:
        _thermalise(stepper, rng, known.temperature)
    else:
        steps = round(LIMITS.burn_s / stepper.dt)
        stepper.count -= steps
        stepper.run_in(rng, steps)


def _thermalise(stepper: Stepper, rng: np.random.Generator, temperature: float) -> None:
    """Run with damping 0.5 m w on every mass at a temperature in J, for 60 times the slowest damping time."""
    rig = stepper.plan.rig
    m, w = np.diag(rig.M), np.sqrt(np.diag(rig.K) / np.diag(rig.M))
    strong = replace(rig, C=np.diag(0.5 * m * w), S=2.0 * 2.0 * temperature * 0.5 * m * w)
    other = Stepper(replace(stepper.plan, rig=strong), stepper.dt, stepper.speed)
    other.x, other.v, other.z = stepper.x, stepper.v, stepper.z  # stepped in place
    steps = round(60.0 / (0.5 * w.min()) / stepper.dt)
    while steps > 0:
        other.run_in(rng, min(steps, 65536))
        steps -= 65536


def refuse_escape(plan: Plan, sigma: Array, temperature: Array) -> None:
    """Raise ModelError where the static force of the effects lets a cap leave its potential well for good.

    sigma : (dofs,) m, temperature : (dofs,) J, of each degree of freedom of the linear rotor. The barrier is the
    highest potential along x. On either side it must exceed min_barrier_t temperatures.
    """
    for i, dof in enumerate(plan.rig.dofs):
        laws = [a for a in plan.acting if a.where[1] == i and a.effect.stationary_density and a.effect.force]
        laws = [a for a in laws if a.effect.kind == "force"]
        if not laws:
            continue
        x = np.linspace(0.0, 60.0 * sigma[i], 6001)
        for side in (1.0, -1.0):
            force = plan.rig.K[i, i] * x
            for a in laws:
                force = force + side * force_array(a.effect, a.p, side * x, s=a.s)
            V = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1])) * (x[1] - x[0])])
            if force[-1] < 0.0 and V.max() < LIMITS.min_barrier_t * temperature[i]:
                names = ", ".join(a.effect.name for a in laws)
                raise ModelError(
                    f"{dof}: {names} softens without end and has no stationary density "
                    f"(barrier {V.max() / temperature[i]:.1f} T, at least {LIMITS.min_barrier_t:g} T is needed): "
                    "weaken it, or use hertz"
                )


@dataclass(frozen=True, slots=True)
class Stationarity:
    """Whether exp(-H/T) is the stationary density of a model, H its energy.

    It is where the intensity of the forces is Q = 2 T C, with C the symmetric part of the damping matrix.

    Parameters
    ----------
    temperature : float
        T in J that matches best; infinite without damping.
    mismatch : float
        ``|Q - 2 T C| / |Q|``; 0 where the condition holds.
    blocking : tuple of str
        Effects that no temperature suits.
    """

    temperature: float
    mismatch: float
    blocking: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether exp(-H/T) is exactly stationary."""
        return self.mismatch < 1e-9 and not self.blocking


def stationarity(model: Model) -> Stationarity:
    """Whether exp(-H/T) is the stationary density of a model.

    Parameters
    ----------
    model : Model
        A rig whose linear values and masses are all given.

    Returns
    -------
    Stationarity
        Temperature, mismatch, and the effects that break the condition.

    Raises
    ------
    ModelError
        A linear value or a mass is missing.

    Examples
    --------
    >>> from estimator import Channel, Model, Setting
    >>> from estimator.simulation import stationarity
    >>> cap = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(50.0), "S": Setting(1.0e-4)}}
    >>> rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    >>> stationarity(rig).exact, stationarity(rig).temperature
    (True, 5e-07)
    """
    rig = assemble(model)
    Q, C = np.diag(rig.S / 2.0), 0.5 * (rig.C + rig.C.T)
    T = float(np.sum(Q * C) / (2.0 * np.sum(C * C))) if np.any(C) else np.inf
    mismatch = float(np.linalg.norm(Q - 2.0 * T * C) / np.linalg.norm(Q)) if np.any(Q) and np.isfinite(T) else np.inf
    effects = [effect_of(use) for use in model.effects]
    blocking = tuple(e.name for e in effects if not e.stationary_density and e.kind != "sensor")
    return Stationarity(T, mismatch, blocking)
