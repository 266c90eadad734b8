"""What the model leaves over, while samples arrive: candidate effects beside a rolling fit.

The candidates' columns lie in the same Gram matrices as the model's own. At the fitted point, with the candidates'
amplitudes at zero, one Newton step in all parameters says how strong each candidate would be, the score how sure that
is, and the Gram matrix how much force it would explain. No second fit is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .balance import Balance
from .effects import CATALOGUE
from .likelihood import Evidence, Likelihood, Point
from .model import EffectUse, Model

Floats = NDArray[np.float64]
# one of each kind of state dependence; shapes at their defaults
CANDIDATES = (
    "cubic", "quintic", "quadratic", "clearance", "coulomb", "quadratic_damping", "displacement_damping",
    "cross_coupling", "anisotropy",
)  # fmt: skip
SURE = 1e-6  # of a false alarm, per look and candidate


@dataclass(frozen=True, slots=True)
class Missing:
    """Per cent of the rms linear bearing force. total : by all candidates together; sure : by those that are certain,
    strongest first."""

    total: float
    sure: dict[str, float]


def with_candidates(model: Model, names: tuple[str, ...]) -> Model:
    """The model and every candidate that it does not have, wherever that can act."""
    from .effects.places import places

    have = {use.name for use in model.effects}
    added = []
    for name in names:
        at = places(CATALOGUE[name], model) if name not in have else ()
        if at:
            added.append(EffectUse(name, {p: {} for p in at}))
    return replace(model, effects=model.effects + tuple(added))


def look(wide: Evidence, own: Balance, point: Point, redundancy: float) -> Missing:
    """What the candidates of `wide`, a balance that holds all of `own`, would explain at own's fitted point.

    redundancy : variance of a score over what the Hessian says, for weights that forget.
    """
    from scipy.stats import chi2

    balance, p = wide.balance, len(wide.balance.free)
    at = dict(zip(own.names, point.beta.tolist(), strict=True))
    beta = np.array([at.get(f.name, 0.0) for f in balance.free])
    local = Likelihood(wide).at(Point(beta, point.S, point.noise))
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(local.hessian)[:p]), 1e-300))
    H, g = local.hessian[:p, :p] * scale * scale[:, None], local.gradient[:p] * scale
    mine = np.array([f.name in at for f in balance.free])
    P = len(balance.places)
    B = balance.coefficients(beta)
    linear = np.array([B[i, 2 * P + i] ** 2 * wide.gram[:, 2 * P + i, 2 * P + i].sum() for i in range(P)]).sum()

    def explained(candidates: NDArray[np.bool_]) -> tuple[float, float]:
        """Chi-squared of the candidates over their number, and their share of force, less what chance explains."""
        used = np.flatnonzero(mine | candidates)
        w, V = np.linalg.eigh(H[np.ix_(used, used)])
        keep = w > 1e-7 * w.max()
        step = -(V[:, keep] / w[keep]) @ (V[:, keep].T @ np.where(mine, 0.0, g)[used])
        statistic = float(-step @ np.where(mine, 0.0, g)[used]) / redundancy
        moved = np.zeros(p)
        moved[used] = step * scale[used]
        change = balance.coefficients(moved) - balance.fixed
        force = np.einsum("ik,ckl,il->ci", change, wide.gram, change)
        chance = redundancy * candidates.sum() * float(np.mean(point.S)) * 2.0
        return statistic, max(float(force.sum()) - chance, 0.0) / linear

    names = {f.name: f.name.rsplit(".", 2)[1] for f, m in zip(balance.free, mine, strict=True) if not m}
    sure = {}
    for effect in dict.fromkeys(names.values()):
        members = np.array([names.get(f.name) == effect for f in balance.free])
        statistic, share = explained(members)
        if statistic > chi2.isf(SURE, int(members.sum())):
            sure[effect] = 100.0 * float(np.sqrt(share))
    total = 100.0 * float(np.sqrt(explained(~mine)[1]))
    return Missing(total, dict(sorted(sure.items(), key=lambda item: -item[1])))
