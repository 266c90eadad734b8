"""The disc on its shaft by its response at the caps, and the change of that response by a law of the shaft."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes

from .rig import Model, Shaft
from .rotor import SHAFT_MATRICES, shaft_matrix
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True)
class Disc:
    """m (kg), C (N s/m), K (N/m) of its deflection s against the mean of the caps; shaft, ks, cs : as the model's."""

    shaft: Shaft
    ks: float
    cs: float
    m: float
    _: KW_ONLY
    C: float
    K: float

    @property
    def w0(self) -> float:
        """Resonance of the disc while the caps stand still, rad/s."""
        return float(np.sqrt(self.K / self.m))

    @property
    def comb_hz(self) -> tuple[float, float]:
        """Range of frequencies, Hz, in which a model with a breathing shaft is not judged."""
        low, high = LIMITS.near_resonance_rel
        return low * self.w0 / (2 * np.pi), high * self.w0 / (2 * np.pi)

    def blurred(self) -> Disc:
        """The disc with so much damping that an error of its resonance has little effect."""
        return replace(self, C=max(self.C, 2.0 * LIMITS.coarse_damping_ratio * float(np.sqrt(self.K * self.m))))

    def dynamic(self, w: Array) -> Complexes:
        """(f,) N/m, dynamic stiffness at w rad/s."""
        return np.asarray(self.K - self.m * w**2 + 1j * w * self.C)

    def follows(self, w: Array) -> Complexes:
        """(f,) deflection of the disc per mean displacement of the caps."""
        return np.asarray(self.m * w**2 / self.dynamic(w))

    def _yields(self, w: Array, mean: float, caps: Array) -> Complexes:
        """(f,) m/N, mean displacement of the caps per force on both caps. mean : N/m that the shaft lacks."""
        k, kc = SHAFT_MATRICES[self.shaft], self.ks + 1j * w * self.cs
        D = np.multiply.outer(kc, k[:2, :2]) - np.multiply.outer(
            kc**2 / (k[2, 2] * kc - self.m * w**2), np.outer(k[:2, 2], k[2, :2])
        )
        D += 0.5 * self._changed(w, self.dynamic(w) - mean)[:, None, None]
        for i, (mass, kL, c) in enumerate(caps):
            D[:, i, i] += kL + 1j * w * c - mass * w**2
        return np.asarray(np.linalg.solve(D, np.ones((2, 1)))[..., 0].mean(axis=1))

    def changed(self, w: Array, mean: float, first: complex, speed: float, caps: Array) -> Complexes:
        """(f,) N/m, mean response of the force m s1'' / 2 on each cap to the mean displacement of the caps.

        For g = mean + 2 Re(first exp(i phase)): that of the periodic system at fixed caps, Hill's determinant as a
        continued fraction, less half of what comes back through the caps a turn higher and lower. The log of the
        determinant of the rotor is then right to the second order. speed : rad/s; caps : (2, 3) m, kL, c of each.
        """
        beside = np.zeros(w.shape, complex)
        returned = np.zeros(w.shape, complex)
        for turn in (speed, -speed):
            tail = np.zeros(w.shape, complex)
            for k in range(LIMITS.harmonic_count, 0, -1):
                tail = abs(first) ** 2 / (self.dynamic(w + k * turn) - mean - tail)
            beside += tail
            there = w + turn
            passed = 0.5 * (self.m * w * there) ** 2 / ((self.dynamic(w) - mean) * (self.dynamic(there) - mean))
            returned += (passed * abs(first)) ** 2 * self._yields(there, mean, caps)
        return self._changed(w, self.dynamic(w) - mean - beside) - 0.5 * returned

    def _changed(self, w: Array, dynamic: Complexes) -> Complexes:
        """(f,) N/m, force on each cap per mean displacement of the caps, for a disc of this dynamic stiffness."""
        return np.asarray(-0.5 * (self.m * w**2) ** 2 * (1.0 / dynamic - 1.0 / self.dynamic(w)))


def disc_of(model: Model) -> Disc | None:
    """The disc of a model; None without one disc on a massless shaft."""
    m, ks, cs = model.mass.get("disc", 0.0), model.shaft_stiffness, model.shaft_damping
    if model.shaft not in ("chain", "beam") or m <= 0.0 or ks <= 0.0:
        return None
    per_shaft_stiffness = float(shaft_matrix(model.shaft, 1.0)[2, 2])
    C = max(per_shaft_stiffness * cs, 2.0 * LIMITS.min_damping_ratio * float(np.sqrt(per_shaft_stiffness * ks * m)))
    return Disc(shaft=model.shaft, ks=ks, cs=cs, m=m, C=C, K=per_shaft_stiffness * ks)
