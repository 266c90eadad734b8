"""The determinant of the mean tangent in the path likelihood, taken along a line that leaves all modes to the left
(contour.py), and its derivatives.

Tangents of forces times a matrix, bin by bin: a force at one place is one row of places, and the rest is zero.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes

from .contour import phase_steps


def tangent_times(tangents: Complexes, factor: Complexes) -> Complexes:
    """(terms, places, places, bins) of tangents and a factor (bins, places, places), each of some of the places."""
    term, row, made = nonzero_rows_times(tangents, factor)
    out = np.zeros((*tangents.shape[:2], *made.shape[1:]), complex)
    out[term, row] = made
    return out


def nonzero_rows_times(
    tangents: Complexes, factor: Complexes
) -> tuple[NDArray[np.int64], NDArray[np.int64], Complexes]:
    """The same as the rows that are not zero: of which term and place, (rows,), and these, (rows, places, bins)."""
    term, row = np.nonzero(tangents.any(axis=(2, 3)))
    by_bin = np.ascontiguousarray(np.moveaxis(factor, 0, -1))
    out = np.zeros((term.size, *by_bin.shape[1:]), complex)
    for k, i, made in zip(term, row, out, strict=True):
        for one, own in zip(tangents[k, i], by_bin, strict=True):
            made += one * own
    return term, row, out


CoupledResponse = tuple[NDArray[np.int64], Complexes]
MODE_CROSSED_RAD = (
    1.5 * np.pi
)  # a mode that crosses its line takes two pi off the turn of det A, one that leaves the band one


class Jacobian:
    """2 sum_f log |det A(f)| per block and its derivatives, about the working point's A0 (bins, places, places).

    s : (bins,) rad/s that A0 is given at, the axis if None. On its way there and back the line also has the phase of
    det A: of 2 log det A ds / i the real part is summed. kept : (bins,) share of each that the likelihood has of its
    bin.
    dressing : (bins, places), what of A0 comes from fluctuating tangents (self_energy.py). It is quadratic in the
    amplitudes of the laws, and a column of one of them has the half of its derivative: the value whose derivatives
    the columns have is 2 log |det A| - Re tr(A^-1 dressing), stationary in A. Models are compared by it.
    """

    def __init__(
        self, A0: Complexes, s: Complexes | None = None, dressing: Complexes | None = None, kept: Array | None = None
    ) -> None:
        self.A0, self.offset, self.kept = A0, 0.0, np.ones(len(A0)) if kept is None else kept
        self.dressing = np.zeros(self.A0.shape[:2], complex) if dressing is None else dressing
        self.phase = np.zeros(len(A0) - 1) if s is None else (s.real[1:] + s.real[:-1]) / np.diff(s.imag).min()
        self.weight = 2.0 * self.kept - 1j * np.diff(self.phase, prepend=0.0, append=0.0)  # of log det A
        self._known: dict[
            bytes, tuple[Jacobian, CoupledResponse | None]
        ] = {}  # of some places: every trial there asks for it
        self._begun()

    def _begun(self) -> None:
        self.turned, self.half = phase_steps(_determinants(self.A0)).sum(), 0.0
        if self.dressing.any():
            own = np.einsum("fii->fi", np.linalg.inv(self.A0)) * self.dressing
            self.half = float((0.5 * self.weight @ own.sum(axis=1)).real)

    def _sum(self, determinant: Complexes, turned: Array) -> float:
        """Of log det A along the line. turned : what `turns` says of it."""
        return float(2 * self.kept @ np.log(np.abs(determinant)) - self.phase @ turned)

    def at(self, places: NDArray[np.int64]) -> Jacobian:
        """The same of some places, the others as they are: what they answer through the shaft stays in A0."""
        return self._of(places)[0]

    def _of(self, places: NDArray[np.int64]) -> tuple[Jacobian, CoupledResponse | None]:
        """The same and `answer`, made when they are first asked for."""
        if (known := self._known.get(places.tobytes())) is None:
            answer = self.answer(places)
            known = self._known[places.tobytes()] = self._beside(answer, places), answer
        return known

    def _beside(self, answer: CoupledResponse | None, places: NDArray[np.int64]) -> Jacobian:
        out = copy(self)
        out._known = {}
        out.A0, out.dressing = self.A0[:, places[:, None], places], self.dressing[:, places]
        if answer is not None:
            others, follow = answer
            out.A0 = out.A0 - self.A0[:, places[:, None], others] @ follow
        share = places.size / self.A0.shape[1]
        out.offset = self.offset * share
        if answer is not None:  # all places together have what the whole has
            whole, own = (self._sum(det, phase_steps(det)) for det in map(_determinants, (self.A0, out.A0)))
            out.offset += own - whole * share
        out._begun()
        return out

    def answer(self, places: NDArray[np.int64]) -> CoupledResponse | None:
        """The places that the shaft couples to these, and their motion per motion of these, less its sign,
        (bins, others, places); None where there are none."""
        others = np.setdiff1d(np.arange(self.A0.shape[1], dtype=np.int64), places)
        others = others[np.any(self.A0[:, others[:, None], places] != 0, axis=(0, 2))]
        if not others.size:
            return None
        follow = np.linalg.solve(self.A0[:, others[:, None], others], self.A0[:, others[:, None], places])
        return others.astype(np.int64), np.asarray(follow, dtype=np.complex128)

    def tangents(self, tangents: Complexes, places: NDArray[np.int64]) -> Complexes:
        """What tangents (terms, all places, all places, bins) of forces at some places add to A0 `at` them."""
        own = tangents[:, places][:, :, places]
        answer = self._of(places)[1]
        if answer is None:
            return own
        others, follow = answer
        return np.asarray(own - tangent_times(tangents[:, places][:, :, others], follow))

    def of(self, tangents: Complexes, delta: Array) -> Complexes:
        """A at increments delta, (bins, places, places)."""
        return np.asarray(self.A0 + np.moveaxis(np.tensordot(delta, tangents, 1), 2, 0))

    def value(self, tangents: Complexes, delta: Array) -> float:
        """-inf where a mode has crossed the line: what the sum gives there is that of its mirror image."""
        determinant = _determinants(self.of(tangents, delta))
        turned = phase_steps(determinant)
        if turned.sum() < self.turned - MODE_CROSSED_RAD:
            return -np.inf
        return self._sum(determinant, turned) - self.offset - self.half

    def derivatives(self, tangents: Complexes, delta: Array) -> tuple[Array, Array]:
        """Gradient (k,) and second derivative (k, k) to the increments."""
        term, row, passed = nonzero_rows_times(tangents, _inverses(self.of(tangents, delta)))  # A_j A^-1
        weighed, own = passed * self.weight, np.arange(term.size)
        traces = np.zeros((term.size, term.size))
        for i, j in np.ndindex(tangents.shape[1:3]):
            here, there = np.flatnonzero(row == i), np.flatnonzero(row == j)
            traces[here[:, None], there] = (weighed[here, j] @ passed[there, i].T).real
        terms = np.equal.outer(np.arange(len(tangents)), term).astype(float)
        return terms @ weighed[own, row].real.sum(axis=1), -terms @ traces @ terms.T


def _determinants(A: Complexes) -> Complexes:
    """(bins,) of (bins, places, places); of one place it is a number, which LAPACK is asked for at length."""
    return A[:, 0, 0] if A.shape[1] == 1 else np.asarray(np.linalg.det(A), np.complex128)


def _inverses(A: Complexes) -> Complexes:
    """(bins, places, places)"""
    return 1.0 / A if A.shape[1] == 1 else np.asarray(np.linalg.inv(A), np.complex128)
