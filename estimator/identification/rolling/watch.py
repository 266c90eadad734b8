"""The missing force while samples arrive: what candidate effects would explain of the residual force.

The regressors of the candidates are in the Gram matrices of a separate memory. At the maximum of the model, with
the amplitudes of the candidates at zero, one Newton step in all parameters gives the strength of each candidate, the
score its significance, and the Gram matrix the force that it would explain. No second fit is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects import CATALOGUE
from estimator.effects.places import places
from estimator.likelihood.path.path_fit import slope_and_curvature
from estimator.model.rig import EffectUse, Model
from estimator.results import MISSING_FORCE_KEY

from .follower import THE_FOLD, Follower, problem_of
from .thresholds import LIMITS

# one effect of each kind of state dependence, nonlinear parameters at their defaults
DEFAULT_CANDIDATES = tuple(name for name, e in CATALOGUE.items() if e.watched)
# have a frequency or a time scale to be searched
UNWATCHABLE_EFFECTS = tuple(name for name, e in CATALOGUE.items() if e.state == "time")


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


def candidates(model: Model, names: tuple[str, ...]) -> Model:
    """The model with the candidates alone that it does not have, at all places where they can act."""
    have = {use.name for use in model.effects}
    found = {name: places(CATALOGUE[name], model) for name in names if name not in have}
    return replace(model, effects=tuple(EffectUse(name, {p: {} for p in at}) for name, at in found.items() if at))


def missing_force(follower: Follower) -> dict[str, float] | None:
    """The `extra` of an estimate: the rms force that candidates would explain; None if it is not known.

    Per cent of the rms linear bearing force, by all of them together and by each that is certain.

    Parameters
    ----------
    follower : Follower
        The rolling fit.
    """
    from scipy.special import chdtri

    anchor, memory = follower.anchor, follower.watched
    own, every = anchor.own, len(anchor.names)
    if own == every or memory.n < LIMITS.min_watch_blocks:
        return None
    wide, jacobian, blocks = problem_of(anchor, memory, every)
    delta = np.concatenate([follower.delta, np.zeros(every - own)])
    g, _, H = slope_and_curvature(wide, jacobian, THE_FOLD, blocks, delta)
    scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300))
    H, g = H * np.multiply.outer(scale, scale), g * scale
    follow = -_pseudo_inverse(H[:own, :own]) @ H[:own, own:]  # change of own parameters per change of a candidate's
    H, g = H[own:, own:] + H[own:, :own] @ follow, g[own:] + follow.T @ g[:own]
    gram, redundancy = wide.G[:, 0, 1:, 1:], memory.n2 / memory.n
    linear = sum(
        (anchor.value_of[name] / anchor.scales[k]) ** 2 * float(gram[:, k, k].sum())
        for k, name in enumerate(anchor.names[:own]) if name.endswith(".kL")
    )  # fmt: skip

    def explained(members: NDArray[np.intp]) -> tuple[float, float]:
        """Chi-squared of these candidates, and their power over the linear force less twice what chance explains."""
        step = _pseudo_inverse(H[np.ix_(members, members)]) @ g[members]
        moved = np.zeros(every)
        moved[own + members], moved[:own] = step, follow[:, members] @ step
        moved *= scale
        chance = redundancy * members.size * float(np.mean(follower.excitation()))  # S / 2 in the mean, each
        power = float(np.einsum("a,iab,b->", moved, gram, moved)) - chance
        return float(step @ g[members]) / redundancy, max(power, 0.0) / max(linear, 1e-300)

    names = np.array([name.rsplit(".", 2)[1] for name in anchor.names[own:]])
    certain = {}
    for effect in dict.fromkeys(names.tolist()):
        members = np.flatnonzero(names == effect)
        statistic, share = explained(members)
        if statistic > chdtri(members.size, LIMITS.max_false_alarm_p):
            certain[effect] = 100.0 * float(np.sqrt(share))
    together = np.flatnonzero(np.isin(names, list(certain)))  # alone, many other candidates cost no power
    total = 100.0 * float(np.sqrt(max(explained(m)[1] for m in (np.arange(names.size), together) if m.size)))
    strongest = sorted(certain.items(), key=lambda item: -item[1])
    return {MISSING_FORCE_KEY: total} | {f"{MISSING_FORCE_KEY}_{name}": percent for name, percent in strongest}


def _pseudo_inverse(H: Array) -> Array:
    """Pseudo-inverse of a symmetric matrix with a diagonal of at most 1; zero in directions without information."""
    w, V = np.linalg.eigh(H)
    keep = w > LIMITS.min_eigenvalue_rel * max(float(w.max()), 1.0)
    return np.asarray((V[:, keep] / w[keep]) @ V[:, keep].T)
