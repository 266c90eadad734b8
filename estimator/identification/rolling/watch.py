"""The missing force while samples arrive: what candidate effects would explain of the residual force.

The regressors of the candidates are in the Gram matrices of the model. At the fitted point, with the amplitudes of the
candidates at zero, one Newton step in all parameters gives the strength of each candidate, the score its significance,
and the Gram matrix the force that it would explain. No second fit is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects import CATALOGUE
from estimator.likelihood.motion.force_balance import Balance
from estimator.likelihood.path.gram_likelihood import Likelihood, Point
from estimator.model.rig import EffectUse, Model

# one effect of each kind of state dependence, nonlinear parameters at their defaults
DEFAULT_CANDIDATES = tuple(name for name, e in CATALOGUE.items() if e.watched)
# have a frequency or a time scale to be searched
UNWATCHABLE_EFFECTS = tuple(name for name, e in CATALOGUE.items() if e.state == "time")
MAX_FALSE_ALARM_P = 1e-6  # per look and candidate
MAX_STEP_NATS = 10.0  # up to which one Newton step is good enough


@dataclass(frozen=True, slots=True)
class WatchedForce:
    """Force that candidate effects would explain, per cent of the rms linear bearing force.

    total : by all candidates together, and at least by the certain ones together.
    certain : effect -> per cent, for those that are certain, strongest first.
    """

    total: float
    certain: dict[str, float]


def watchable_effects() -> tuple[str, ...]:
    """Names of the catalogue effects that a rolling estimate can look for.

    Returns
    -------
    tuple of str
        Effects whose force is an amplitude times a law of the states or of the shaft angle.
    """
    return tuple(
        name
        for name, effect in CATALOGUE.items()
        if effect.kind == "force" and name not in UNWATCHABLE_EFFECTS and any(p.linear for p in effect.parameters)
    )


def with_candidates(model: Model, names: tuple[str, ...]) -> Model:
    """The model with every candidate that it does not have, at all places where that can act."""
    from estimator.effects.places import places

    have = {use.name for use in model.effects}
    added = []
    for name in names:
        at = places(CATALOGUE[name], model) if name not in have else ()
        if at:
            added.append(EffectUse(name, {p: {} for p in at}))
    return replace(model, effects=model.effects + tuple(added))


def watched_force(wide: Likelihood, own: Balance, point: Point, redundancy: float) -> WatchedForce | None:
    """The force that candidates would explain; None if the maximum of the model is over MAX_STEP_NATS away.

    wide : likelihood of the model with the candidates. own : balance of the model without them. point : its fitted
    point; the step to its maximum on the evidence of `wide` is included.
    redundancy : variance of a score over that of the Hessian, for weights that decay.
    """
    from scipy.special import chdtri

    evidence = wide.evidence
    balance, p, P = evidence.balance, len(evidence.balance.free), point.S.size
    at = dict(zip(own.names, point.beta.tolist(), strict=True))
    beta = np.array([at.get(f.name, 0.0) for f in balance.free])
    local = wide.at(Point(beta, point.S, point.noise))
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(local.hessian)[:p]), 1e-300))
    H, g = local.hessian[:p, :p] * scale * scale[:, None], local.gradient[:p] * scale
    mine = np.array([f.name in at for f in balance.free])
    inverse = _pseudo_inverse(H[np.ix_(mine, mine)])
    if g[mine] @ inverse @ g[mine] > MAX_STEP_NATS:
        return None
    follow = -inverse @ H[np.ix_(mine, ~mine)]  # change of own parameters per change of a candidate's
    H = H[np.ix_(~mine, ~mine)] + H[np.ix_(~mine, mine)] @ follow
    g = g[~mine] + follow.T @ g[mine]
    gram = evidence.gram.sum(axis=0)
    B = balance.coefficients(beta)
    linear = sum(float(B[i, 2 * P + i] ** 2 * gram[2 * P + i, 2 * P + i]) for i in range(P))

    def explained(members: NDArray[np.intp]) -> tuple[float, float]:
        """Chi-squared of these candidates, and their power over the linear force less what chance explains."""
        step = -_pseudo_inverse(H[np.ix_(members, members)]) @ g[members]
        statistic = float(-step @ g[members]) / redundancy
        moved = np.zeros(p)
        moved[np.flatnonzero(~mine)[members]] = step
        moved[mine] = follow[:, members] @ step
        change = balance.coefficients(moved * scale) - balance.fixed
        chance = redundancy * members.size * float(np.mean(point.S)) * 2.0
        return statistic, max(float(np.sum((change @ gram) * change)) - chance, 0.0) / linear

    names = [f.name.rsplit(".", 2)[1] for f, m in zip(balance.free, mine, strict=True) if not m]
    certain = {}
    for effect in dict.fromkeys(names):
        members = np.flatnonzero([name == effect for name in names])
        statistic, share = explained(members)
        if statistic > chdtri(members.size, MAX_FALSE_ALARM_P):
            certain[effect] = 100.0 * float(np.sqrt(share))
    together = np.flatnonzero([name in certain for name in names])  # alone, many other candidates cost no power
    total = 100.0 * float(np.sqrt(max(explained(m)[1] for m in (np.arange(len(names)), together) if m.size)))
    return WatchedForce(total, dict(sorted(certain.items(), key=lambda item: -item[1])))


def _pseudo_inverse(H: Array) -> Array:
    """Pseudo-inverse of a symmetric matrix with a diagonal of at most 1; zero along what the data leave free."""
    w, V = np.linalg.eigh(H)
    keep = w > 1e-7 * max(float(w.max()), 1.0)
    return np.asarray((V[:, keep] / w[keep]) @ V[:, keep].T)
