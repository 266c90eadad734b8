"""Fit of a record that is longer than a working point holds: part by part, and the mean of the parts.

The parts have equal lengths and no block in common, so their estimates are independent, and their mean is that of the
whole record. Where the parts differ by more than chance, the standard deviation is that of their scatter.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.likelihood.fitting.fitted_values import Estimate, fitted_estimates
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.prepare import prepare

from .full_fit import FullFit
from .thresholds import LIMITS


def fit_of_all_parts(found: FullFit, y: Array, rate_hz: float) -> tuple[dict[str, Estimate], int]:
    """The mean of the fits of all parts of y (n, channels), SI, by full name of the parameter, and their rows.

    found : the fit of the first part.
    """
    rows = found.point.data.blocks * found.point.data.block
    parts, lengths = [fitted_estimates(found.point)], [rows]
    last = -(-len(y) // rows) if len(y) >= (1.0 + LIMITS.min_further_share) * rows else 1
    for part in range(1, last):
        try:
            data = prepare(found.model, y, rate_hz, part=part)
        except DataError:  # what remains is too short
            break
        point = fit_model(data, list(found.point.placed), found.point)
        parts.append(fitted_estimates(point))
        lengths.append(data.blocks * data.block)
    if len(parts) == 1:
        return parts[0], rows
    names = [name for name in parts[0] if all(name in own for own in parts)]
    weights = np.array(lengths) / sum(lengths)
    return {name: _mean([own[name] for own in parts], weights) for name in names}, sum(lengths)


def _mean(parts: list[Estimate], weights: Array) -> Estimate:
    """The weighted mean of independent estimates. weights : (parts,), their sum is 1."""
    from scipy.special import chdtri

    value, variance = np.array([p.value for p in parts]), np.array([p.sd for p in parts]) ** 2
    mean = float(weights @ value)
    expected, dof = float(weights**2 @ variance), len(parts) - 1
    scatter = float(np.sum((value - mean) ** 2 / variance))
    wider = scatter / dof if scatter > chdtri(dof, LIMITS.max_chance_p) else 1.0
    return Estimate(value=mean, sd=float(np.sqrt(expected * wider)), unit=parts[0].unit)
