"""Starting values for parameters that no linear fit can find: a gap, a corner, an exponent typed as a guess.

Newton's method finds them from near by. What a rig file says may be far off, so each effect with such parameters is
first tried on a coarse grid about its values, on a part of the record, beside the model without it. A pedestal, which
has no amplitude to judge a node by, is also begun from what the spectrum of the force suggests, or the motion under a
measured force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from estimator.arrays import Array
from estimator.identification.structure import spectral_models, transfer_bias
from estimator.likelihood.fitting.gauss_newton import coarse_fit, fit_model
from estimator.likelihood.motion.located_law import LocatedLaw, located_laws
from estimator.likelihood.motion.motion_record import MotionRecord, leading_blocks
from estimator.likelihood.path import law_gain
from estimator.likelihood.path.path_fit import PathFit
from estimator.likelihood.path.subproblem import Subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model, Setting
from estimator.parallel import map_threads

GRID_S = 6.0
PEDESTAL_START_S = 20.0  # for the spectrum of the force
GRID_FACTORS = {1: np.geomspace(0.1, 10.0, 13), 2: np.geomspace(0.1, 10.0, 5)}
COARSE_FACTORS = np.array([0.3, 1.0, 3.0])
MAX_NEGATIVE_DAMPING_REL = (
    0.1  # of a damping without a pedestal: a fit with one may end as far below zero, on its way to a light one
)
FINE_FACTORS = np.array([0.56, 1.0, 1.8])  # about the best node of a grid of several numbers, whose steps are wide


def fit_record(
    model: Model, data: MotionRecord, begun: WorkingPoint | None = None, glance: bool = False
) -> WorkingPoint:
    """The model fitted to a record, whatever values its rig file starts from. begun : the same fitted to nearly the
    same record, to begin from where only amplitudes are sought. glance : there, near enough to look at the force."""
    uses, near = _with_pedestal_starts(
        data, located_laws(model, data), located_laws(_without_pedestal_values(model), data)
    )
    loose = [k for k, use in enumerate(uses) if _searched_parameters(use)]
    if not loose and near:
        return fit_model(data, uses, near)
    if not loose and begun:
        return fit_model(data, list(begun.placed), begun)
    if not loose:
        return coarse_fit(data, uses) if glance else fit_model(data, uses)
    part = leading_blocks(data, GRID_S)
    kinds = {k: (uses[k].effect.name, *_searched_parameters(uses[k])) for k in loose}
    for kind in dict.fromkeys(kinds.values()):
        own = [k for k in loose if kinds[k] == kind]
        point = fit_model(part, [u for j, u in enumerate(uses) if j not in loose or j < own[0]])
        for k, use in zip(own, _best_of_grids(point, [uses[k] for k in own]), strict=True):
            uses[k] = use
    return fit_model(data, uses, near)


def _without_pedestal_values(model: Model) -> Model:
    """The model with no values for the free numbers of its pedestals."""

    def bare(own: Mapping[str, Setting]) -> dict[str, Setting]:
        return {name: s if s.fixed else replace(s, value=None) for name, s in own.items()}

    uses = (
        replace(u, parameters={p: bare(own) for p, own in u.parameters.items()}) if u.name == "pedestal" else u
        for u in model.effects
    )
    return replace(model, effects=tuple(uses))


def _with_pedestal_starts(
    data: MotionRecord, uses: list[LocatedLaw], natural: list[LocatedLaw]
) -> tuple[list[LocatedLaw], WorkingPoint | None]:  # fmt: skip
    """The uses with their pedestals begun where the force of a model without them suggests, or at the natural size, if
    that fits better; beside a measured force, which forgives no distance, with the point to begin from.

    Beside a shaft as stiff as the bearings, all four caps on pedestals, what the force suggested at one of them led to
    a stiffness a hundred times too small; the natural size led to the rotor.
    """
    shaped = [k for k, use in enumerate(uses) if use.effect.name == "pedestal" and any(use.free)]
    others = [use for k, use in enumerate(uses) if k not in shaped and not _searched_parameters(use)]
    if not shaped:
        return uses, None
    part = leading_blocks(data, PEDESTAL_START_S)
    without = fit_model(part, others)
    begun = {}
    kL, c = without.kL.copy(), without.c.copy()
    for k in shaped:
        i = uses[k].at[0]
        if kL[i] > 0.0:  # not a fit far from the rotor
            suggest = (
                transfer_bias.pedestal_from_transfer if data.driven[i] > 0.0 else spectral_models.pedestal_from_spectrum
            )
            suggested, kL[i], c[i] = suggest(without, i)
            begun[k] = uses[k].with_values(np.where(uses[k].free, suggested, uses[k].p))
    own = [begun.get(k, uses[k]) for k in shaped]
    if data.measured_force:
        best = fit_model(part, [*others, *own], replace(without, kL=kL, c=c))
    else:
        beside = replace(without, kL=kL, c=c, placed=(*others, *own))
        points = [
            fit_model(part, [*others, *own], beside),
            *(fit_model(part, [*others, *(given[k] for k in shaped)]) for given in (uses, natural)),
        ]
        least = -MAX_NEGATIVE_DAMPING_REL * np.abs(without.c)
        sound = [point for point in points if np.all(point.kL > 0.0) and np.all(point.c > least)]
        best = max(sound or points, key=lambda point: point.fit.log_likelihood)
    fitted = {use.key: use for use in best.placed}
    return [fitted.get(use.key, use) for use in uses], best


def _searched_parameters(use: LocatedLaw) -> list[int]:
    """Numbers of the free parameters that are no amplitudes, if there are amplitudes to judge them by; not of a shaft
    order, which no grid finds (stiffness_order.py)."""
    if not any(q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)):
        return []
    return [
        k for k, q in enumerate(use.effect.parameters)
        if use.free[k] and not q.linear and q.scale != "bpfo" and use.p[k] != 0.0
    ]  # fmt: skip


def _best_of_grids(point: WorkingPoint, uses: list[LocatedLaw]) -> list[LocatedLaw]:
    """The uses of one effect at the best of a grid about their values, amplitudes as they fit there; of several numbers
    also of a closer one about that."""
    loose = len(_searched_parameters(uses[0]))
    begun = _best_of_grid(point, uses, GRID_FACTORS.get(loose, COARSE_FACTORS), turned=True)
    return begun if loose == 1 else _best_of_grid(point, begun, FINE_FACTORS)


def _best_of_grid(
    point: WorkingPoint, uses: list[LocatedLaw], factors: Array, turned: bool = False
) -> list[LocatedLaw]:
    """The same of the grid of these factors. Places are alike unless the record says otherwise: one has a node of its
    own where that is worth MIN_OWN_VALUES_GAIN_NATS."""
    nodes = [_grid_nodes(use, factors, turned) for use in uses]
    pairs = [use for own in nodes for use in own]
    found = map_threads(lambda use: law_gain.fitted_gain(point, use), pairs)
    tried = [found[k : k + len(nodes[0])] for k in range(0, len(pairs), len(nodes[0]))]
    gains = np.array([[0.0 if got is None else max(got.gain, 0.0) for got in own] for own in tried])
    shared = int(np.argmax(gains.sum(axis=0)))
    out = []
    for use, own, results, gained in zip(uses, nodes, tried, gains, strict=True):
        best = int(np.argmax(gained))
        best = best if gained[best] > gained[shared] + law_gain.MIN_OWN_VALUES_GAIN_NATS else shared
        got = results[best]
        out.append(use if got is None or got.gain <= 0.0 else _with_fitted_amplitudes(own[best], got.problem, got.fit))
    return out


def _grid_nodes(use: LocatedLaw, factors: Array, turned: bool) -> list[LocatedLaw]:
    """The use at every node, its free amplitudes 1. turned : also with the other sign, where the effect has numbers of
    both: the side that a stop is on, preload or clearance."""
    loose = _searched_parameters(use)
    limits = [(use.effect.parameters[k].low, use.effect.parameters[k].high) for k in loose]
    both = [turned and -np.inf < low < 0.0 < high < np.inf for low, high in limits]
    axes = [np.append(factors, -factors) if signed else factors for signed in both]
    p = np.where([q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)], 1.0, use.p)
    nodes = []
    for scale in product(*axes):
        node = p.copy()
        node[loose] *= scale
        nodes.append(use.with_values(node))
    return nodes


def _with_fitted_amplitudes(use: LocatedLaw, problem: Subproblem, fit: PathFit) -> LocatedLaw:
    """The use with the amplitudes of its fit, 0 for those that would be out of their limits."""
    p = use.p.copy()
    for k, q in enumerate(use.effect.parameters):
        if q.linear and use.free[k]:
            p[k] = fit.value(use.name(k))[0] if use.name(k) in problem.extra else 0.0
    return use.with_values(p)
