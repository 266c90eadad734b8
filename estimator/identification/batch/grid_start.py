"""Starting values for parameters that a law is not linear in: a gap, a corner frequency, an exponent.

Gauss-Newton finds such a parameter from nearby. The value of the rig file may be far off, so a coarse grid about it is
tried first, on a part of the record, together with the model without the effect. A pedestal has no amplitude to score
a grid node by. It starts from the spectrum of the residual force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.engine.strength import search_range
from estimator.identification.structure import spectral_models
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import LocatedLaw, first_stiffness, located_laws, natural_sizes
from estimator.likelihood.motion.motion_record import MotionRecord, leading_blocks
from estimator.likelihood.path import law_gain
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.thresholds import LIMITS as LIKELIHOOD_LIMITS
from estimator.model.rig import Model, Setting
from estimator.parallel import map_threads

from .thresholds import LIMITS

GRID_FACTORS = {1: np.geomspace(0.1, 10.0, 13), 2: np.geomspace(0.1, 10.0, 5)}  # of the start, by number of parameters
COARSE_FACTORS = np.array([0.3, 1.0, 3.0])  # for three parameters or more
FINE_FACTORS = np.array([0.56, 1.0, 1.8])  # about the best node, where the grid was wide


def fit_record(model: Model, data: MotionRecord) -> WorkingPoint:
    """The laws of a model fitted to a record, from any start values."""
    uses, near = _with_pedestal_starts(
        data, located_laws(model, data), located_laws(_without_pedestal_values(model), data)
    )
    loose = [k for k, use in enumerate(uses) if _searched_parameters(use)]
    part = leading_blocks(data, LIMITS.grid_s)
    kinds = {k: (uses[k].effect.name, *_searched_parameters(uses[k])) for k in loose}
    for kind in dict.fromkeys(kinds.values()):
        own = [k for k in loose if kinds[k] == kind]
        point = fit_model(part, [u for j, u in enumerate(uses) if j not in loose or j < own[0]])
        for k, use in zip(own, _best_of_grids(point, [uses[k] for k in own]), strict=True):
            uses[k] = use
    return fit_model(data, uses, near)


def _without_pedestal_values(model: Model) -> Model:
    """The model without start values for the free parameters of its pedestals."""

    def bare(own: Mapping[str, Setting]) -> dict[str, Setting]:
        return {name: s if s.fixed else replace(s, value=None) for name, s in own.items()}

    uses = (
        replace(u, parameters={p: bare(own) for p, own in u.parameters.items()}) if effect_of(u).adds_resonance else u
        for u in model.effects
    )
    return replace(model, effects=tuple(uses))


def _with_pedestal_starts(
    data: MotionRecord, uses: list[LocatedLaw], natural: list[LocatedLaw]
) -> tuple[list[LocatedLaw], WorkingPoint | None]:  # fmt: skip
    """The laws with start values for their pedestals, and the working point of that start; None without a pedestal.

    Three starts are fitted and the likeliest is kept: the suggestion of the residual force where none is measured, the
    given values, and the natural size.

    uses : located laws at the values of the model. natural : the same laws with pedestals at their natural size.
    """
    shaped = [k for k, use in enumerate(uses) if use.effect.adds_resonance and any(use.free)]
    others = [use for k, use in enumerate(uses) if k not in shaped and not _searched_parameters(use)]
    if not shaped:
        return uses, None
    part = leading_blocks(data, LIMITS.pedestal_start_s)
    without = fit_model(part, others)
    started = {}
    kL, c = without.kL.copy(), without.c.copy()
    for k in shaped:
        i = uses[k].at[0]
        if kL[i] > 0.0 and not data.measured_force_psd[i] > 0.0:  # else a fit far from the rotor, or noise
            values, kL[i], c[i] = spectral_models.pedestal_from_spectrum(without, i)
            started[k] = uses[k].with_values(np.where(uses[k].free, values, uses[k].p))
    points = [fit_model(part, [*others, *(given[k] for k in shaped)]) for given in (uses, natural)]
    if started:
        own = [*others, *(started.get(k, uses[k]) for k in shaped)]
        points.insert(0, fit_model(part, own, replace(without, kL=kL, c=c, placed=tuple(own))))
    least = -LIMITS.max_negative_damping_rel * np.abs(without.c)
    sound = [point for point in points if np.all(point.kL > 0.0) and np.all(point.c > least)]
    best = max(sound or points, key=lambda point: point.fit.log_likelihood)
    fitted = {use.key: use for use in best.placed}
    return [fitted.get(use.key, use) for use in uses], best


def _searched_parameters(use: LocatedLaw) -> list[int]:
    """Indices of the free parameters that a grid can find: the law is not linear in them, is linear in another one, and
    they are no shaft order."""
    if not any(q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)):
        return []
    return [
        k for k, q in enumerate(use.effect.parameters)
        if use.free[k] and not q.linear and q.scale != "bpfo" and use.p[k] != 0.0
    ]  # fmt: skip


def _best_of_grids(point: WorkingPoint, uses: list[LocatedLaw]) -> list[LocatedLaw]:
    """The laws of one effect at the best node of a grid, and then of a finer grid if there are several parameters."""
    loose = len(_searched_parameters(uses[0]))
    started = _best_of_grid(point, uses, GRID_FACTORS.get(loose, COARSE_FACTORS), both_signs=True)
    return started if loose == 1 else _best_of_grid(point, started, FINE_FACTORS)


def _best_of_grid(
    point: WorkingPoint, uses: list[LocatedLaw], factors: Array, both_signs: bool = False
) -> list[LocatedLaw]:
    """The laws at the best node of the grid of these factors, amplitudes as fitted there.

    All locations share a node. A location gets its own node where that gains min_own_values_gain_nats.
    """
    nodes = [_grid_nodes(point, use, factors, both_signs) for use in uses]
    pairs = [use for own in nodes for use in own]
    found = map_threads(lambda use: law_gain.fitted_gain(point, use), pairs)
    tried = [found[k : k + len(nodes[0])] for k in range(0, len(pairs), len(nodes[0]))]
    gains = np.array([[0.0 if got is None else max(got.gain, 0.0) for got in own] for own in tried])
    shared = int(np.argmax(gains.sum(axis=0)))
    out = []
    for use, own, results, gained in zip(uses, nodes, tried, gains, strict=True):
        best = int(np.argmax(gained))
        best = best if gained[best] > gained[shared] + LIKELIHOOD_LIMITS.min_own_values_gain_nats else shared
        got = results[best]
        out.append(use if got is None or got.gain <= 0.0 else _with_fitted_amplitudes(own[best], got.problem, got.fit))
    return out


def _grid_nodes(point: WorkingPoint, use: LocatedLaw, factors: Array, both_signs: bool) -> list[LocatedLaw]:
    """The law at every node of the grid, inside the limits of its parameters, with its free amplitudes at 1.

    both_signs : also nodes of the other sign where the parameter may have both, as the side of a stop.
    """
    loose = _searched_parameters(use)
    limits = [(use.effect.parameters[k].low, use.effect.parameters[k].high) for k in loose]
    both = [both_signs and -np.inf < low < 0.0 < high < np.inf for low, high in limits]
    axes = [np.append(factors, -factors) if signed else factors for signed in both]
    natural = natural_sizes(point.data, use.at[0], first_stiffness(point.data, use.at[0]))
    ranges = np.array([search_range(use.effect.parameters[k], natural) for k in loose]).T
    bounds = np.minimum(ranges[0], use.p[loose]), np.maximum(ranges[1], use.p[loose])  # a given start may be outside
    p = np.where([q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)], 1.0, use.p)
    nodes = []
    for scale in product(*axes):
        node = p.copy()
        node[loose] = np.clip(node[loose] * scale, *bounds)
        nodes.append(use.with_values(node))
    return nodes


def _with_fitted_amplitudes(use: LocatedLaw, problem: Subproblem, fit: PathFit) -> LocatedLaw:
    """The law with its fitted amplitudes; 0 for an amplitude that the fit left out, as it was outside its limits."""
    p = use.p.copy()
    for k, q in enumerate(use.effect.parameters):
        if q.linear and use.free[k]:
            p[k] = fit.value(use.name(k))[0] if use.name(k) in problem.extra else 0.0
    return use.with_values(p)
