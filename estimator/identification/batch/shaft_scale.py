"""Cap masses that the coupling of the caps through a known shaft gives, by the spectra of the caps with a background.

One cap alone has no scale: a heavier cap on a stiffer bearing under a larger force moves equally. The motion of one cap
moves the other one through a shaft of known stiffness, a light cap more than a heavy one. The masses are parameters of
the joint spectrum (`joint_spectrum`). What the spectra leave unexplained counts in their standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, products
from estimator.identification.structure.background_search import (
    backgrounds,
    force_dispersion,
    score_nats,
    search_background,
    tried_point,
)
from estimator.identification.structure.joint_spectrum import JointPoint, JointSpectrum, Solution
from estimator.identification.structure.spectral_problem import (
    caps_by_direction,
    measured_spectra,
    spectral_problem,
    start_values,
)
from estimator.identification.structure.thresholds import LIMITS as STRUCTURE_LIMITS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background, BearingBackground
from estimator.model.rig import Model
from estimator.model.rotor import shaft_matrix

from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class ShaftScale:
    """Masses of the caps, and the background beside them.

    Parameters
    ----------
    ln_mass : mapping of str to (float, float)
        By place, logarithm of the mass in kg, and its standard deviation.
    background : Background or None
        Of the caps at these masses; None where they need none.
    """

    ln_mass: Mapping[str, tuple[float, float]]
    background: Background | None


def shaft_scale(model: Model, apart: WorkingPoint, unknown: Sequence[str]) -> ShaftScale | None:
    """The masses of the caps that a rig leaves out; None where the spectra cannot be explained by any.

    Parameters
    ----------
    model : Model
        The rig.
    apart : WorkingPoint
        Each cap fitted without the shaft, unknown masses at 1 kg.
    unknown : sequence of str
        Places of the unknown masses.
    """
    data = apart.data
    ln_mass: dict[str, tuple[float, float]] = {}
    at: dict[str, BearingBackground] = {}
    for own in caps_by_direction(data.places):
        loose = tuple(cap for cap, i in enumerate(own) if data.places[i] in unknown)
        problem = spectral_problem(model, apart, measured_spectra(model, apart, own), loose=loose)
        best = _likeliest(model, problem, apart)
        if best is None:
            return None
        problem, point = best
        misfit = float(problem.misfit(point).max())
        sd = np.hypot(_mass_sd(problem, point) * force_dispersion(apart) ** 0.5, misfit)
        if misfit > STRUCTURE_LIMITS.max_background_depth_rms or len(own) < 2:
            sd = np.full(sd.size, LIMITS.unknown_sd)
        ln_mass |= {
            data.places[own[cap]]: (float(heavier), float(s))
            for cap, heavier, s in zip(loose, point.values.heavier, sd, strict=True)
        }
        if point.values.modes or problem.basis.shape[1] > 1:
            at |= dict(backgrounds(problem, point, apart))
    ln_mass = _by_node(ln_mass)
    scaled = {place: _scaled(b, float(np.exp(ln_mass.get(place, (0.0, 0.0))[0]))) for place, b in at.items()}
    return ShaftScale(ln_mass=ln_mass, background=Background(at=scaled) if scaled else None)


def _likeliest(model: Model, problem: JointSpectrum, apart: WorkingPoint) -> Solution | None:
    """The likeliest problem and point of several start masses, with the background that they need."""
    cost_nats = STRUCTURE_LIMITS.min_gain_nats * force_dispersion(apart)
    if not problem.loose:
        starts = [problem.maximised(start_values(problem, apart))]
    else:
        tried = [_started(model, problem, apart, share) for share in LIMITS.start_masses_rel]
        starts = sorted((p for p in tried if p is not None), key=lambda p: -p.log_likelihood)[: LIMITS.searched_starts]
    found = []
    for start in starts:
        try:
            found.append(search_background(problem, start, cost_nats))
        except np.linalg.LinAlgError:
            continue
    return max(found, key=lambda one: score_nats(one, cost_nats)) if found else None


def _started(model: Model, problem: JointSpectrum, apart: WorkingPoint, share: float) -> JointPoint | None:
    """The point from start masses that are a share of the disc mass; None where the model is not positive there."""
    values = start_values(problem, apart)
    loose = list(problem.loose)
    heavier = np.log(share * model.mass["disc"] / problem.mass[loose])
    carried = np.zeros(problem.mass.size)
    carried[loose] = float(shaft_matrix(model.shaft, model.shaft_stiffness)[0, 0]) * np.exp(-heavier)
    k = np.exp(values.stiffness)
    values = replace(
        values, stiffness=np.log(np.maximum(k - carried, LIMITS.min_start_stiffness_rel * k)), heavier=heavier
    )  # fmt: skip
    try:
        return tried_point(problem, values)
    except np.linalg.LinAlgError:
        return None


def _mass_sd(problem: JointSpectrum, point: JointPoint) -> Array:
    """(loose,) standard deviations of the logarithms of the masses."""
    J, _ = problem.score(point)
    caps, splines = point.values.force.shape
    masses = caps * (splines + 3) + np.arange(len(problem.loose))
    information = products(J)
    information[masses, masses] += LIMITS.unknown_sd**-2
    variance = np.diag(np.linalg.pinv(information))[masses]
    return np.asarray(np.sqrt(variance * max(problem.dispersion(point), 1.0)))


def _by_node(ln_mass: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """One mass of a cap for both directions: the mean by certainty."""
    out = {}
    for place in ln_mass:
        own = np.array([v for p, v in ln_mass.items() if p.split(".")[0] == place.split(".")[0]])
        weight = 1.0 / np.maximum(own[:, 1], 1e-6) ** 2
        out[place] = float(own[:, 0] @ weight / weight.sum()), float(weight.sum() ** -0.5)
    return out


def _scaled(background: BearingBackground, mass: float) -> BearingBackground:
    """The background of a cap that is `mass` times as heavy."""
    modes = tuple(replace(m, mass=m.mass * mass) for m in background.modes)
    return replace(
        background, modes=modes, stiffness=background.stiffness * mass, damping=background.damping * mass
    )  # fmt: skip
