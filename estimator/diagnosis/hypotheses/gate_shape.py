"""Gate of shape: what smooth terms of a law's own state still explain together with the law.

Hat functions catch any curve, but cost twenty parameters, and narrow hats of the velocity vary faster than the band can
follow. A law that is nearly right leaves a smooth misfit, which a few Hermite polynomials of its state catch.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Complexes, Series
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.identification.residual.group_fit import extra_power
from estimator.likelihood.motion.located_law import LocatedLaw, law_along_record, own_response
from estimator.likelihood.path.subproblem import likelihood_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.response.regressor_set import Regressor, in_single_precision, orthogonalised
from estimator.model.effect import Effect
from estimator.parallel import map_threads

StateTerms = tuple[tuple[str, tuple[int, ...]], ...]  # states, and the orders of their Hermite polynomials
ODD_ORDERS = (3, 5, 7, 9)
EVEN_VELOCITY_TERMS = ("v", (2, 4, 6))  # of no law: what they explain passes for a drag or for a law not odd in x
ODD_X_TERMS: StateTerms = (("x", ODD_ORDERS),)
ONE_SIDED_TERMS: StateTerms = (("x", tuple(range(2, 10))), EVEN_VELOCITY_TERMS)
VELOCITY_TERMS: StateTerms = (("v", ODD_ORDERS[:3]), EVEN_VELOCITY_TERMS)
ONE_WAY_TERMS: StateTerms = (("v", tuple(range(2, 8))),)  # of a law of velocity that is not odd


def polynomial_terms(effect: Effect | None) -> StateTerms:
    """Smooth terms that gain nothing together with the right law, those of its own state first.

    Empty for an effect that is no force of a single state on a bearing cap. Terms even in x together with a law odd in
    x belong to another law.
    """
    if effect is None or effect.kind != "force" or effect.state not in ("displacement", "velocity"):
        return ()
    is_odd = effect.parity == "odd"
    if effect.state == "displacement":
        return ODD_X_TERMS if is_odd else ONE_SIDED_TERMS
    return VELOCITY_TERMS if is_odd else ONE_WAY_TERMS


def own_state(effect: Effect) -> str:
    """ "displacement" or "velocity": the state that the misfit of a law is drawn against."""
    return "velocity" if effect.state == "velocity" else "displacement"


def max_misfit_rel(effect: Effect | None, otherwise: float) -> float:
    """Largest misfit of the right law. otherwise : of a law of no single state."""
    if effect is not None and effect.steps_at_rest:
        return THRESHOLDS.friction_misfit_max_rel
    return THRESHOLDS.misfit_max_rel if polynomial_terms(effect) else otherwise


def misfit_rel(
    before: WorkingPoint, after: WorkingPoint, effect: Effect | None, places: set[int],
    level: float = THRESHOLDS.misfit_max_p_value, least: float = 0.0,
) -> float | None:  # fmt: skip
    """rms force that smooth terms explain together with the law, over that without the law.

    0 if it is not significant, by level (p-value). None for effects of no single state. least : N^2 that the law
    explains, used where it is more: terms of one direction cannot do what a law of two directions does.
    """
    asked = polynomial_terms(effect)
    if not asked:
        return None
    own, *others = (_misfit_of_terms(before, after, places, *terms, level, least) for terms in asked)
    return max([own, *(rest for rest in others if rest > THRESHOLDS.other_terms_misfit_min_rel)])


def _misfit_of_terms(
    before: WorkingPoint, after: WorkingPoint, places: set[int], state: str, orders: tuple[int, ...], level: float,
    least: float,
) -> float:  # fmt: skip
    """Misfit by the terms of one state."""
    powers, nats, counts = zip(*(polynomial_power(after, i, state, orders) for i in sorted(places)), strict=True)
    if sum(counts) == 0 or chdtrc(sum(counts), 2 * max(sum(nats), 0.0)) > level:
        return 0.0
    rest = sum(max(power, 0.0) for power in powers)
    was = max(sum(polynomial_power(before, i, state, orders)[0] + _damped(before, i, state) for i in places), least)
    return float(np.sqrt(min(rest / was, 1.0))) if was > 0.0 else 0.0


def _damped(point: WorkingPoint, i: int, state: str) -> float:
    """N^2 of the laws of velocity that the model has at a place, less what is linear in it: where two of them make much
    of the damping, the second order of what they do together (self_energy.py) leaves a part of both, 0.5 % of the
    bearing force beside friction and a drag of 6 % each."""
    laws = damping_laws(point, {i}) if state == "v" else []
    if not laws:
        return 0.0
    force, v = np.sum([law_along_record(u, point.data, i, point.lin)[0] for u in laws], axis=0), point.data.v[i]
    return float(np.mean((force - (np.dot(force, v) / np.dot(v, v)) * v) ** 2))


def damping_laws(point: WorkingPoint, places: set[int]) -> list[LocatedLaw]:
    """The laws of velocity that a model has at places."""
    return [u for u in point.placed if places.intersection(u.at) and u.effect.state == "velocity"]


def smooth_gains_nats(point: WorkingPoint, effect: Effect | None, places: set[int]) -> dict[int, float]:
    """By place, nats that smooth terms gain together with an effect, less one for each term; where that is positive."""
    earned: dict[int, float] = {}
    for i in places:
        for state, orders in polynomial_terms(effect):
            _, nats, count = polynomial_power(point, i, state, orders)
            if nats > count:
                earned[i] = max(earned.get(i, 0.0), nats - count)
    return earned


def polynomial_power(point: WorkingPoint, i: int, state: str, orders: tuple[int, ...]) -> tuple[float, float, int]:
    """Mean square in N^2 explained by the polynomials of a state at place i, nats gained, number of terms."""
    data = point.data
    z = data.denoised_displacement(i) if state == "x" else data.v[i]
    rms = float(data.rms[0 if state == "x" else 1, i])
    u = (z / rms).astype(np.float32)
    here, which = point.fluctuations[i], 0 if state == "x" else 1
    memory: dict[int, dict[int, Complexes]] = {}
    if here is not None:
        for order, _, below in _hermite(
            (here.data.v[i] if which else here.data.denoised_displacement(i)) / rms, orders
        ):
            tangents = np.zeros((2, below.size), np.float32)
            tangents[which] = order * below / rms
            memory[order] = {i: own_response(-here.of(tangents), i, data)}

    def term(order: int, polynomial: Series, below: Series) -> Regressor | None:
        slopes = np.zeros((len(data.places),) * 2 + (2,))
        slopes[i, i, which] = order * float(np.mean(below, dtype=np.float64)) / rms
        if state == "x" and data.denoise_correction is not None:  # along the whole displacement: calm.as_seen
            polynomial = polynomial - slopes[i, i, 0] * data.denoise_correction[i]
        own = Regressor(f"smooth.{order}", "N", {i: polynomial}, slopes, memory=memory.get(order, {}))
        made = orthogonalised(own, point.spans, least=1e-3)
        return None if made is None else in_single_precision(made)

    terms = [t for t in map_threads(lambda one: term(*one), _hermite(u, orders)) if t is not None]
    if not terms:
        return 0.0, 0.0, 0
    problem = subproblem(point, (i,), point.whitening.whiten(terms))
    nats, fit = likelihood_gain(problem, steps=6)
    return extra_power(point, problem, fit, i)[0], nats, len(terms)


def _hermite(u: Series, orders: tuple[int, ...]) -> Iterator[tuple[int, Series, Series]]:
    """(k, He_k, He_(k-1)) of u for every k of orders, rising; the derivative of He_k is k He_(k-1).

    For k = 3 it is u^3 and u^2: beside a cubic law nothing is to be left of it, not even a slow part of u.
    """
    below, here = np.ones_like(u), u
    for k in range(1, max(orders) + 1):
        if k in orders:
            yield (k, here, below) if k != 3 else (k, u * u * u, u * u)
        below, here = here, u * here - k * below
