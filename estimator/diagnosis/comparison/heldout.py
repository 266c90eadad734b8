"""Held-out likelihood of a working point and of a flexible black box, in nats per sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError, ModelError
from estimator.identification.residual.group_fit import ridge_information
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.fitting.fitted_values import fitted_model
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.motion_record import TIME_FOLDS
from estimator.likelihood.path.subproblem import coupled_places, heldout_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.signals.channel_response import corrected_record

from .free_run import simulation_rmse
from .thresholds import LIMITS

FITTED_SHARE = 0.7  # of a record with a measured force; the rest is simulated


def heldout_rmse(model: Model, y: Array, rate_hz: float) -> dict[str, float]:
    """Channel -> rms in SI of measured minus free-run motion on the last part of the record, fitted to the first part.

    Empty unless a force is measured at every place.
    """
    forced = {c.place for c in model.channels if c.kind == "force"}
    if not model.places or not forced.issuperset(model.places):
        return {}
    from estimator.identification.batch.full_fit import fit_all_effects

    try:
        found = fit_all_effects(model, y[: int(FITTED_SHARE * len(y))], rate_hz)
        filled = _known(fitted_model(found.model, found.point))
        damping = np.einsum("iik->ik", found.point.mean_tangent)[:, 1]
        decay_s = float(np.max(2 * found.point.data.mass / damping))
        del found, damping  # the record cut into blocks is large
        return simulation_rmse(filled, corrected_record(filled, y, rate_hz), rate_hz, decay_s, FITTED_SHARE)
    except (ModelError, DataError):
        return {}


def _known(model: Model) -> Model:
    """The model without the effects for which a value is not known."""
    uses = (
        replace(
            u, parameters={p: own for p, own in u.parameters.items() if all(s.value is not None for s in own.values())}
        )
        for u in model.effects
    )
    return replace(model, effects=tuple(u for u in uses if u.parameters))


def heldout_gain_nats(before: WorkingPoint, after: WorkingPoint) -> float:
    """Held-out nats that the fit `after` gains over the fit `before` of the same record, on the bins of `after`."""
    return (heldout_nll(judged_like(before, after)) - heldout_nll(after)) * after.data.blocks * after.data.block


def judged_like(point: WorkingPoint, other: WorkingPoint) -> WorkingPoint:
    """The model of `point` fitted to the same share of the same bins as `other`.

    A law of the shaft leaves bins out, and a model may leave noise at an edge of the band. The record of `other` with
    the same bins may have a sensor fault undone, so it is not taken.
    """
    if other.data.is_judged_like(point.data):
        return point
    data = replace(point.data, leaking_edges_hz=other.data.leaking_edges_hz)
    if not data.is_judged_like(other.data):
        data = other.data
    return fit_model(data, list(point.placed), start=point)


def heldout_nll(point: WorkingPoint) -> float:
    """Nats per sample: every time fold judged by the parameters of the others. Lower is better.

    Of the one-sided PSD of the accelerations in the band, over all places; one sample is one row of the record.

    Parameters
    ----------
    point : WorkingPoint
        The model fitted to the record.
    """
    total = 0.0
    left = set(range(len(point.data.places)))
    while left:
        part = coupled_places(point, (min(left),))
        left -= set(part)
        problem = subproblem(point, part)
        for f in range(TIME_FOLDS):
            rest = np.array([k for k in range(TIME_FOLDS) if k != f])
            total -= problem.likelihood(problem.fit(rest), np.array([f]))
    total -= (
        point.data.blocks * np.log(point.data.undone_noise_gain).sum()
    )  # of what was measured, not of what was undone
    for i, _ in point.data.shared:  # each of the two was given the other: what they share has counted twice
        total -= point.gram.n[i].sum() * np.log(point.fit.S[i] / point.S[i])
    return float(total) / (point.data.blocks * point.data.block)


def reference_nll(point: WorkingPoint, found: MissingForce, nll: float) -> float:
    """Held-out nats per sample of a black box: smooth regressors (ridge), and a force spectrum free in 40 cells.

    Its parts count only where they help on held-out data, so it is never above `nll`.
    """
    samples = point.data.blocks * point.data.block
    gained = 0.0
    for r in found.residuals:
        if r.found:
            gained += max(0.0, float(heldout_gain(r.problem, ridge_information(r.problem)).sum()))
    for i in range(len(point.data.places)):
        gained += max(0.0, _free_spectrum_gain(point, i))
    return nll - gained / samples


def _free_spectrum_gain(point: WorkingPoint, i: int) -> float:
    """Nats on held-out folds of a force spectrum that is free in cells of about equal width in log frequency."""
    data = point.data
    Z = point.spectra[i].reshape(data.blocks, -1, 2)
    power = np.einsum("bkc,bkc->bk", Z, Z).astype(np.float64) / point.S[i]
    bins = power.shape[1]
    edges = np.unique(np.round(np.geomspace(8, bins, LIMITS.spectrum_cells + 1)).astype(np.int64))
    first = np.concatenate([[0], edges[:-1]])
    sums = np.add.reduceat(power, first, axis=1)
    by_fold = np.stack([sums[data.fold == f].sum(axis=0) for f in range(TIME_FOLDS)])
    n = np.outer(data.fold_blocks, np.diff(np.append(first, bins)))
    total = 0.0
    for here, count, rest, others in zip(by_fold, n, by_fold.sum(axis=0) - by_fold, n.sum(axis=0) - n, strict=True):
        trained, flat = rest / others, rest.sum() / others.sum()
        total += float(np.sum(here / flat + count * np.log(flat) - here / trained - count * np.log(trained)))
    return total
