"""Parameters by the spectral path likelihood (docs/estimator.md), the default method of `rotorscope fit`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .balance import Balance, build
from .checks import check_record
from .columns import Columns
from .dressing import dressed, self_energies
from .estimate import Parameter
from .fit_result import Fit
from .gram import spectra, valid_blocks
from .likelihood import Likelihood, Local, Point, active, maximise
from .model import UNITS, Model
from .record import Bank, Record, gather, prepare, stretches
from .start import Start, linear_start

Floats = NDArray[np.float64]
OVERLAP = 1.0 / 6.0  # correlation of the energies of neighbouring blocks under the sine window
ROUNDS = 12  # of Gauss-Newton in the searched parameters


@dataclass(frozen=True, slots=True)
class Solution:
    """A fitted model: the record, the balance and its Gram matrices, the point and its uncertainty.

    covariance : (p + 2 P, p + 2 P) of beta, log S, noise (see likelihood.Local); inf where the data leave it free.
    """

    record: Record
    start: Start
    balance: Balance
    bank: Bank
    local: Local
    covariance: Floats
    converged: bool

    @property
    def point(self) -> Point:
        return self.local.point

    @property
    def values(self) -> dict[str, float]:
        """Free parameters by name; searched ones at their current value."""
        return {
            f.name: (f.start + b if f.searched else b)
            for f, b in zip(self.balance.free, self.local.point.beta.tolist(), strict=True)
        }


def analyse(model: Model, y: Floats, rate_hz: float, phase: Floats | None = None) -> Solution:
    """Fit a model to (n, channels) rows in SI. Raises DataError."""
    record = prepare(model, check_record(model, y, rate_hz), rate_hz, phase)
    return solve(record, linear_start(record), model)


def initial(balance: Balance, start: Start, values: Mapping[str, float]) -> Point:
    """The point that the linear start gives; effects at their given values."""
    at: dict[str, float] = {}
    for i, place in enumerate(balance.places):
        at |= {f"{place}.m": start.m[i], f"{place}.c": start.c[i], f"{place}.kL": start.kL[i]}
    beta = [0.0 if f.searched else values.get(f.name, at.get(f.name, f.start)) for f in balance.free]
    return Point(np.array(beta, float), start.S.copy(), start.noise.copy())


def solve(record: Record, start: Start, model: Model, values: Mapping[str, float] | None = None) -> Solution:
    """Fit a model to a prepared record from a linear start. values : known ones by name, before the model's own.

    The parameters that a law is linear in are solved for at held shapes first; then its shape is searched by
    Gauss-Newton on the derivative of its law, which joins the columns.
    """
    balance, bank, likelihood, local, converged, _ = maximum(record, start, model, values)
    covariance = sandwich(likelihood, local, bank)
    return Solution(record, start, balance, bank, local, covariance, converged)


Maximum = tuple[Balance, Bank, Likelihood, Local, bool, dict[str, float]]


def maximum(record: Record, start: Start, model: Model, values: Mapping[str, float] | None = None) -> Maximum:
    """Where the likelihood is highest, and the values of all parameters there, by name."""
    known = dict(values or {})
    balance = build(model, start.sizes, known, search=False)
    bank = gather(record, balance, start.widths, start.linear)
    likelihood, local, converged = dress(record, start, bank, initial(balance, start, known))
    known |= dict(zip(balance.names, local.point.beta.tolist(), strict=True))
    if len(build(model, start.sizes, known).free) > len(balance.free):
        return _search(record, start, model, local, known)
    return balance, bank, likelihood, local, converged, known


def dress(record: Record, start: Start, bank: Bank, point: Point, rounds: int = 2) -> tuple[Likelihood, Local, bool]:
    """The maximum with the responses of the laws dressed (dressing.py), which depends on the parameters a little."""
    evidence = bank.evidence(start.nodes)
    likelihood = Likelihood(evidence)
    local, converged = maximise(likelihood, point)
    balance, P = bank.balance, len(bank.balance.places)
    if not any(law.effect.kind == "force" for law in balance.laws):
        return likelihood, local, converged
    columns = Columns(balance, record.scales, start.widths, start.linear)
    B = balance.coefficients(local.point.beta)
    damping = np.array([B[i, P + i] + B[i] @ bank.tangents[:, 1] for i in range(P)])
    pairs = self_energies(record, columns, start.linear, np.maximum(damping, 0.1 * start.c), start.nodes.f_hz)
    for _ in range(rounds):
        B = balance.coefficients(local.point.beta)
        likelihood = Likelihood(replace(evidence, dressing=dressed(pairs, balance, B, start.nodes.f_hz)))
        local, converged = maximise(likelihood, local.point)
    return likelihood, local, converged


def _search(record: Record, start: Start, model: Model, local: Local, values: dict[str, float]) -> Maximum:
    best = local.nll
    settled = False
    for _ in range(ROUNDS):
        searching = build(model, start.sizes, values)
        bank = gather(record, searching, start.widths, start.linear)
        point = replace(initial(searching, start, values), S=local.point.S, noise=local.point.noise)
        likelihood, local, converged = dress(record, start, bank, point)
        if settled:
            break
        moved = 0.0
        for f, b in zip(searching.free, local.point.beta.tolist(), strict=True):
            if not f.searched:
                values[f.name] = b
                continue
            reach = 0.3 * max(abs(f.start), 1e-12)
            step = float(np.clip(b, -reach, reach))
            new = float(np.clip(f.start + step, f.low, f.high))
            moved = max(moved, abs(new - f.start) / max(abs(f.start), 1e-12))
            values[f.name] = new
        settled = moved < 1e-3 or abs(best - local.nll) < 1e-3
        best = local.nll
    return searching, bank, likelihood, local, converged and settled, values


def inverse(local: Local) -> Floats:
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


def sandwich(likelihood: Likelihood, local: Local, bank: Bank) -> Floats:
    """Covariance H^-1 J H^-1 with J from the scores of the folds of time; H^-1 alone if they are too few."""
    bread, used, folds = inverse(local), active(local.point), bank.blocks.size
    if folds < 3 * used.size:
        return bread
    g = likelihood.scores(local, bank.grams, bank.blocks)[:, used]
    m = float(bank.blocks.mean())
    lost = (1 + 2 * OVERLAP) / (1 + 2 * OVERLAP * (m - 1) / m)  # neighbouring folds share half a block
    J = (g.T @ g) * lost * folds / (folds - used.size)
    H = bread[np.ix_(used, used)]
    loose = ~np.isfinite(np.diag(H))
    H = np.where(np.isfinite(H), H, 0.0)
    covariance = H @ J @ H
    covariance[loose, loose] = np.inf
    bread[np.ix_(used, used)] = covariance
    return bread


def inferred_force(solution: Solution) -> Floats:
    """(places, n) N: the force that the model does not explain, in the band, NaN where nothing is known.

    Synthesised from the same blocks as the likelihood: window, bins of the band, window, overlap and add.
    """
    record, grid, balance = solution.record, solution.record.grid, solution.balance
    columns = Columns(balance, record.scales, solution.start.widths, solution.start.linear)
    B = balance.coefficients(solution.point.beta)
    out, weight = np.zeros((len(balance.places), record.motion.rows)), np.zeros(record.motion.rows)
    w = np.sin(np.pi * (np.arange(grid.size) + 0.5) / grid.size)
    for group in stretches(valid_blocks(record.motion.valid, grid), 8):
        at = int(group[0]) * grid.hop
        z, _ = columns.evaluate(record.stretch(at, int(group[-1]) * grid.hop + grid.size))
        Z = spectra(B @ z, group - group[0], grid) / grid.window[0] * w[0]
        full = np.zeros((*Z.shape[:2], grid.size // 2 + 1), complex)
        full[:, :, grid.bins] = Z
        series = np.fft.irfft(full, grid.size, axis=2)
        for b in range(group.size):
            rows = slice(at + b * grid.hop, at + b * grid.hop + grid.size)
            out[:, rows] += series[:, b] * w
            weight[rows] += w * w
    out[:, weight < 0.999] = np.nan
    return out


def report(solution: Solution) -> dict[str, Parameter]:
    """Every parameter by full name, judged."""
    return judged(solution.balance, solution.point, solution.covariance, solution.record.model)


def judged(balance: Balance, point: Point, covariance: Floats, model: Model) -> dict[str, Parameter]:
    """Parameters by full name: kL, c, m and S of each place, then those of the effects."""
    sd = np.sqrt(np.diag(covariance))
    free = {
        f.name: (f, (f.start + b if f.searched else b), sd[j])
        for j, (f, b) in enumerate(zip(balance.free, point.beta.tolist(), strict=True))
    }
    out: dict[str, Parameter] = {}
    for i, place in enumerate(balance.places):
        for key in ("kL", "c", "m"):
            name = f"{place}.{key}"
            setting = model.linear.get(place, {}).get(key)
            given = model.cap_mass(place) if key == "m" else None if setting is None else setting.value
            if name in free:
                out[name] = _judged(free[name][1], free[name][2], UNITS[key])
            elif given is not None:
                out[name] = Parameter(given, 0.0, UNITS[key], True, "given")
        out[f"{place}.S"] = _judged(point.S[i], point.S[i] * sd[point.beta.size + i], UNITS["S"])
    return out | {name: _judged(value, s, f.unit) for name, (f, value, s) in free.items() if name not in out}


def _judged(value: float, sd: float, unit: str) -> Parameter:
    judged = Parameter.judged(value, sd, unit)
    if judged.identifiable:
        return judged
    if not np.isfinite(sd):
        return Parameter(None, None, unit, False, "the data leave it free: nothing in the model sets its scale")
    return Parameter(None, None, unit, False, f"{value:.3g} +- {sd:.2g}: not told from zero by this record")


def fit(model: Model, y: Floats, rate_hz: float, phase: Floats | None = None) -> Fit:
    """Parameters with standard deviations from (n, channels) rows in SI. Raises DataError."""
    solution = analyse(model, y, rate_hz, phase)
    messages = [] if solution.converged else ["the likelihood was not brought to its maximum: values are provisional"]
    return Fit(
        report(solution), -solution.local.nll, int(solution.record.motion.valid.sum()), "spectral", tuple(messages)
    )
