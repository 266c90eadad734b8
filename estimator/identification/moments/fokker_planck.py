"""Stiffness from the Fokker-Planck equation: least squares on the logarithm of the histogram, eq. (36) of the paper.

Between neighbouring cells of the displacement histogram ln(p'/p) = -(V' - V)/T, so with T/m3 = c sigma_v1 sigma_v2,
c = 1/sqrt(mu1 mu2), a = ks/m3, D a step (chain shaft):

    [S ln(p'/p), x1 D1, G1 D1, x2 D2, G2 D2] . (c, w1^2, w1^2 lambda1, w2^2, w2^2 lambda2) = -(a/2)(x1 - x2)(D1 - D2)

As printed, with steps along the diagonal of the grid, D1 = D2 makes the right side zero in every row: only the null
solution. Two forms have another one:
  midpoint  steps along the axes, x D and G D replaced by the exact differences of x^2/2 and x^4/4. The noisy logarithm
            is a regressor, which attenuates c.
  response  the logarithm on the left, weights 1/(1/n + 1/n'), cells under 30 counts dropped, the mean of the density
            over a cell (not its value at the centre) on the right. The default.

A cap that no spring of the shaft joins to another has the one-dimensional form of the companion paper on rigid rotors
(J. Sound Vib. 187(2), 1995): w^2 and w^2 lambda from its own histogram. Standard deviations by block bootstrap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.model.rig import Model
from estimator.results import Fit, Message, Parameter

from .planes import Plane
from .score_matching import density_fit
from .thresholds import LIMITS

Form = Literal["midpoint", "response"]
CELL_WIDTH_RMS = {1: 0.15, 2: 0.3}  # of the displacement, for one and two caps


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram:
    """Histogram of the displacements of one direction, by block of the record, on a uniform grid in row-major order.

    shape : cells along the axis of each cap.
    widths : (caps,) cell widths, m.
    centres : (cells, caps) cell centres, m.
    counts : (blocks, cells) counts.
    squares : (blocks, caps) sums of squared velocities, (m/s)^2.
    rows : (blocks,) numbers of rows.
    """

    shape: tuple[int, ...]
    widths: Array
    centres: Array
    counts: Array
    squares: Array
    rows: Array


def histogram(x: Array, v: Array) -> Histogram:
    """Histogram of displacements x (n, caps), m, over +- 4.5 rms; v : (n, caps) velocities, m/s."""
    (n, caps), blocks = x.shape, LIMITS.bootstrap_blocks
    sigma = np.std(x, axis=0)
    width = CELL_WIDTH_RMS[caps] * float(sigma.min())
    half = np.minimum(np.ceil(LIMITS.grid_half_width_rms * sigma / width).astype(np.int64), 60)
    widths = np.full(caps, width)  # one width for both axes, as in the paper
    at = np.floor(x / widths).astype(np.int64) + half
    inside = ((at >= 0) & (at < 2 * half)).all(axis=1)
    shape = tuple(int(2 * h) for h in half)
    flat = np.ravel_multi_index(tuple(np.where(inside, a, 0) for a in at.T), shape)
    cells = int(np.prod(shape))
    block = np.minimum(np.arange(n) * blocks // n, blocks - 1)
    counts = np.bincount((block * cells + flat)[inside], minlength=blocks * cells).reshape(blocks, cells)
    axes = [(np.arange(2 * h) - h + 0.5) * width for h in half]
    centres: Array = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, caps)
    squares: Array = np.stack([np.bincount(block, v[:, i] ** 2, blocks) for i in range(caps)], axis=1)
    rows = np.bincount(block, minlength=blocks).astype(float)
    return Histogram(
        shape=shape, widths=widths, centres=centres, counts=counts.astype(float), squares=squares, rows=rows
    )


def potentials(plane: Plane, x: Array) -> tuple[Array, Array]:
    """Potentials at x (..., caps), m: of every coefficient (..., p), cap by cap, and of a unit shaft spring (...)."""
    terms = [x[..., i] ** (q + 1) / (q + 1) for i, cap in enumerate(plane.caps) for q in cap.powers]
    shaft = 0.5 * plane.a * np.sum(x**2, axis=-1)
    if x.shape[-1] == 2:
        shaft = shaft + plane.b * x[..., 0] * x[..., 1]
    return np.stack(terms, axis=-1), shaft


def neighbouring_cells(shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat indices (from, to) of neighbouring cells along each axis."""
    index = np.arange(int(np.prod(shape))).reshape(shape)
    pairs = []
    for axis in range(len(shape)):
        moved = np.moveaxis(index, axis, 0)
        pairs.append((moved[:-1].ravel(), moved[1:].ravel()))
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def _weighted_least_squares(design: Array, response: Array, weight: Array) -> Array:
    """(p,) coefficients. design : (r, p). response, weight : (r,)."""
    root = np.sqrt(weight)
    return np.asarray(np.linalg.lstsq(design * root[:, None], response * root, rcond=None)[0])


def _log_cell_mean(plane: Plane, grid: Histogram, theta: Array, shaft: float) -> Array:
    """(cells,) logarithm of the mean density of a cell over that at its centre, by 3-point Gauss quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(3)  # of [-1, 1], weights to 2
    caps = len(plane.caps)
    offsets = np.stack(np.meshgrid(*(nodes,) * caps, indexing="ij"), axis=-1).reshape(-1, caps) * grid.widths / 2.0
    weight = np.prod(np.stack(np.meshgrid(*(weights,) * caps, indexing="ij"), axis=-1).reshape(-1, caps) / 2.0, axis=1)
    at_centre = potentials(plane, grid.centres)
    base = at_centre[0] @ theta + shaft * at_centre[1]
    total = np.zeros(len(grid.centres))
    for offset, w in zip(offsets, weight, strict=True):
        phi, spring = potentials(plane, grid.centres + offset)
        total += w * np.exp(np.clip(base - phi @ theta - shaft * spring, -50.0, 50.0))
    return np.log(total)


def _expected_counts(plane: Plane, grid: Histogram, theta: Array, shaft: float, total: float) -> tuple[Array, Array]:
    """(cells,) expected counts of a fitted density, and the logarithm of its cell mean over its value at the centre."""
    mean = _log_cell_mean(plane, grid, theta, shaft)
    phi, spring = potentials(plane, grid.centres)
    log_p = mean - phi @ theta - shaft * spring
    p = np.exp(np.minimum(log_p - np.median(log_p), 300.0))
    return np.asarray(total * p / p.sum()), mean


def _density_slopes(
    plane: Plane, grid: Histogram, counts: Array, temperature: float | None, form: Form
) -> tuple[Array, float]:
    """(p,) coefficients over temperature, and that of the shaft, from counts (cells,).

    temperature : J; the coefficient of the shaft is then ks/T. None: unknown, it is fitted.
    """
    here, there = neighbouring_cells(grid.shape)
    sigma = grid.widths * np.array(grid.shape) / (2.0 * LIMITS.grid_half_width_rms)
    scale = np.array([sigma[i] ** (q + 1) for i, cap in enumerate(plane.caps) for q in cap.powers])
    phi, springs = potentials(plane, grid.centres)
    terms, spring = (phi[there] - phi[here]) / scale, springs[there] - springs[here]  # over every step along an axis
    unit = scale[0]  # of the shaft term
    free = temperature is None and plane.scale_from_shaft
    known = 0.0 if free or temperature is None else plane.ks / temperature
    logs = np.log(counts + 0.5)  # of a Poisson count: ln(mean) with an error of second order only
    drop = logs[here] - logs[there]  # = (V' - V)/T

    def kept(expected: Array) -> NDArray[np.bool_]:
        keep = np.minimum(expected[here], expected[there]) >= LIMITS.min_counts
        keep &= (counts[here] > 0) & (counts[there] > 0)
        if keep.sum() < 4 * (terms.shape[1] + 1):
            raise DataError(
                f"direction {plane.direction}: only {keep.sum()} pairs of histogram cells hold "
                f"{LIMITS.min_counts} counts: record longer"
            )
        return keep

    keep = kept(counts)
    one = np.ones(int(keep.sum()))
    if form == "midpoint" and free:  # as printed: unknowns (T/ks, k/ks), the noisy logarithm among the regressors
        solution = _weighted_least_squares(np.column_stack([-drop, terms])[keep], -spring[keep] / unit, one)
        return solution[1:] / solution[0] / scale, float(1.0 / (solution[0] * unit))
    if form == "midpoint":
        return _weighted_least_squares(terms[keep], (drop - known * spring)[keep], one) / scale, known
    design = np.column_stack([terms, spring / unit]) if free else terms
    expected, mean = counts, np.zeros(len(counts))
    for _ in range(4):  # cells chosen by their counts at first, then by the fitted density: no selection
        keep = kept(expected)
        with np.errstate(divide="ignore"):
            weight = 1.0 / (1.0 / expected[here] + 1.0 / expected[there])
        response = drop - mean[here] + mean[there] - known * spring
        solution = _weighted_least_squares(design[keep], response[keep], weight[keep])
        theta = solution[: len(scale)] / scale
        shaft = float(solution[-1] / unit) if free else known
        expected, mean = _expected_counts(plane, grid, theta, shaft, counts.sum())
    return theta, shaft


def _parameter_values(plane: Plane, grid: Histogram, weights: Array, form: Form) -> Array:
    """Parameters in the order of `plane.names()`. weights : (blocks,) of the blocks of the record."""
    square = weights @ grid.squares / (weights @ grid.rows)
    temperature = None
    if plane.masses_known:
        temperature = float(np.mean([cap.mass * s for cap, s in zip(plane.caps, square, strict=True) if cap.mass]))
    theta, shaft = _density_slopes(plane, grid, weights @ grid.counts, temperature, form)
    joint = plane.ks / shaft if plane.scale_from_shaft and temperature is None else None
    out: list[float] = []
    at = 0
    for cap, s in zip(plane.caps, square, strict=True):
        slope = theta[at : at + len(cap.powers)]
        at += len(cap.powers)
        scale = cap.mass * s if cap.mass is not None and joint is None else joint
        if scale is not None and plane.solvable(cap):
            out += list(slope * scale)
        if 3 in cap.powers:
            out.append(float(slope[cap.powers.index(3)] / slope[0]))
        if cap.mass is None and joint is not None:
            out.append(joint / s)
    return np.array(out)


def fokker_planck_parameters(
    plane: Plane, x: Array, v: Array, form: Form = "response", replicates: int = 200, seed: int = 0
) -> tuple[dict[str, float], Array]:
    """Parameters of one direction by eq. (36), with their covariance by block bootstrap.

    Parameters
    ----------
    plane : Plane
        The caps and the shaft of the direction.
    x : (n, caps) float64
        Band-limited displacement, m, without NaN.
    v : (n, caps) float64
        Band-limited velocity, m/s, without NaN.
    form : {"response", "midpoint"}
        Form of the equation, see the text of the module.
    replicates : int
        Number of bootstrap samples.
    seed : int
        Seed of the bootstrap.

    Returns
    -------
    values : dict of float
        Parameters by full name, SI.
    covariance : (p, p) float64
        In the order of ``plane.names()``.

    Raises
    ------
    DataError
        Too few cells have enough counts.

    References
    ----------
    Tiwari and Vyas, J. Sound Vib. 203 (1997) 389, eq. (36).
    """
    if len(plane.caps) == 2 and not plane.scale_from_shaft:
        return _uncoupled_parameters(plane, x, v, form, replicates, seed)
    grid, blocks = histogram(x, v), LIMITS.bootstrap_blocks
    values = _parameter_values(plane, grid, np.ones(blocks), form)
    rng = np.random.default_rng(seed)
    draws = []
    for _ in range(replicates):
        weights = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks)).astype(float)
        draws.append(_parameter_values(plane, grid, weights, form))
    covariance = np.atleast_2d(np.cov(np.array(draws).T)) if replicates > 1 else np.full((len(values),) * 2, np.nan)
    if form == "midpoint" and plane.scale_from_shaft and not plane.masses_known:
        # the scatter of this form does not show its bias: the response form shows whether the shaft gives a scale
        honest, spread = fokker_planck_parameters(plane, x, v, "response", replicates, seed)
        if any(np.sqrt(s) > 0.5 * abs(q) for q, s in zip(honest.values(), np.diag(spread), strict=True)):
            covariance = np.full_like(covariance, np.inf)
    return dict(zip(plane.names(), values.tolist(), strict=True)), covariance


def _uncoupled_parameters(
    plane: Plane, x: Array, v: Array, form: Form, replicates: int, seed: int
) -> tuple[dict[str, float], Array]:
    """Parameters and covariance of caps that the shaft does not couple, each from its own histogram."""
    values: dict[str, float] = {}
    parts = []
    for i, cap in enumerate(plane.caps):
        alone = replace(plane, caps=(cap,), b=0.0)
        found, cov = fokker_planck_parameters(alone, x[:, i : i + 1], v[:, i : i + 1], form, replicates, seed)
        values |= found
        parts.append(cov)
    return values, np.asarray(block_diag(*parts))


def fit_fokker_planck(model: Model, y: Array, rate_hz: float, form: Form = "response", replicates: int = 200) -> Fit:
    """Parameters by eq. (36) from a record y (n, channels), SI, NaN where a sample is missing.

    Raises DataError if too few rows are valid, a channel is constant or no resonance is in the
    band.
    """

    def parameters(plane: Plane, x: Array, v: Array) -> tuple[dict[str, Parameter], list[Message]]:
        values, covariance = fokker_planck_parameters(plane, x, v, form, replicates)
        sds = np.sqrt(np.diag(covariance))
        found = plane.judged({n: (values[n], float(sd)) for n, sd in zip(values, sds, strict=True)})
        return found, _assumption_messages(plane)

    return density_fit(model, y, rate_hz, "fokker-planck", parameters)


def _assumption_messages(plane: Plane) -> list[Message]:
    if plane.scale_from_shaft and not plane.masses_known:
        text = (
            f"direction {plane.direction}: the masses assume equal noise-to-damping ratios at the caps and no damping "
            "at the disc; 1 % of undriven disc damping can flip their sign, and the record cannot show it"
        )
        return [Message("masses_by_assumption", text)]
    return []
