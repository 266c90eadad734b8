"""Starting values for parameters that no linear fit can find: a gap, a corner, an exponent typed as a guess.

Newton's method finds them from near by. What a rig file says may be far off, so each effect with such parameters is
first tried on a coarse grid about its values, on a part of the record, beside the model without it.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from . import screen
from .model import Model
from .model_uses import placed_of
from .motion_blocks import MotionBlocks, part_of
from .placed import Placed
from .side_by_side import each
from .working_point import WorkingPoint, fit_model

Array = NDArray[np.float64]
SECONDS = 6.0
FACTORS = {1: np.geomspace(0.1, 10.0, 13), 2: np.geomspace(0.1, 10.0, 5)}
COARSE = np.array([0.3, 1.0, 3.0])


def fit_record(model: Model, data: MotionBlocks) -> WorkingPoint:
    """The model fitted to a record, whatever values its rig file starts from."""
    uses = placed_of(model, data)
    loose = [k for k, use in enumerate(uses) if _searched(use)]
    if not loose:
        return fit_model(data, uses)
    part = part_of(data, SECONDS)
    for k in loose:
        others = [u for j, u in enumerate(uses) if j != k and (j not in loose or j < k)]
        uses[k] = _started(fit_model(part, others), uses[k])
    return fit_model(data, uses)


def _searched(use: Placed) -> list[int]:
    """Numbers of the free parameters that are no amplitudes, if there are amplitudes to judge them by."""
    if not any(q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)):
        return []
    return [k for k, q in enumerate(use.effect.parameters) if use.free[k] and not q.linear and use.p[k] != 0.0]


def _started(point: WorkingPoint, use: Placed) -> Placed:
    """The use at the best of a grid about its values, amplitudes as they fit there."""
    loose = _searched(use)
    factors = FACTORS.get(len(loose), COARSE)
    linear = np.array([q.linear and free for q, free in zip(use.effect.parameters, use.free, strict=True)])
    at_one = np.where(linear, 1.0, use.p)
    candidates = []
    for scale in product(factors, repeat=len(loose)):
        p = at_one.copy()
        p[loose] *= scale
        candidates.append(use.with_values(p))
    tried = each(lambda candidate: screen.assess(point, candidate), candidates)
    best = max(range(len(tried)), key=lambda k: -np.inf if (got := tried[k]) is None else got[0])
    got = tried[best]
    if got is None or got[0] <= 0.0:
        return use
    _, problem, fit = got
    p = candidates[best].p.copy()
    for k in np.flatnonzero(linear):
        p[k] = fit.value(use.name(int(k)))[0] if use.name(int(k)) in problem.extra else 0.0
    return use.with_values(p)
