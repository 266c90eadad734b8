"""The determinant of A in the path likelihood, along a line that leaves all modes to its left, and its derivatives.

Products of tangents and a matrix are made bin by bin. The tangent of a force at one place has one row of places that is
not zero.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from estimator.arrays import Array, Complexes

from .contour import phase_steps


def tangent_times(tangents: Complexes, factor: Complexes) -> Complexes:
    """(k, places, places, bins) products of tangents (k, places, places, bins) and a factor (bins, places, places)."""
    term, row, made = nonzero_rows_times(tangents, factor)
    out = np.zeros((*tangents.shape[:2], *made.shape[1:]), complex)
    out[term, row] = made
    return out


def nonzero_rows_times(
    tangents: Complexes, factor: Complexes
) -> tuple[NDArray[np.int64], NDArray[np.int64], Complexes]:
    """The nonzero rows of the products: number of tangent and place, (rows,) each, and rows (rows, places, bins)."""
    term, row = np.nonzero(tangents.any(axis=(2, 3)))
    by_bin = np.ascontiguousarray(np.moveaxis(factor, 0, -1))
    out = np.zeros((term.size, *by_bin.shape[1:]), complex)
    for k, i, made in zip(term, row, out, strict=True):
        for one, own in zip(tangents[k, i], by_bin, strict=True):
            made += one * own
    return term, row, out


def line_weights(s: Complexes, kept: Array | None = None) -> Complexes:
    """(bins,) weights of log det A whose real sum is that of 2 log det A ds / i along a line s (bins,) rad/s.

    Where the line leaves the imaginary axis, the phase of det A contributes. kept : (bins,) share of each bin in the
    likelihood; None: 1.
    """
    phase = (s.real[1:] + s.real[:-1]) / np.diff(s.imag).min()
    kept = np.ones(s.size) if kept is None else kept
    return np.asarray(2.0 * kept - 1j * np.diff(phase, prepend=0.0, append=0.0))


CoupledResponse = tuple[NDArray[np.int64], Complexes]
MODE_CROSSED_RAD = 1.5 * np.pi  # turn of det A: 2 pi when a mode crosses the line, pi when one leaves the band


class Jacobian:
    """2 sum_f log |det A(f)| per block, and its derivatives by increments of the parameters.

    A0 : (bins, places, places) kg, A at the working point. weight : (bins,) of log det A in the sum, see
    `line_weights`; None: 2. second_order : (bins, places) kg, the part of A0 that is second-order correction; None: 0.

    The second-order correction is quadratic in the amplitudes of the laws, and the tangent of a regressor has half of
    its derivative. The value with these derivatives is 2 log |det A| - Re tr(A^-1 second_order). Models are compared
    by it.
    """

    def __init__(
        self, A0: Complexes, weight: Complexes | None = None, second_order: Complexes | None = None
    ) -> None:  # fmt: skip
        self.A0, self.offset = A0, 0.0
        self.weight = np.full(len(A0), 2.0 + 0j) if weight is None else weight
        self.second_order = np.zeros(self.A0.shape[:2], complex) if second_order is None else second_order
        self._by_places: dict[bytes, tuple[Jacobian, CoupledResponse | None]] = {}  # every trial there asks for it
        self._set_reference()

    def _set_reference(self) -> None:
        """Set the reference of the sum: det A0, its phase steps, and half of the trace of the second-order part."""
        self.determinant0, self.half_trace = _determinants(self.A0), 0.0
        self.turned0 = phase_steps(self.determinant0)
        if self.second_order.any():
            own = np.einsum("fii->fi", np.linalg.inv(self.A0)) * self.second_order
            self.half_trace = float((0.5 * self.weight @ own.sum(axis=1)).real)

    def _sum(self, determinant: Complexes, turned: Array) -> float:
        """The sum of 2 log |det A| along the line. turned : (bins - 1,) rad, phase steps of det A."""
        along, weight = np.append(0.0, np.cumsum(turned)), self.weight
        return float(weight.real @ np.log(np.abs(determinant)) - weight.imag @ along)

    def of_places(self, places: NDArray[np.int64]) -> Jacobian:
        """The Jacobian of some places, the others eliminated: their response through the shaft stays in A0."""
        return self._of(places)[0]

    def _of(self, places: NDArray[np.int64]) -> tuple[Jacobian, CoupledResponse | None]:
        """The Jacobian of some places and the response of the others, made at first use."""
        if (known := self._by_places.get(places.tobytes())) is None:
            response = self.coupled_response(places)
            known = self._by_places[places.tobytes()] = self._eliminated(response, places), response
        return known

    def _eliminated(self, response: CoupledResponse | None, places: NDArray[np.int64]) -> Jacobian:
        """The Jacobian of some places. response : of the others; None where there are none."""
        out = copy(self)
        out._by_places = {}
        out.A0, out.second_order = self.A0[:, places[:, None], places], self.second_order[:, places]
        if response is not None:
            others, follow = response
            out.A0 = out.A0 - self.A0[:, places[:, None], others] @ follow
        if response is not None:  # all places of a coupled group together have what the group has
            out.offset = self._sum_of(out.A0)
            for group in self._coupled_groups():
                share = np.isin(group, places).mean()
                out.offset -= share * self._sum_of(self.A0[:, group[:, None], group]) if share else 0.0
        out._set_reference()
        return out

    def _coupled_groups(self) -> list[NDArray[np.int64]]:
        """Places that the shaft couples, by group."""
        count, group = connected_components(np.any(self.A0 != 0, axis=0))
        return [np.flatnonzero(group == k) for k in range(count)]

    def _sum_of(self, A: Complexes) -> float:
        """The sum of 2 log |det A| along the line. A : (bins, k, k)."""
        determinant = _determinants(A)
        return self._sum(determinant, phase_steps(determinant))

    def coupled_response(self, places: NDArray[np.int64]) -> CoupledResponse | None:
        """The other places that are coupled to these, some through others, and minus their motion per motion of these,
        (bins, others, places); None where there are none."""
        groups = [group for group in self._coupled_groups() if np.isin(group, places).any()]
        others = np.setdiff1d(np.concatenate(groups), places)
        if not others.size:
            return None
        follow = np.linalg.solve(self.A0[:, others[:, None], others], self.A0[:, others[:, None], places])
        return others.astype(np.int64), np.asarray(follow, dtype=np.complex128)

    def tangents(self, tangents: Complexes, places: NDArray[np.int64]) -> Complexes:
        """Additions of tangents (k, all places, all places, bins) of forces at some places to A0 of these places."""
        own = tangents[:, places][:, :, places]
        response = self._of(places)[1]
        if response is None:
            return own
        others, follow = response
        return np.asarray(own - tangent_times(tangents[:, places][:, :, others], follow))

    def tangent_matrix(self, tangents: Complexes, delta: Array) -> Complexes:
        """(bins, places, places) kg: A at increments delta (k,)."""
        return np.asarray(self.A0 + np.moveaxis(np.tensordot(delta, tangents, 1), 2, 0))

    def value(self, tangents: Complexes, delta: Array) -> float:
        """The sum at increments delta (k,), nats; -inf where a mode has crossed the line.

        Beyond the line the sum would be that of the mirror image of the mode.
        """
        determinant = _determinants(self.tangent_matrix(tangents, delta))
        turned = phase_steps(determinant / self.determinant0)  # small also where bins are left out, around a mode
        if turned.sum() < -MODE_CROSSED_RAD:
            return -np.inf
        return self._sum(determinant, self.turned0 + turned) - self.offset - self.half_trace

    def slopes(self, tangents: Complexes, delta: Array) -> tuple[Array, Complexes]:
        """Gradient (k,) by the increments, and slopes (places, places, bins) by the elements of A."""
        inverse = _inverses(self.tangent_matrix(tangents, delta))
        by_matrix = np.ascontiguousarray((inverse * self.weight[:, None, None]).T)
        return (tangents.reshape(len(tangents), -1) @ by_matrix.ravel()).real, by_matrix

    def derivatives(self, tangents: Complexes, delta: Array) -> tuple[Array, Array]:
        """Gradient (k,) and Hessian (k, k) by the increments."""
        term, row, passed = nonzero_rows_times(tangents, _inverses(self.tangent_matrix(tangents, delta)))  # A_j A^-1
        weighted, own = passed * self.weight, np.arange(term.size)
        traces = np.zeros((term.size, term.size))
        for i, j in np.ndindex(tangents.shape[1:3]):
            here, there = np.flatnonzero(row == i), np.flatnonzero(row == j)
            traces[here[:, None], there] = (weighted[here, j] @ passed[there, i].T).real
        of_tangent = np.equal.outer(np.arange(len(tangents)), term).astype(float)
        return of_tangent @ weighted[own, row].real.sum(axis=1), -of_tangent @ traces @ of_tangent.T


def _determinants(A: Complexes) -> Complexes:
    """(bins,) determinants of A (bins, places, places); of one place without LAPACK, which is slow there."""
    return A[:, 0, 0] if A.shape[1] == 1 else np.asarray(np.linalg.det(A), np.complex128)


def _inverses(A: Complexes) -> Complexes:
    """(bins, places, places) inverses of A (bins, places, places)."""
    return 1.0 / A if A.shape[1] == 1 else np.asarray(np.linalg.inv(A), np.complex128)
