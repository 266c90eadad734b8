"""What the model leaves over, while samples arrive: candidate effects beside a rolling fit.

The candidates' columns lie in the same Gram matrices as the model's own. At the fitted point, with the candidates'
amplitudes at zero, one Newton step in all parameters says how strong each candidate would be, the score how sure that
is, and the Gram matrix how much force it would explain. No second fit is needed.
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

# one of each kind of state dependence; shapes at their defaults
DEFAULT_CANDIDATES = (
    "cubic", "quintic", "quadratic", "clearance", "coulomb", "quadratic_damping", "displacement_damping",
    "cross_coupling", "anisotropy",
)  # fmt: skip
UNWATCHABLE_EFFECTS = ("line", "stiffness_drift")  # a frequency or a time scale would have to be searched first
MAX_FALSE_ALARM_P = 1e-6  # of a false alarm, per look and candidate
MAX_STEP_NATS = 10.0  # nats, as far as one Newton step is good


@dataclass(frozen=True, slots=True)
class WatchedForce:
    """Per cent of the rms linear bearing force. total : by all candidates together, at least by the certain ones
    together; sure : by those that are certain, strongest first."""

    total: float
    sure: dict[str, float]


def watchable_effects() -> tuple[str, ...]:
    """All effects of the catalogue whose force is an amplitude times a law of the state or the shaft angle."""
    return tuple(
        name
        for name, effect in CATALOGUE.items()
        if effect.kind == "force" and name not in UNWATCHABLE_EFFECTS and any(p.linear for p in effect.parameters)
    )


def with_candidates(model: Model, names: tuple[str, ...]) -> Model:
    """The model and every candidate that it does not have, wherever that can act."""
    from estimator.effects.places import places

    have = {use.name for use in model.effects}
    added = []
    for name in names:
        at = places(CATALOGUE[name], model) if name not in have else ()
        if at:
            added.append(EffectUse(name, {p: {} for p in at}))
    return replace(model, effects=model.effects + tuple(added))


def watched_force(wide: Likelihood, own: Balance, point: Point, redundancy: float) -> WatchedForce | None:
    """What the candidates of `wide`, of a balance that holds all of `own`, would explain near own's fitted point.

    The step to own's maximum on the same evidence is taken along. None if that is more than `CLOSE` nats away.
    redundancy : variance of a score over what the Hessian says, for weights that forget.
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
    follow = -inverse @ H[np.ix_(mine, ~mine)]  # what own's parameters do when a candidate's is moved
    H = H[np.ix_(~mine, ~mine)] + H[np.ix_(~mine, mine)] @ follow
    g = g[~mine] + follow.T @ g[mine]
    gram = evidence.gram.sum(axis=0)
    B = balance.coefficients(beta)
    linear = sum(float(B[i, 2 * P + i] ** 2 * gram[2 * P + i, 2 * P + i]) for i in range(P))

    def explained(members: NDArray[np.intp]) -> tuple[float, float]:
        """Chi-squared of these candidates and their share of force, less what chance explains."""
        step = -_pseudo_inverse(H[np.ix_(members, members)]) @ g[members]
        statistic = float(-step @ g[members]) / redundancy
        moved = np.zeros(p)
        moved[np.flatnonzero(~mine)[members]] = step
        moved[mine] = follow[:, members] @ step
        change = balance.coefficients(moved * scale) - balance.fixed
        chance = redundancy * members.size * float(np.mean(point.S)) * 2.0
        return statistic, max(float(np.sum((change @ gram) * change)) - chance, 0.0) / linear

    names = [f.name.rsplit(".", 2)[1] for f, m in zip(balance.free, mine, strict=True) if not m]
    sure = {}
    for effect in dict.fromkeys(names):
        members = np.flatnonzero([name == effect for name in names])
        statistic, share = explained(members)
        if statistic > chdtri(members.size, MAX_FALSE_ALARM_P):
            sure[effect] = 100.0 * float(np.sqrt(share))
    certain = np.flatnonzero([name in sure for name in names])  # chance does not eat these up, however many others
    total = 100.0 * float(np.sqrt(max(explained(m)[1] for m in (np.arange(len(names)), certain) if m.size)))
    return WatchedForce(total, dict(sorted(sure.items(), key=lambda item: -item[1])))


def _pseudo_inverse(H: Array) -> Array:
    """Of a symmetric matrix of unit diagonal, or smaller; zero along what the data do not tell."""
    w, V = np.linalg.eigh(H)
    keep = w > 1e-7 * max(float(w.max()), 1.0)
    return np.asarray((V[:, keep] / w[keep]) @ V[:, keep].T)
