"""The spectral path likelihood of a force balance, from Gram matrices alone.

Per block and frequency bin, in nats (constants left out):  F^H S^-1 F + log det S - log |det A|^2,  F = B Z,  A = B R,
where R is what each column answers to the acceleration of each place: 1 for a, 1 / (i w) for v, -1 / w^2 for x, the
mean tangents of a law times those; det A is summed along a line that leaves all modes to its left. S = diag(S_i) +
sensor noise seen through A. The factor 1/2 in front is the redundancy of the overlapping blocks. Where S varies within
a cell, the Jacobian is weighted as the quadratic form is, so that the score stays unbiased: E[F F^H] = S at every
frequency. Where the force is measured at every place the slopes have none of the determinant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.force_balance import Balance
from estimator.signals.band_limit import noise_shape
from estimator.signals.blocks import BlockLayout, FrequencyNodes

from .contour import contiguous_bands, phase_steps, shift_past_modes, slowest_modes
from .jacobian import (
    is_force_measured,
    levels,
    log_determinant,
    noise_bias,
    noise_responses,
    noise_slope,
    residual_over_noise,
)

AXIS_TO_LINE_NODES, AXIS_TO_LINE_WEIGHTS = 0.5 + 0.5 * leggauss(3)[0], 0.5 * leggauss(3)[1]  # Gauss-Legendre
MARGIN_NODES = 2.0  # spacings of the nodes from a mode to the line: the error of the slopes is exp(-4 pi)


def responses(balance: Balance, tangents: Array, f_hz: Array, shift: float = 0.0) -> Complexes:
    """(f, columns, places) R: each column per acceleration of each place. tangents (columns, 4): x, v, xo, vo.

    shift : rad/s, for R at s = shift + iw.
    """
    s: Complexes = np.asarray(shift + 2j * np.pi * f_hz, np.complex128)
    to = {"a": np.ones_like(s), "v": 1 / s, "x": 1 / s**2}
    if balance.common is not None:
        to["u"] = balance.common(f_hz if shift == 0.0 else s / (2j * np.pi)) * to["x"]
    R = np.zeros((s.size, len(balance.columns), len(balance.places)), complex)
    for k, column in enumerate(balance.columns):
        if column.kind in to:
            R[:, k, column.row] = to[column.kind]
        elif column.kind == "law":
            other = balance.other(column.row)
            R[:, k, column.row] += tangents[k, 0] * to["x"] + tangents[k, 1] * to["v"]
            if other >= 0:
                R[:, k, other] += tangents[k, 2] * to["x"] + tangents[k, 3] * to["v"]
    return R


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the data say about a balance. gram : (cells, k, k) sums; blocks : their weighted number; tangents (k, 4)."""

    balance: Balance
    grid: BlockLayout
    gram: Array
    blocks: float
    tangents: Array
    nodes: FrequencyNodes
    dressing: Complexes | None = None  # (nodes, columns) second-order correction
    colour: Array | None = None  # (nodes, places) shape of S


@dataclass(frozen=True, slots=True)
class Point:
    """A point in parameter space. beta (p,); S : (places,) N^2/Hz; noise : (places,) one-sided PSD of the sensor."""

    beta: Array
    S: Array
    noise: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Local:
    """The likelihood about a point. Order of theta: beta (p), log S (P), noise (P).

    nll : nats. gradient : (p + 2 P,). hessian : (p + 2 P, p + 2 P), of the negative log-likelihood.
    power : (cells, P) mean |F|^2 of each cell; floor : (cells, P, P) sensor-noise gain; spread : (cells, P) S of each.
    """

    point: Point
    nll: float
    gradient: Array
    hessian: Array
    power: Array
    floor: Array
    spread: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """R and A along s = shift + iw; total : sum of log |det A|^2 over the bins of a block, as it is on either side of
    the axis. ends : (ways, 2 stretches, columns, places) R between axis and line, at both ends of every
    stretch of bins; inverses : of A there."""

    shift: float
    R: Complexes
    A: Complexes
    total: float
    ends: Complexes
    inverses: Complexes


class Likelihood:
    """Evaluates one `Evidence`; what does not depend on the parameters is prepared once."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        balance, nodes = evidence.balance, evidence.nodes
        self.band, grid = contiguous_bands(evidence.grid.f_hz), evidence.grid
        outwards = 0.5 * grid.rate_hz / grid.size * np.array([-1.0, 1.0])  # a bin is as wide as the next is far
        self.ends = (np.array(self.band) / (2 * np.pi) + outwards).ravel()  # Hz
        self.R = self._responses(0.0, nodes.f_hz)
        self.known = is_force_measured(balance)
        self.seen = noise_responses(balance, self.R) if self.known else self.R  # how the sensors' noise enters a column
        entries = [(p, i, k, x) for p, f in enumerate(balance.free) for i, k, x in f.entries]
        self.row = np.array([e[1] for e in entries], dtype=np.intp)
        self.column = np.array([e[2] for e in entries], dtype=np.intp)
        self.T = np.zeros((len(balance.free), len(entries)))  # entries -> parameters
        for j, (p, _, _, x) in enumerate(entries):
            self.T[p, j] = x
        w = 2 * np.pi * nodes.f_hz
        flat, colour = np.ones((1, len(balance.places))), evidence.colour
        self.colour = (flat, flat) if colour is None else (colour, nodes.mean_by_cell(colour, evidence.grid.per_cell))
        self.noise_shape = noise_shape(balance.kinds, w).T  # (f, P)
        self._last: tuple[Array, tuple[Array, Complexes, Array, Array]] | None = None

    def _responses(self, shift: float, f_hz: Array) -> Complexes:
        """(f, columns, places) of the columns, dressed as the next node is, at s = shift + iw."""
        ev = self.evidence
        R = responses(ev.balance, ev.tangents, f_hz, shift)
        if ev.dressing is not None:
            iw, known = 2j * np.pi * f_hz, ev.nodes.f_hz
            dressing = ev.dressing[np.minimum(np.searchsorted(known, f_hz), known.size - 1)]
            if shift != 0.0:
                dressing = dressing * ((iw / (shift + iw)) ** 2)[:, None]
            for k, column in enumerate(ev.balance.columns):
                if column.kind == "law":
                    R[:, k, column.row] += dressing[:, k]
        return R

    def line(self, B: Array, A: Complexes) -> Line:
        """Where the determinant is summed: beside the axis that A is given along if a mode is too near to it."""
        nodes, mass, grid = self.evidence.nodes, np.diag(B), self.evidence.grid
        f, length, shift = nodes.f_hz, grid.size / grid.rate_hz, 0.0
        size = np.abs(np.linalg.det(A))
        if mass.min() > 0.0:
            modes = slowest_modes(A, mass, f, size, self.evidence.balance.disc, self.evidence.balance.places)
            after = np.clip(np.searchsorted(f, modes.imag / (2 * np.pi)), 1, f.size - 1)
            margin = MARGIN_NODES / length * np.maximum(nodes.weight[after - 1], nodes.weight[after])
            shift = shift_past_modes(modes, margin, self.band)
        if shift == 0.0:
            return Line(shift=0.0, R=self.R, A=A, total=self._sum(size), ends=self.R[:0], inverses=A[:0])
        R = self._responses(shift, f)
        ends = np.stack([self._responses(x * shift, self.ends) for x in AXIS_TO_LINE_NODES])
        beside, there = B @ R, B @ ends
        determinant = np.linalg.det(beside)
        turned = self._turned(determinant, np.linalg.det(there))
        total = self._sum(np.abs(determinant)) - length * shift * turned / np.pi
        return Line(shift=shift, R=R, A=beside, total=total, ends=ends, inverses=np.asarray(np.linalg.inv(there)))

    def _turned(self, determinant: Complexes, ends: Complexes) -> float:
        """rad by which det A turns along the stretches on the mean between axis and line: as often as on the line (f,),
        between its `ends` (ways, 2 stretches)."""
        f, turned = self.evidence.nodes.f_hz, 0.0
        for k, (low, high) in enumerate(self.ends.reshape(-1, 2)):
            here = float(phase_steps(determinant[(f >= low) & (f <= high)]).sum())
            turned += here + float(
                AXIS_TO_LINE_WEIGHTS @ np.angle(ends[:, 2 * k + 1] / ends[:, 2 * k] * np.exp(-1j * here))
            )
        return turned

    def _sum(self, size: Array) -> float:
        """Of log |det A|^2 over the bins of a block. size : (f,) |det A|."""
        return 2 * float(np.log(size) @ self.evidence.nodes.weight)

    def force_power(self, B: Array, gram: Array | None = None) -> Array:
        """(cells, P, P) sums of F F^H."""
        return np.asarray(B @ (self.evidence.gram if gram is None else gram) @ B.T)

    def noise_gain(self, A: Complexes) -> Array:
        """(cells, P, P) mean |A_ij|^2 of each cell: the force PSD at i per sensor noise at j."""
        gain = np.abs(A) ** 2 * self.noise_shape[:, None, :]
        return self.evidence.nodes.mean_by_cell(gain, self.evidence.grid.per_cell)

    def damping(self, beta: Array) -> Array:
        """(places,) N s/m, mean damping of each place, that of the effects included.

        Only its sign matters here: the likelihood has a mirror image, as good as itself, at negative damping.
        """
        B, P = self.evidence.balance.coefficients(beta), len(self.evidence.balance.places)
        return np.array([B[i, P + i] + B[i] @ self.evidence.tangents[:, 1] for i in range(P)])

    def power(self, beta: Array) -> tuple[Array, Array]:
        """(cells, P) mean |F|^2 and (cells, P, P) gain of the sensor noise, both over the shape of S."""
        _, _, gain, total = self._about(beta)
        shape, count = self.colour[1], self.evidence.blocks * self.evidence.grid.per_cell
        power = np.einsum("cii->ci", total) / count[:, None]
        return power / shape, gain / shape[:, :, None]

    def _about(self, beta: Array) -> tuple[Array, Complexes, Array, Array]:
        """B, A, gain of the sensor noise and sums of F F^H: of the last point, which is asked for twice, remembered."""
        last = self._last  # once: it may be asked from two threads
        if last is None or not np.array_equal(last[0], beta):
            B = self.evidence.balance.coefficients(beta)
            A = B @ self.R
            self._last = last = beta.copy(), (B, A, self.noise_gain(A), self.force_power(B))
        return last[1]

    def at(self, point: Point) -> Local:
        """Value, gradient and Hessian."""
        ev, grid = self.evidence, self.evidence.grid
        B, A, gain, total = self._about(point.beta)
        spread = point.S * self.colour[1] + gain @ point.noise  # (cells, P)
        count = ev.blocks * grid.per_cell
        diagonal = np.einsum("cii->ci", total)
        line = self.line(B, A)
        logs = float(np.sum(count[:, None] * np.log(spread)) - ev.blocks * line.total)
        nll = 0.5 * (float(np.sum(diagonal / spread)) + logs)

        gram_rows = np.einsum("ci,ckl->ikl", 1 / spread, ev.gram)  # weighted Gram of each row
        quad_g, quad_h = self._quadratic(B, gram_rows)
        jac_g, jac_h = self._jacobian(A, line, point, spread)
        # the spread of a row depends on its entries through the noise that is seen through A
        s, n, shift = spread[:, self.row], count[:, None], self._spread_slope(A, point)  # (cells, E)
        excess = (n - diagonal[:, self.row] / s) / s
        slope = np.einsum("cek,ek->ce", ev.gram[:, self.column], B[self.row])  # half of d F_rr / d entry, per cell
        same = self.row[:, None] == self.row
        mixed = np.einsum("ce,cf->ef", slope / s**2, shift)
        noise_h = np.where(same, 0.5 * np.einsum("ce,cf->ef", n * shift / s**2, shift) - mixed - mixed.T, 0.0)
        g_beta = self.T @ (quad_g - ev.blocks * jac_g + 0.5 * np.einsum("ce,ce->e", excess, shift))
        h_beta = self.T @ (quad_h - ev.blocks * jac_h + noise_h) @ self.T.T
        # nuisances: log S and noise of each place
        P, p = point.S.size, point.beta.size
        D = self._nuisance(point, gain)  # (cells, 2P, P): d spread / d psi
        g_psi = 0.5 * np.einsum("cqi,ci->q", D, (count[:, None] - diagonal / spread) / spread)
        h_psi = 0.5 * np.einsum("cqi,cri,ci->qr", D, D, count[:, None] / spread**2)
        cross = np.einsum("ce,cqe->eq", (0.5 * n * shift - slope) / s**2, D[:, :, self.row])
        hessian = np.zeros((p + 2 * P, p + 2 * P))
        hessian[:p, :p], hessian[p:, p:], hessian[:p, p:] = h_beta, h_psi, self.T @ cross
        hessian[p:, :p] = hessian[:p, p:].T
        return Local(
            point=point, nll=nll, gradient=np.concatenate([g_beta, g_psi]), hessian=hessian,
            power=diagonal / count[:, None], floor=gain, spread=spread,
        )  # fmt: skip

    def _spread_slope(self, A: Complexes, point: Point) -> Array:
        """(cells, E) derivative of the spread of its row by each entry."""
        nodes, per_cell = self.evidence.nodes, self.evidence.grid.per_cell
        psd = self.noise_shape * point.noise
        return noise_slope(A, self.seen, self.row, self.column, psd, nodes.weight, nodes.cell, per_cell)

    def better(self, trial: Local, here: Local) -> bool:
        """Whether a step has not made the model less likely."""
        if self.known:
            count: Array = np.asarray(self.evidence.blocks * self.evidence.grid.per_cell, dtype=np.float64)
            spread = here.point.S * self.colour[1] + trial.floor @ here.point.noise  # noise as it was before the step
            return residual_over_noise(trial.power, spread, count) <= residual_over_noise(
                here.power, here.spread, count
            ) * (1.0 + 1e-9)
        return trial.nll <= here.nll + 1e-9 * abs(here.nll)

    def _nuisance(self, point: Point, gain: Array) -> Array:
        P = point.S.size
        D = np.zeros((gain.shape[0], 2 * P, P))
        D[:, range(P), range(P)] = point.S * self.colour[1]
        D[:, P:] = gain.transpose(0, 2, 1)
        return D

    def _quadratic(self, B: Array, rows: Array, hessian: bool = True) -> tuple[Array, Array]:
        """Gradient (E,) and Hessian (E, E) of 1/2 sum F^H S^-1 F by entry."""
        r, k = self.row, self.column
        g = np.einsum("el,el->e", rows[r, k], B[r])
        if not hessian:
            return g, np.empty((0, 0))
        return g, np.where(r[:, None] == r, rows[r[:, None], k[:, None], k], 0.0)

    def _jacobian(
        self, A: Complexes, line: Line, point: Point, spread: Array, hessian: bool = True
    ) -> tuple[Array, Array]:
        """Gradient (E,) and Hessian (E, E) of 1/2 sum over bins of log |det A|^2 along the line."""
        nodes = self.evidence.nodes
        if self.known:
            psd = self.noise_shape * point.noise * nodes.weight[:, None]
            share = psd[:, None, :] / spread[nodes.cell][:, :, None]
            return noise_bias(A, self.seen, self.row, self.column, share)
        inside = point.S * self.colour[0] + (np.abs(A) ** 2 * self.noise_shape[:, None, :]) @ point.noise
        kappa = inside / spread[nodes.cell] * nodes.weight[:, None]  # 1 per bin where S is flat within the cell
        g, h = log_determinant(line.A, line.R, self.row, self.column, kappa, hessian)
        if line.shift == 0.0:
            return g, h
        slope, bend = self._ways(line)
        return g - slope, h - bend if hessian else h

    def _ways(self, line: Line) -> tuple[Array, Array]:
        """(E,) gradient and (E, E) Hessian of half of what the ways between axis and line add at the ends of all
        stretches."""
        passed = np.einsum("hseq,hsqf->hsef", line.ends[:, :, self.column], line.inverses[..., self.row])
        grid, sign = self.evidence.grid, np.tile([-1.0, 1.0], len(self.band))
        length = grid.size / grid.rate_hz * line.shift / (2 * np.pi)
        slope = np.einsum("h,s,hsee->e", AXIS_TO_LINE_WEIGHTS, sign, passed).imag
        bend = -np.einsum("h,s,hsef,hsfe->ef", AXIS_TO_LINE_WEIGHTS, sign, passed, passed).imag
        return length * slope, length * bend


def active(point: Point) -> NDArray[np.intp]:
    """Indices into theta of what is estimated: sensor noise at its bound, zero, is not."""
    p, P = point.beta.size, point.S.size
    return np.array([*range(p + P), *(p + P + i for i in range(P) if point.noise[i] > 0)], dtype=np.intp)


def _step(local: Local, damping: float) -> tuple[Array, float]:
    """Newton step in beta with S and noise profiled out, and its decrement in nats.

    Along flat or negative curvature it goes downhill by what the absolute curvature allows.
    """
    H, p = local.hessian, local.point.beta.size
    rest = active(local.point)[p:]
    profile = H[:p, :p] - H[:p, rest] @ np.linalg.solve(H[np.ix_(rest, rest)], H[rest, :p])
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(H)[:p]), 1e-300))
    w, V = np.linalg.eigh(profile * scale * scale[:, None])
    g = V.T @ (local.gradient[:p] * scale)
    g = np.where(np.abs(w) > 1e-8, g, 0.0)  # what the data leave free stays where it is
    curvature = np.maximum(np.abs(w), 1e-8) + damping
    return -scale * (V @ (g / curvature)), float(np.sum(g**2 / curvature))


def maximise(likelihood: Likelihood, start: Point, iterations: int = 40, tolerance: float = 1e-4) -> tuple[Local, bool]:
    """Damped Newton steps until the likelihood rises no more. Returns the maximum and whether it was reached.

    tolerance : of the Newton decrement in nats: 1e-4 is a hundredth of a standard deviation.
    """
    count: Array = np.asarray(0.5 * likelihood.evidence.blocks * likelihood.evidence.grid.per_cell, dtype=np.float64)

    def profiled(beta: Array, point: Point) -> Local:
        S, noise = levels(*likelihood.power(beta), count, point.S, point.noise)
        return likelihood.at(Point(beta, S, noise))

    here, damping = profiled(start.beta, start), 0.0
    for _ in range(iterations):
        step, decrement = _step(here, damping)
        trial = profiled(here.point.beta + step, here.point)
        stable = likelihood.damping(trial.point.beta).min() > 0 or likelihood.damping(here.point.beta).min() <= 0
        if stable and np.isfinite(trial.nll) and likelihood.better(trial, here):
            here, damping, tried = trial, damping / 8 if damping > 1e-4 else 0.0, damping
            if decrement < tolerance and tried == 0.0:
                return here, True
        elif damping > 1e6:
            return here, False
        else:
            damping = max(4 * damping, 1e-3)
    return here, False


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
