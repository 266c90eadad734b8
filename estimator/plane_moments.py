"""Linear and cubic stiffness from moments of displacement and velocity: score matching, without bins or histogram.

The stationary density p(x) = c exp(-V/T) obeys, for V = sum_k theta_k phi_k (Hyvarinen 2005; physics.md section 3),

    E[grad phi . grad phi'] theta/T = E[laplacian phi]                                                    (density form)

and T = m E[v^2]. This is the paper's eq. (36) with infinitely fine cells. The same row follows from stationarity alone,
0 = d/dt E[m v h(x)] = m E[h'(x) v^2] - E[h(x) V'(x)], because damping (odd in v) and white force do not correlate with
a function of x at the same instant:

    E[f f'] k = m E[f'(x) v^2],   f = dV/dk                                                              (velocity form)

The two agree if x and v are independent, as exp(-H/T) says. On a record, the velocity form does not suffer from the
slow wander of the amplitude, needs neither equal temperatures at the two caps nor a Gaussian velocity, and has a
twentieth of the scatter (docs/paper.md); on independent samples of the density the density form is the better.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .band_edge import BandEdge
from .estimate import Parameter
from .moments import BlockMoments, propagate
from .planes import Plane

Array = NDArray[np.float64]
Form = Literal["velocity", "density"]


class PlaneMoments:
    """Moment recursion of one direction, and the stiffness that follows from it.

    The row of the series, per cap with powers q: products x^(q_i + q_j) (upper triangle), q x^(q-1) v^2,
    q x^(q-1) and x^q (a x + b x_other), and a^2; then the squared gradient of the shaft term.
    edge : of the band that x, v, a were limited to; None for signals that were not.
    """

    def __init__(self, plane: Plane, form: Form = "velocity", edge: BandEdge | None = None) -> None:
        self.plane = plane
        self.form = form
        self.edge = edge
        self._joint = plane.scale_from_shaft and not plane.masses_known
        self._slices: list[slice] = []
        at = 0
        for cap in plane.caps:
            p = len(cap.powers)
            width = p * (p + 1) // 2 + 3 * p + 1
            self._slices.append(slice(at, at + width))
            at += width
        self.moments = BlockMoments(at + 1)
        self.names = plane.names()

    def series(self, x: Array, v: Array, a: Array | None = None) -> list[Array]:
        """The K columns of the series, each (n,), for displacement, velocity, acceleration (n, caps), SI."""
        plane = self.plane
        xs, vs = [np.ascontiguousarray(z) for z in x.T], [np.ascontiguousarray(z) for z in v.T]
        shaft = [plane.a * z for z in xs]
        if len(xs) == 2:
            shaft = [shaft[0] + plane.b * xs[1], shaft[1] + plane.b * xs[0]]
        columns: list[Array] = []
        for i, cap in enumerate(plane.caps):
            power = [np.ones_like(xs[i]), xs[i]]
            while len(power) <= cap.powers[-1]:
                power.append(power[-1] * xs[i])  # x ** 3 costs fifty times as much
            f = [power[q] for q in cap.powers]
            slope = [q * power[q - 1] for q in cap.powers]
            square = vs[i] * vs[i]
            columns += [f[j] * f[k] for j in range(len(f)) for k in range(j, len(f))]
            columns += [s * square for s in slope]
            columns += slope
            columns += [g * shaft[i] for g in f]
            columns.append(np.zeros(len(x)) if a is None else np.ascontiguousarray(a[:, i]) ** 2)
        columns.append(sum((z * z for z in shaft[1:]), shaft[0] * shaft[0]))
        return columns

    def add(self, x: Array, v: Array, a: Array | None = None, forget: float = 1.0) -> None:
        """Take one block, (n, caps) each; rows with NaN are left out. a is needed if there is a band edge."""
        keep = np.isfinite(x).all(axis=1) & np.isfinite(v).all(axis=1)
        if not keep.all():
            x, v, a = x[keep], v[keep], None if a is None else a[keep]
        self.moments.add(np.array([column.sum() for column in self.series(x, v, a)]), len(x), forget)

    def parameters(self) -> dict[str, Parameter]:
        """The estimate: contract names -> Parameter, each judged for identifiability."""
        constant = self._constant()
        if constant:
            return self.plane.undetermined(constant)
        try:
            values, covariance = self.values()
        except np.linalg.LinAlgError:
            return self.plane.undetermined("the displacement takes too few values to tell x from its powers")
        sds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return self.plane.judged({n: (values[n], float(sd)) for n, sd in zip(self.names, sds, strict=True)})

    def values(self) -> tuple[dict[str, float], Array]:
        """Estimate without verdict, and its covariance (P, P) in the order of `names`."""
        solved = self._solve(self.moments.mean.astype(complex)).real
        return dict(zip(self.names, solved.tolist(), strict=True)), propagate(self._solve, self.moments)

    def _constant(self) -> str:
        mean = self.moments.mean
        for cap, at in zip(self.plane.caps, self._slices, strict=True):
            if self.moments.rows > 0 and not mean[at.start] > 0.0:
                return f"{cap.place} does not move in the band: check the sensor and the band"
        return "" if self.moments.rows > 0 else "no valid sample yet"

    def _split(self, u: NDArray[np.complex128], index: int) -> tuple[NDArray[np.complex128], ...]:
        """E[f f'], E[f' v^2], E[f shaft], E[v^2] of one cap from the mean series, for unit mass and all of the band."""
        cap = self.plane.caps[index]
        p = len(cap.powers)
        part = u[self._slices[index]]
        gram = np.zeros((p, p), complex)
        upper = np.triu_indices(p)
        gram[upper] = part[: len(upper[0])]
        gram.T[upper] = gram[upper]
        weighted, plain, shaft = part[len(upper[0]) : -1].reshape(3, p)
        right = weighted if self.form == "velocity" else plain * weighted[0]
        if self.edge is not None:
            mass = 1.0 if cap.mass is None else cap.mass
            scale = np.sqrt(gram[0, 0].real) ** np.array(cap.powers, dtype=float)
            stiffness = _solve_scaled(gram, mass * right, scale)[0]  # of bearing and shaft together
            # for Gaussian x, E[f F] = E[f'] E[x F]
            right = right + plain * (self.edge.work(stiffness, mass, gram[0, 0], weighted[0], part[-1]) / mass)
        return gram, right, shaft, weighted[0]

    def _solve(self, u: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Parameters in the order of `names` from the mean series; analytic, for the complex-step derivative."""
        plane = self.plane
        parts = [self._split(u, i) for i in range(len(plane.caps))]
        joint = _joint_solution(plane, parts, u[-1]) if self._joint else None
        out: list[Any] = []
        for i, cap in enumerate(plane.caps):
            gram, right, shaft, square = parts[i]
            scale = np.sqrt(gram[0, 0].real) ** np.array(cap.powers, dtype=float)
            if cap.mass is not None:
                k = _solve_scaled(gram, cap.mass * right - plane.ks * shaft, scale)
            elif joint is not None:
                k = joint[1][i]
            else:
                k = _solve_scaled(gram, right, scale)
            if plane.solvable(cap):
                out += list(k)
            if 3 in cap.powers:
                out.append(k[cap.powers.index(3)] / k[0])
            if cap.mass is None and joint is not None:
                out.append(joint[0] / square)
        return np.array(out)


def _solve_scaled(gram: NDArray[np.complex128], right: NDArray[np.complex128], scale: Array) -> NDArray[np.complex128]:
    return np.asarray(np.linalg.solve(gram / np.multiply.outer(scale, scale), right / scale) / scale, complex)


def _joint_solution(
    plane: Plane, parts: list[tuple[NDArray[np.complex128], ...]], shaft_square: complex
) -> tuple[complex, list[NDArray[np.complex128]]]:
    """Temperature and coefficients of each cap when a mass is unknown: the shaft's own coefficient ks/T sets the scale.

    Both caps are taken to be at one temperature (the paper's hypothesis).
    """
    sizes = [len(cap.powers) for cap in plane.caps]
    n = sum(sizes)
    gram = np.zeros((n + 1, n + 1), complex)
    right = np.zeros(n + 1, complex)
    scale = np.ones(n + 1)
    at = 0
    for cap, (own, slope, shaft, square) in zip(plane.caps, parts, strict=True):
        here = slice(at, at + len(cap.powers))
        gram[here, here] = own
        gram[here, n] = gram[n, here] = shaft
        right[here] = slope / square
        scale[here] = np.sqrt(own[0, 0].real) ** np.array(cap.powers, dtype=float)
        at = here.stop
    gram[n, n] = shaft_square
    right[n] = 2.0 * plane.a
    scale[n] = np.sqrt(shaft_square.real)
    theta = _solve_scaled(gram, right, scale)
    temperature = plane.ks / theta[n]
    return temperature, list(np.split(theta[:n] * temperature, np.cumsum(sizes)[:-1]))
