"""Linear and cubic stiffness from moments of displacement and velocity: score matching, without bins or histogram.

The stationary density p(x) = c exp(-V/T) obeys, for V = sum_k theta_k phi_k (Hyvarinen 2005),

    E[grad phi . grad phi'] theta/T = E[laplacian phi]                                                    (density form)

and T = m E[v^2]. This is the paper's eq. (36) with infinitely fine cells. The same row follows from stationarity alone,
0 = d/dt E[m v h(x)] = m E[h'(x) v^2] - E[h(x) V'(x)], because damping (odd in v) and white force do not correlate with
a function of x at the same instant:

    E[f f'] k = m E[f'(x) v^2],   f = dV/dk                                                              (velocity form)

The two agree if x and v are independent, as exp(-H/T) says. On a record, the velocity form does not suffer from the
slow wander of the amplitude, needs neither equal temperatures at the two caps nor a Gaussian velocity, and has a
twentieth of the scatter (docs/paper.md); on independent samples of the density the density form is the better.
The band limit leaves a few thousandths of E[x F] out: kL is off by as much, and its standard deviation contains it.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.results import Parameter

from .batch_means import BlockMoments, propagate
from .planes import Cap, Plane
from .thresholds import LIMITS

Form = Literal["velocity", "density"]


class PlaneMoments:
    """Stiffness of one direction from moments of displacement and velocity, with old blocks forgotten.

    The moments, per cap with powers q: x^(q_i + q_j) (upper triangle), q x^(q-1) v^2, q x^(q-1),
    x^q (a x + b x_other); then the squared gradient of the shaft term.

    Parameters
    ----------
    plane : Plane
        The caps and the shaft of the direction.
    form : {"velocity", "density"}
        Estimating equation, see the text of the module. "velocity" is for records, "density" for independent samples.
    """

    def __init__(self, plane: Plane, form: Form = "velocity") -> None:
        self.plane = plane
        self.form = form
        self._joint = plane.scale_from_shaft and not plane.masses_known
        self._slices: list[slice] = []
        self._upper = [np.triu_indices(len(cap.powers)) for cap in plane.caps]
        at = 0
        for cap in plane.caps:
            p = len(cap.powers)
            width = p * (p + 1) // 2 + 3 * p
            self._slices.append(slice(at, at + width))
            at += width
        self.moments = BlockMoments(at + 1)
        self.names = plane.names()

    def sums(self, x: Array, v: Array) -> Array:
        """(K,) moments summed over the rows of displacement and velocity, (n, caps) each, SI."""
        plane = self.plane
        xs = np.ascontiguousarray(x.T)
        shaft = plane.a * xs
        if len(xs) == 2:
            shaft += plane.b * xs[::-1]
        out: list[Array] = []
        shaft_square = 0.0
        for i, (cap, (first, second)) in enumerate(zip(plane.caps, self._upper, strict=True)):
            # 1, x, x^2 ... , v^2, shaft: every column is a product of two of them, so one matrix product sums all
            top = cap.powers[-1]
            z = np.empty((top + 3, len(x)))
            z[0] = 1.0
            for q in range(1, top + 1):
                np.multiply(z[q - 1], xs[i], out=z[q])  # x ** 3 costs fifty times as much
            np.multiply(v[:, i], v[:, i], out=z[top + 1])
            z[top + 2] = shaft[i]
            product = z @ z.T
            f = np.array(cap.powers)
            weighted, plain = f * product[f - 1, top + 1], f * product[f - 1, 0]
            out += [product[f[first], f[second]], weighted, plain, product[f, top + 2]]
            shaft_square += product[top + 2, top + 2]
        return np.concatenate([*out, [shaft_square]])

    def add(self, x: Array, v: Array, forget: float = 1.0) -> None:
        """Take one block of displacement and velocity, (n, caps) each, SI; rows with NaN are left out.

        forget : factor on the weights of all older blocks.
        """
        keep = np.isfinite(x).all(axis=1) & np.isfinite(v).all(axis=1)
        if not keep.all():
            x, v = x[keep], v[keep]
        self.moments.add(self.sums(x, v), len(x), forget)

    def parameters(self) -> dict[str, Parameter]:
        """Parameters by full name, each with its standard deviation or the reason why it is not identifiable."""
        if reason := self.still() if self.moments.rows > 0 else "no valid sample yet":
            return self.plane.undetermined(reason)
        try:
            values, covariance = self.values()
        except np.linalg.LinAlgError:
            return self.plane.undetermined("the displacement takes too few values to tell x from its powers")
        edge = np.array([LIMITS.edge_sd_rel * values[n] if n.endswith(".kL") else 0.0 for n in self.names])
        sds = np.sqrt(np.maximum(np.diag(covariance), 0.0) + edge**2)
        return self.plane.judged({n: (values[n], float(sd)) for n, sd in zip(self.names, sds, strict=True)})

    def values(self) -> tuple[dict[str, float], Array]:
        """Values by full name, identifiable or not, and their covariance (P, P) in the order of `names`."""
        values, covariance = propagate(self._solve, self.moments)
        return dict(zip(self.names, values.tolist(), strict=True)), covariance

    def still(self) -> str:
        """Reason, as text, of a cap that does not move; "" where all move."""
        mean = self.moments.mean
        for cap, at in zip(self.plane.caps, self._slices, strict=True):
            if not mean[at.start] > 0.0:
                return f"{cap.place} does not move in the band: check the sensor and the band"
        return ""

    def _split(self, u: Complexes, index: int) -> tuple[Complexes, ...]:
        """E[f f'] (..., p, p), E[f' v^2] and E[f shaft] (..., p), E[v^2] (...) of one cap.

        u : (..., K), the mean series, for unit mass.
        """
        cap = self.plane.caps[index]
        p = len(cap.powers)
        part = u[..., self._slices[index]]
        first, second = self._upper[index]
        gram = np.empty((*u.shape[:-1], p, p), complex)
        gram[..., first, second] = gram[..., second, first] = part[..., : len(first)]
        weighted, plain, shaft = (part[..., len(first) + k * p : len(first) + (k + 1) * p] for k in range(3))
        square = weighted[..., 0]
        right = weighted if self.form == "velocity" else plain * square[..., None]
        return gram, right, shaft, square

    def _solve(self, u: Complexes) -> Complexes:
        """(..., P) parameters in the order of `names` from the mean series (..., K); analytic, for the complex step."""
        plane = self.plane
        parts = [self._split(u, i) for i in range(len(plane.caps))]
        joint = _joint_solution(plane, parts, u[..., -1]) if self._joint else None
        out: list[Complexes] = []
        for i, cap in enumerate(plane.caps):
            gram, right, shaft, square = parts[i]
            if cap.mass is not None:
                k = _solve_scaled(gram, cap.mass * right - plane.ks * shaft, _scale(gram, cap))
            elif joint is not None:
                k = joint[1][i]
            else:
                k = _solve_scaled(gram, right, _scale(gram, cap))
            if plane.solvable(cap):
                out += list(np.moveaxis(k, -1, 0))
            if 3 in cap.powers:
                out.append(k[..., cap.powers.index(3)] / k[..., 0])
            if cap.mass is None and joint is not None:
                out.append(joint[0] / square)
        return np.stack(out, axis=-1) if out else np.empty((*u.shape[:-1], 0), complex)


def _scale(gram: Complexes, cap: Cap) -> Array:
    """(..., p) rms displacement to the powers of the cap, as a scale of `gram` (..., p, p)."""
    return np.asarray(np.sqrt(gram[..., :1, 0].real) ** np.array(cap.powers, dtype=float))


def _solve_scaled(gram: Complexes, right: Complexes, scale: Array) -> Complexes:
    """(..., p) solution of gram (..., p, p) times it = right (..., p), scaled for the condition number."""
    scaled = gram / (scale[..., :, None] * scale[..., None, :])
    return np.asarray(np.linalg.solve(scaled, (right / scale)[..., None])[..., 0] / scale, complex)


def _joint_solution(
    plane: Plane, parts: list[tuple[Complexes, ...]], shaft_square: Complexes
) -> tuple[Complexes, list[Complexes]]:
    """Temperature (...) and coefficients (..., p) of each cap where a mass is unknown and the shaft gives the scale.

    Both caps are taken to have one temperature, as in the paper.
    """
    sizes = [len(cap.powers) for cap in plane.caps]
    n = sum(sizes)
    gram = np.zeros((*shaft_square.shape, n + 1, n + 1), complex)
    right = np.zeros((*shaft_square.shape, n + 1), complex)
    scale = np.ones((*shaft_square.shape, n + 1))
    at = 0
    for cap, (own, slope, shaft, square) in zip(plane.caps, parts, strict=True):
        here = slice(at, at + len(cap.powers))
        gram[..., here, here] = own
        gram[..., here, n] = gram[..., n, here] = shaft
        right[..., here] = slope / square[..., None]
        scale[..., here] = _scale(own, cap)
        at = here.stop
    gram[..., n, n] = shaft_square
    right[..., n] = 2.0 * plane.a
    scale[..., n] = np.sqrt(shaft_square.real)
    theta = _solve_scaled(gram, right, scale)
    temperature = plane.ks / theta[..., n]
    return temperature, np.split(theta[..., :n] * temperature[..., None], np.cumsum(sizes)[:-1], axis=-1)
