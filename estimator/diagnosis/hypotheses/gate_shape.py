"""Whether a named law has the right shape: smooth terms of its own state, of rising order, beside it.

Hat functions see any curve but pay for twenty parameters, and narrow ones of the velocity turn faster than the band can
follow. A law that is nearly right leaves a smooth rest that a few Hermite polynomials of its state catch.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Complexes, Series
from estimator.identification.residual.group_fit import extra_power
from estimator.likelihood.motion.located_law import LocatedLaw, law_along_record, own_response
from estimator.likelihood.path.subproblem import likelihood_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.response.regressor_set import Regressor, in_single_precision, orthogonalised
from estimator.parallel import map_threads

ODD = (3, 5, 7, 9)
EVEN = ("v", (2, 4, 6))  # no law is: what is passes for a drag, or for a law of x that is not odd either
X, V, ONE_SIDED = (("x", ODD),), (("v", ODD[:3]), EVEN), (("x", tuple(range(2, 10))), EVEN)
STATES = {  # the law's own first; terms even in x beside an odd law of x belong to another one
    "cubic": X, "quintic": X, "clearance": X, "hertz": X, "quadratic": ONE_SIDED, "stop": ONE_SIDED,
    "coulomb": V, "quadratic_damping": V,
}  # fmt: skip
LEVEL = 1e-3
MOST = 0.1  # rms left beside the right law
# the same of friction: a film, micro-slip or a simulation makes its step within some velocity, of which 0.1 to 0.2 rms
# leave as much
ROUNDED = 0.35
OTHER = 0.5  # the same of terms not its own: less may be another law's, still to be found or not yet settled


def state_of(effect: str) -> str:
    """The state that the law's own misfit is drawn against."""
    return {"x": "displacement", "v": "velocity"}[STATES[effect][0][0] if effect in STATES else "x"]


def most_left(effect: str, otherwise: float) -> float:
    """What `left` may be beside the right law."""
    if effect == "coulomb":
        return ROUNDED
    return MOST if effect in STATES else otherwise


def left(
    before: WorkingPoint, after: WorkingPoint, effect: str, places: set[int], level: float = LEVEL, least: float = 0.0
) -> float | None:  # fmt: skip
    """rms of the force that smooth terms still explain beside the law, over what they explained without it.

    0 if it is not significant, by level (p-value). None for effects of no single state. least : N^2 of what the law
    explains, where that is more: one that joins two directions does what no terms of one of them do.
    """
    if effect not in STATES:
        return None
    own, *others = (_left(before, after, places, *terms, level, least) for terms in STATES[effect])
    return max([own, *(rest for rest in others if rest > OTHER)])


def _left(
    before: WorkingPoint, after: WorkingPoint, places: set[int], state: str, orders: tuple[int, ...], level: float,
    least: float,
) -> float:  # fmt: skip
    """The same of the terms of one state."""
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
    laws = damping(point, {i}) if state == "v" else []
    if not laws:
        return 0.0
    force, v = np.sum([law_along_record(u, point.data, i, point.lin)[0] for u in laws], axis=0), point.data.v[i]
    return float(np.mean((force - (np.dot(force, v) / np.dot(v, v)) * v) ** 2))


def damping(point: WorkingPoint, places: set[int]) -> list[LocatedLaw]:
    """The laws of velocity that a model has at places."""
    return [u for u in point.placed if places.intersection(u.at) and STATES.get(u.effect.name, X) is V]


def worth(point: WorkingPoint, effect: str, places: set[int]) -> dict[int, float]:
    """Nats, less one for each term, that the smooth terms of a state earn beside an effect at each place where they
    do."""
    earned: dict[int, float] = {}
    for i in places:
        for state, orders in STATES.get(effect, ()):
            _, nats, count = polynomial_power(point, i, state, orders)
            if nats > count:
                earned[i] = max(earned.get(i, 0.0), nats - count)
    return earned


def polynomial_power(point: WorkingPoint, i: int, state: str, orders: tuple[int, ...]) -> tuple[float, float, int]:
    """Mean square in N^2 explained by the polynomials of a state at place i, nats gained, number of terms."""
    data = point.data
    z = data.calmed(i) if state == "x" else data.v[i]
    rms = float(data.rms[0 if state == "x" else 1, i])
    u = (z / rms).astype(np.float32)
    here, which = point.fluctuations[i], 0 if state == "x" else 1
    memory: dict[int, dict[int, Complexes]] = {}
    if here is not None:
        for order, _, below in _hermite((here.data.v[i] if which else here.data.calmed(i)) / rms, orders):
            tangents = np.zeros((2, below.size), np.float32)
            tangents[which] = order * below / rms
            memory[order] = {i: own_response(-here.of(tangents), i, data)}

    def term(order: int, polynomial: Series, below: Series) -> Regressor | None:
        slopes = np.zeros((len(data.places),) * 2 + (2,))
        slopes[i, i, which] = order * float(np.mean(below, dtype=np.float64)) / rms
        if state == "x" and data.calm is not None:  # along the whole displacement: calm.as_seen
            polynomial = polynomial - slopes[i, i, 0] * data.calm[i]
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
