"""The maximum of the likelihood of a model: Newton in linear parameters, Gauss-Newton in nonlinear ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import Balance, build_balance
from estimator.likelihood.motion.stream_record import Bank, Record, gather
from estimator.likelihood.path.excitation_level import relative_level
from estimator.likelihood.path.gram_likelihood import Likelihood, Local, Point, active, evidence_of, maximise
from estimator.likelihood.path.measured_force import is_force_measured
from estimator.likelihood.response.second_order import (
    TangentNoise,
    mean_tangents,
    second_order_change,
    self_energies,
    tangent_noise,
)
from estimator.model.rig import Model
from estimator.signals.band_limit import passband

from .linear_start import LinearStart

SHAPE_SEARCH_S = 12.0  # of the record that shapes are sought on before all of it is used
ROUGH_ROUNDS, FINE_ROUNDS = 8, 5
MAX_CORRECTION_ROUNDS = 10
MAX_SETTLED_STEP_SD = 0.1  # of a standard deviation: a step that no longer matters
MAX_SHAPE_STEP_REL = 0.3  # largest step in a shape, of its value


@dataclass(frozen=True, slots=True)
class Maximum:
    """balance, bank, likelihood: at the shapes found; local: the likelihood there; values: all parameters by name."""

    balance: Balance
    bank: Bank
    likelihood: Likelihood
    local: Local
    values: dict[str, float]
    converged: bool


def initial(balance: Balance, start: LinearStart, values: Mapping[str, float]) -> Point:
    """The point that the linear start gives; effects at their given values."""
    at: dict[str, float] = {}
    for i, place in enumerate(balance.places):
        own = balance.fixed[i, i :: len(balance.places)]  # the shaft's part of what the start has
        at |= {f"{place}.m": start.m[i], f"{place}.c": start.c[i] - own[1], f"{place}.kL": start.kL[i] - own[2]}
    beta = [0.0 if f.searched else values.get(f.name, at.get(f.name, f.start)) for f in balance.free]
    return Point(np.array(beta, float), start.S.copy(), start.noise.copy())


def maximum(record: Record, start: LinearStart, model: Model, values: Mapping[str, float] | None = None) -> Maximum:
    """Fit a model to a prepared record from a linear start. values : known ones by name, before the model's own.

    The parameters that a law is linear in are solved for at held shapes first. Then its shape is searched by
    Gauss-Newton on the derivative of its law, which joins the columns: on the first seconds until the steps are small
    compared with their standard deviation, then on the whole record.
    """
    known = dict(values or {})
    held = build_balance(model, start.sizes, known, search=False)
    searching = len(build_balance(model, start.sizes, known).free) > len(held.free)
    bank = gather(record, held, start.widths, start.linear, seconds=SHAPE_SEARCH_S if searching else np.inf)
    first = initial(held, start, known)
    if values is None:
        _refuse_unstable(held, bank, first)
    bank, local, converged = highest(bank, start, first)
    if not searching:
        tangents = tangents_of(record, start, bank, local)
        bank = without_flutter(record, bank, local, tangents)
        likelihood, local, converged = dress(bank, start, local, tangents, converged)
        known |= dict(zip(held.names, local.point.beta.tolist(), strict=True))
        return Maximum(balance=held, bank=bank, likelihood=likelihood, local=local, values=known, converged=converged)
    known |= dict(zip(held.names, local.point.beta.tolist(), strict=True))
    tangents = None
    for rounds, seconds in ((ROUGH_ROUNDS, SHAPE_SEARCH_S), (FINE_ROUNDS, np.inf)):
        whole = not np.isfinite(seconds)
        for _ in range(rounds):
            balance = build_balance(model, start.sizes, known)
            bank = gather(record, balance, start.widths, start.linear, seconds=seconds)
            point = replace(initial(balance, start, known), S=local.point.S, noise=local.point.noise)
            bank, local, converged = highest(bank, start, point)
            if whole:
                tangents = tangents_of(record, start, bank, local) if tangents is None else tangents
                bank = without_flutter(record, bank, local, tangents)
                likelihood, local, converged = dress(bank, start, local, tangents, converged)
            moved = _move(balance, local, known, last=whole)
            if moved < MAX_SETTLED_STEP_SD:
                break
    return Maximum(
        balance=balance,
        bank=bank,
        likelihood=likelihood,
        local=local,
        values=known,
        converged=converged and moved < MAX_SETTLED_STEP_SD,
    )


def highest(bank: Bank, start: LinearStart, point: Point) -> tuple[Bank, Local, bool]:
    """The maximum at held shapes and tangents, and the bank with the level of the unknown force."""
    local, converged = maximise(Likelihood(evidence_of(bank, start.nodes)), point)
    if not bank.balance.laws or is_force_measured(bank.balance):
        return bank, local, converged
    B = bank.balance.coefficients(local.point.beta)
    power = np.einsum("ik,fckl,il,ci->if", B, bank.grams, B, 1 / local.spread, optimize=True) / bank.blocks
    level = relative_level(power, bank.start, float(bank.blocks.mean() * bank.grid.bins.size / 2))
    if level is None:
        return bank, local, converged
    bank = bank.levelled(level)
    return bank, *maximise(Likelihood(evidence_of(bank, start.nodes)), local.point)


def _refuse_unstable(balance: Balance, bank: Bank, point: Point) -> None:
    """Raises DataError if the given values of the effects make a place's mean stiffness or damping negative."""
    D = mean_tangents(balance, balance.coefficients(point.beta), bank.tangents)
    for i, place in enumerate(balance.places):
        for value, word in zip(D[i, i], ("stiffness", "damping"), strict=True):
            if value <= 0:
                own = (place, place.split(".")[0])
                given = [
                    f"{f.name} = {b:g}"
                    for f, b in zip(balance.free, point.beta.tolist(), strict=True)
                    if b and f.name.count(".") > 2 and f.name.rsplit(".", 2)[0] in own
                ]
                raise DataError(
                    f"the model is unstable: {', '.join(given) or 'its effects'} gives {place} a mean {word} of "
                    f"{value:.3g} along the measured motion; give a smaller value or none"
                )


def _move(balance: Balance, local: Local, values: dict[str, float], last: bool) -> float:
    """Take the step into `values`; the largest one in a shape, in standard deviations (of the whole parameter).

    last : the step is not taken once it no longer matters, so that `values` are where the columns are.
    """
    sd = np.sqrt(np.diag(inverse(local)))
    new, moved = dict(values), 0.0
    for f, b, s in zip(balance.free, local.point.beta.tolist(), sd, strict=False):
        if not f.searched:
            new[f.name] = b
            continue
        reach = MAX_SHAPE_STEP_REL * max(abs(f.start), 1e-12)
        to = float(np.clip(f.start + np.clip(b, -reach, reach), f.low, f.high))
        # a shape that the data do not tell at all need not settle
        moved = max(moved, abs(to - f.start) / s if np.isfinite(s) and s < abs(f.start) else 0.0)
        new[f.name] = to
    if moved >= MAX_SETTLED_STEP_SD or not last:
        values |= new
    else:
        values |= {f.name: new[f.name] for f in balance.free if not f.searched}
    return moved


@dataclass(frozen=True, slots=True)
class Tangents:
    """Second-order terms of the laws. pairs : (nodes, columns, columns) self-energies. flutter : None without noise."""

    pairs: NDArray[np.complex128]
    flutter: TangentNoise | None


def tangents_of(record: Record, start: LinearStart, bank: Bank, local: Local) -> Tangents | None:
    """What the fluctuating tangents of the laws do at a point; None if no law has any, or the force is known."""
    if is_force_measured(bank.balance):  # no determinant, and a path without the sensors' noise
        return None
    columns = record.columns(bank.balance, start.widths, start.linear)
    B = bank.balance.coefficients(local.point.beta)
    pairs = self_energies(record, columns, B, bank.tangents, start.nodes.f_hz)
    return (
        None if pairs is None else Tangents(pairs, tangent_noise(record, columns) if local.point.noise.any() else None)
    )


def without_flutter(record: Record, bank: Bank, local: Local, tangents: Tangents | None) -> Bank:
    """The bank without the tangent noise that displacement sensors add to the laws and their squares."""
    if tangents is None or tangents.flutter is None:
        return bank
    count = bank.blocks[:, None, None, None] * bank.grid.per_cell[:, None, None]
    still = without_noise(tangents.flutter, local.point.noise, record.rate_hz, record.model.band)
    grams, slope = still(bank.grams, count, bank.tangents)
    return replace(bank, grams=grams, tangents=slope)


def without_noise(
    flutter: TangentNoise, noise: Array, rate_hz: float, band: tuple[float, float]
) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """A function (gram, count, mean) that removes tangent noise from Gram matrices (..., k, k) of `count` bins and from
    mean tangents (k, 4).

    noise : (places,) one-sided PSD of the sensors.
    """
    P, k = flutter.bend.shape
    f = np.linspace(0.0, 0.5 * rate_hz, 2000)
    variance = noise * np.trapezoid(passband(f, rate_hz, band) ** 2, f)
    straight = np.eye(k)
    straight[:, 2 * P : 3 * P] -= (variance[:, None] * flutter.bend).T
    per_bin = np.einsum("i,ikl->kl", noise, flutter.covariance)

    def still(gram: Array, count: Array, mean: Array) -> tuple[Array, Array]:
        slope = mean.copy()
        slope[:, 0] -= variance @ flutter.bend
        return straight @ (gram - count * per_bin) @ straight.T, slope

    return still


def dress(
    bank: Bank, start: LinearStart, local: Local, tangents: Tangents | None, converged: bool
) -> tuple[Likelihood, Local, bool]:
    """The maximum with the second-order correction of the mean responses, which depends a little on the parameters.

    Where the nonlinearity is so strong that the second order does not settle, the mean tangents are kept.
    """
    evidence = evidence_of(bank, start.nodes)
    bare = Likelihood(evidence), local, converged
    if tangents is None:
        return bare
    pairs = tangents.pairs
    if tangents.flutter is not None:
        bare = bare[0], *maximise(bare[0], local.point)
        local = bare[1]
    sd = np.sqrt(np.diag(inverse(local))[: local.point.beta.size])
    moves = []
    likelihood = bare[0]
    for _ in range(MAX_CORRECTION_ROUNDS):
        B = bank.balance.coefficients(local.point.beta)
        likelihood = Likelihood(
            replace(evidence, dressing=second_order_change(pairs, bank.balance, B, start.nodes.f_hz))
        )
        before = local.point.beta
        local, converged = maximise(likelihood, local.point)
        moves.append(float(np.nanmax(np.abs(local.point.beta - before) / sd)))
        if moves[-1] < MAX_SETTLED_STEP_SD:
            break
    if moves[-1] >= max(0.5 * moves[0], MAX_SETTLED_STEP_SD):
        return bare
    return likelihood, likelihood.with_slope_of_dressing(local, pairs), converged


def inverse(local: Local) -> Array:
    """(p + 2 P, p + 2 P) inverse of the Hessian: inf for what the data leave free, nan for what is not estimated."""
    used = active(local.point)
    H = local.hessian[np.ix_(used, used)]
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    w, V = np.linalg.eigh(H * scale * scale[:, None])
    free = w < 1e-7 * w.max()
    out = np.full(local.hessian.shape, np.nan)
    covariance = scale[:, None] * (V[:, ~free] / w[~free]) @ V[:, ~free].T * scale
    loose = (V[:, free] ** 2).sum(axis=1) > 1e-4
    covariance[loose, loose] = np.inf
    out[np.ix_(used, used)] = covariance
    return out
