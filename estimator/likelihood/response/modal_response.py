"""Impulse response of a bearing cap as a sum of the modes of the mean rotor, shaft and disc included.

Every bearing cap has the mean tangents of its laws. The response to an impulse of force is
x(tau) = Re sum_k r_k exp(p_k tau). On a stiff shaft it differs much from that of the cap alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.thresholds import LIMITS
from estimator.model.rotor_matrices import Rotor


@dataclass(frozen=True, slots=True)
class ModalResponse:
    """Response of one bearing cap to a force on it, as a sum of modes.

    poles : (modes,) rad/s, of each conjugate pair the pole above the real axis. residues : (modes,) m/(N s), doubled
    for a pair.
    """

    poles: Complexes
    residues: Complexes

    @property
    def sound(self) -> bool:
        """Whether free motion decays in every mode."""
        return bool(self.poles.real.max() < 0.0)

    @property
    def _power(self) -> Array:
        """(modes,) variance of the displacement under white force, up to a factor, mode by mode."""
        return np.asarray(np.abs(self.residues) ** 2 / np.maximum(np.abs(self.poles.real), 1e-9))

    @property
    def hz(self) -> float:
        """Frequency of the main resonance, Hz."""
        return float(np.abs(self.poles[np.argmax(self._power)]) / (2 * np.pi))

    @property
    def decay(self) -> float:
        """Time in which free motion falls by e, s, in the slowest mode that contributes."""
        part = self._power > LIMITS.min_mode_power_rel * self._power.max()
        return float((-1.0 / self.poles.real[part]).max())

    @property
    def quick(self) -> float:
        """Decay time, s, by the mean decay rate over the modes, weighted by power."""
        return float(self._power.sum() / (self._power @ np.abs(self.poles.real)))

    def unfinished(self, seconds: float) -> float:
        """Share of the power of the impulse response that comes later than `seconds`."""
        return float(self._power @ np.exp(2.0 * seconds * self.poles.real) / self._power.sum())

    @property
    def stiffness(self) -> float:
        """Static stiffness, N/m."""
        return float(1.0 / self.at(np.zeros(1)).real[0])

    @property
    def width(self) -> float:
        """Least dynamic stiffness, N/m: that at a resonance, c w0 for a single mass."""
        return float(1.0 / np.abs(self.at(np.abs(self.poles.imag))).max())

    def at(self, w: Array) -> Complexes:
        """(f,) m/N, compliance at w (f,) rad/s."""
        iw = 1j * w[:, None]
        pairs = self.residues / (iw - self.poles) + self.residues.conj() / (iw - self.poles.conj())
        return np.asarray(0.5 * pairs.sum(axis=1))

    def after(self, tau: Array) -> Array:
        """(2, lags) m and m/s, response to an impulse of 1 N s at times tau (lags,) s after it."""
        free = self.residues * np.exp(np.multiply.outer(tau, self.poles))
        return np.stack([free.sum(axis=1).real, (free @ self.poles).real])

    def seconds(self, least: float, decays: float) -> float:
        """Length of record that covariances of the motion need, s: `decays` mean decay times, and at least `least`.

        A mode that decays slowly has to fit in a tenth as many times.
        """
        return max(least, decays * self.quick, LIMITS.slowest_mode_share * decays * self.decay)

    def lags(self, dt: float, most: int) -> int:
        """Number of lags after which free motion has decayed: a power of two of at least 8, or `most`."""
        return min(most, 1 << max(3, int(np.ceil(np.log2(7.0 * self.decay / dt)))))


def compliance(w: Array, mass: Array, D: Array, rotor: Rotor | None) -> Complexes:
    """(f, places, places) m/N, displacement of each bearing cap per force on each; arguments as `modal_responses`."""
    iw = 1j * w[:, None, None]
    dynamic = D[..., 0] + iw * D[..., 1] + iw**2 * np.diag(mass)
    if rotor is not None:
        dynamic += rotor.dynamic(w)
    return np.asarray(np.linalg.inv(dynamic))


def modal_responses(
    mass: Array, D: Array, rotor: Rotor | None, memories: Sequence[tuple[int, Array]] = ()
) -> tuple[ModalResponse, ...]:
    """Response of each bearing cap of a rotor.

    mass : (places,) kg. D : (places, places, 2) mean tangents to displacement and velocity, N/m and N s/m, without the
    shaft. rotor : shaft and discs; None without them. memories : place and state matrix of linear laws with memory.
    """
    n = len(mass)
    M, K, C = np.diag(mass), D[..., 0], D[..., 1]
    if rotor is not None:
        inner = (0, len(rotor.M) - n)
        M, K, C = (np.pad(A, inner) + own for A, own in ((M, rotor.M), (K, rotor.K), (C, rotor.C)))
    Mi = np.linalg.inv(M)
    size = len(M)
    free = np.block([[np.zeros((size, size)), np.eye(size)], [-Mi @ K, -Mi @ C]])
    for i, own in memories:
        before, more = len(free), len(own) - 1
        seen = [*range(before, before + more), i, size + i]
        free = np.pad(free, (0, more))
        free[before:, seen] = own[:-1]
        free[size : 2 * size, seen] -= np.outer(Mi[:, i], own[-1])
    poles, right = np.linalg.eig(free)
    left = np.linalg.inv(right)[:, size : 2 * size] @ Mi
    above = poles.imag >= 0.0
    double = np.where(poles.imag > 0.0, 2.0, 1.0)

    def of(i: int) -> ModalResponse:
        residues = double * right[i] * left[:, i]
        felt = above & (np.abs(residues) > LIMITS.min_residue_rel * np.abs(residues).max())
        return ModalResponse(np.asarray(poles[felt], np.complex128), np.asarray(residues[felt], np.complex128))

    return tuple(of(i) for i in range(n))
