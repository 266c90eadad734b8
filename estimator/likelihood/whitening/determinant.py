"""The determinant of A in the path likelihood, along a line that leaves all modes to its left, and its derivatives.

Products of tangents and a matrix are made bin by bin. The tangent of a force at one place has one row of places that is
not zero.

The line along which the determinant of the path likelihood is summed: right of the imaginary axis and of all modes.

The map from motion to force is causal, so its Jacobian is that of the highest derivatives, for any law. In the modes p
of the linearised rotor, Im p > 0, with T the length of the record,

    sum over the band of log |det A|^2 = -T sum of Re p + a constant.

Along the imaginary axis the sum is T sum |Re p| (Jensen's formula). It does not distinguish a mode that grows from one
that decays as fast, and the likelihood has a second maximum at the mirror image. Also, a mode narrower than the spacing
of the bins is summed by chance. Along s = shift + iw every mode lies to the left, at the distance shift - Re p, and the
sum is linear in Re p. A mode that a step takes across the line shows in the phase of det A, which then turns the other
way. The line has a wide margin where it is needed, because a law on trial may move a mode far.

At its ends, and where bins are left out, the line returns to the axis, as steep there as far from it. So it has the
ends of the axis, and its sum but for the modes. A straight line without the ways back would bias the slopes.

A disc or a shaft that resonates in the band moves with the caps as modes of the rotor. Its response at s differs from
that at iw, and both are exact. The stiffness of all else is taken to be the same at s and iw.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from estimator.arrays import Array, Complexes
from estimator.model.background import Background
from estimator.model.rotor_matrices import Rotor

MARGIN_BINS = 1.0  # least distance of a mode from the line, spacings of the bins: the error is exp(-2 pi)
WIDE_MARGIN_BINS = 4.0  # distance from the line where one is needed, spacings of the bins


def contour(A: Complexes, mass: Array, D: Array, f_hz: Array, rotor: Rotor | None = None) -> Complexes:
    """(bins,) rad/s, the line.

    A : (bins, places, places) kg, at f_hz, which is evenly spaced but for gaps. mass : (places,) kg. D : (places,
    places, 2) mean tangents by displacement and velocity, N/m and N s/m. rotor : shaft and discs; None without.
    """
    w = 2 * np.pi * f_hz
    length = 1.0 / float(np.diff(f_hz).min())
    resonance = np.sqrt(np.median(np.maximum(np.diag(D[..., 0]) / mass, 0.0)))
    near = int(np.argmin(np.abs(w - resonance)))
    modes = modes_at(A[near], mass, 1j * w[near], rotor)
    band = contiguous_bands(f_hz)
    needed = shift_past_modes(modes, MARGIN_BINS / length, band) > 0.0
    return line_at_shift(w, shift_past_modes(modes, WIDE_MARGIN_BINS / length, band) if needed else 0.0, band)


def line_at_shift(w: Array, shift: float, band: Sequence[tuple[float, float]]) -> Complexes:
    """(w,) rad/s, a line from the axis at the ends of all stretches of w (rad/s) to `shift` rad/s right of it."""
    inside = np.max([np.minimum(w - low, high - w) for low, high in band], axis=0)
    x = np.clip(inside / max(shift, 1e-300), 0.0, 1.0)
    return np.asarray(shift * x**2 * (3.0 - 2.0 * x) + 1j * w, np.complex128)


def contiguous_bands(f_hz: Array) -> list[tuple[float, float]]:
    """First and last rad/s of each stretch of evenly spaced frequencies."""
    w, gaps = 2 * np.pi * f_hz, np.flatnonzero(np.diff(f_hz) > 1.5 * np.diff(f_hz).min())
    return list(zip(w[[0, *(gaps + 1)]].tolist(), w[[*gaps, -1]].tolist(), strict=True))


def shift_past_modes(modes: Complexes, margin_hz: float | Array, band: Sequence[tuple[float, float]]) -> float:
    """rad/s from the axis to the line right of the modes of the band; 0 where no mode is near the axis.

    A mode where bins are left out is not summed, so the line need not pass it.

    modes : (modes,) rad/s. margin_hz : least distance of each mode from the line. band : rad/s, its stretches.
    """
    inside = np.any([(modes.imag > low) & (modes.imag < high) for low, high in band], axis=0)
    return max(float((modes.real + 2 * np.pi * margin_hz)[inside].max(initial=0.0)), 0.0)


def modes_at(A: Complexes, mass: Array, s: complex, rotor: Rotor | None = None) -> Complexes:
    """(modes,) rad/s of the rotor m s^2 + c s + k whose response is s^2 A at s, with the modes of shaft and discs."""
    P, rest = mass.size, (A - np.diag(mass)) * s**2
    if rotor is None:
        M, C, K = (np.zeros((P, P)) for _ in range(3))
    else:
        rest = rest - rotor.dynamic(np.array([s / 1j]))[0]
        M, C, K = rotor.M.copy(), rotor.C.copy(), rotor.K.copy()
    M[range(P), range(P)] += mass
    K[:P, :P] += rest.real
    C[:P, :P] += rest.imag / s.imag
    n = len(M)
    free = np.zeros((2 * n, 2 * n))
    free[:n, n:] = np.eye(n)
    free[n:] = -np.linalg.solve(M, np.hstack([K, C]))
    modes = np.linalg.eigvals(free)
    return np.asarray(modes[modes.imag > 0.0], np.complex128)


def continued_tangent(
    s: Complexes, A: Complexes, mass: Array, D: Array, rotor: Rotor | None = None,
    background: Background | None = None, places: tuple[str, ...] = (),
) -> Complexes:  # fmt: skip
    """(bins, places, places) kg: A at s (bins,), from A at i Im s. D : mean tangents as in `contour`."""
    if not s.real.any():
        return A
    iw, s1 = 1j * s.imag[:, None, None], s[:, None, None]

    def bearings(s: NDArray[Any]) -> Complexes:
        made = np.asarray(D[..., 0] + s[:, None, None] * D[..., 1], np.complex128)
        if background is None:
            return made
        made = made * background.deflections(places, s)[:, None, :]
        np.einsum("fii->fi", made)[...] += background.attached_stiffness(places, s)
        return np.asarray(made)

    there, here = bearings(s), bearings(1j * s.imag)
    moved = (there - here) / s1**2
    out = np.diag(mass) + (A - np.diag(mass)) * (iw / s1) ** 2 + moved
    if rotor is not None:
        out += (rotor.dynamic(s / 1j) - rotor.dynamic(s.imag)) / s1**2
    return np.asarray(out)


def phase_steps(determinant: Complexes) -> Array:
    """(bins - 1,) rad by which det A (bins,) turns along a line: in all pi for a mode left of it, -pi for one right."""
    return np.asarray(np.angle(determinant[1:] / determinant[:-1]), np.float64)


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
        """Set what the sum is compared with: det A0, how it turns, and half of the trace of the second-order part."""
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
        """What tangents (k, all places, all places, bins) of forces at some places add to the A0 of these places."""
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
