"""Fit of a record that is longer than a working point holds: part by part, and the mean of the parts.

The parts have equal lengths and no block in common, so their estimates are independent, and their mean is that of the
whole record. Where the parts differ by more than chance, the standard deviation is that of their scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.likelihood.fitting.fitted_values import Estimate, fitted_estimates
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.prepare import prepare

from .full_fit import FullFit
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOfParts:
    """The mean of the fits of all parts of a record.

    estimates : by full name of the parameter. samples : rows of all parts.
    """

    estimates: dict[str, Estimate]
    samples: int


def fit_of_all_parts(found: FullFit, y: Array, rate_hz: float) -> FitOfParts | None:
    """The fit of all parts of y (n, channels), SI. found : the fit of the first part. None where that is all."""
    rows = found.point.data.blocks * found.point.data.block
    if len(y) < (1.0 + LIMITS.min_further_share) * rows:
        return None
    parts, lengths = [fitted_estimates(found.point)], [rows]
    for part in count(1):
        if part * rows >= len(y):
            break
        try:
            data = prepare(found.model, y, rate_hz, part=part)
        except DataError:  # what remains is too short
            break
        point = fit_model(data, list(found.point.placed), found.point)
        parts.append(fitted_estimates(point))
        lengths.append(data.blocks * data.block)
    if len(parts) == 1:
        return None
    names = [name for name in parts[0] if all(name in own for own in parts)]
    weights = np.array(lengths) / sum(lengths)
    return FitOfParts(
        estimates={name: _mean([own[name] for own in parts], weights) for name in names}, samples=sum(lengths)
    )


def _mean(parts: list[Estimate], weights: Array) -> Estimate:
    """The weighted mean of independent estimates. weights : (parts,), their sum is 1."""
    from scipy.special import chdtri

    value, variance = np.array([p.value for p in parts]), np.array([p.sd for p in parts]) ** 2
    mean = float(weights @ value)
    expected, dof = float(weights**2 @ variance), len(parts) - 1
    scatter = float(np.sum((value - mean) ** 2 / variance))
    wider = scatter / dof if scatter > chdtri(dof, LIMITS.max_chance_p) else 1.0
    return Estimate(value=mean, sd=float(np.sqrt(expected * wider)), unit=parts[0].unit)
