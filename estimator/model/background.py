"""The background of a bearing: structural modes beside it, and the smooth spectrum of the force that excites it.

A structural mode stands under the bearing or sits on its cap. With s = jw, D the dynamic stiffness of the bearing:

    support:   a mass M on a spring and a damper, in series with the bearing; its compliance is 1 / (M den)
    attached:  a mass M on the cap by a spring and a damper; its dynamic stiffness is M s^2 (w0^2 + 2 zeta w0 s) / den

    den = s^2 + 2 zeta w0 s + w0^2

A law of the bearing acts along the deflection of the bearing, the motion of the cap less that of the support.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any, Literal

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.errors import ModelError

from .thresholds import LIMITS

ModeForm = Literal["support", "attached"]
NO_EQUIVALENT = "no modes under the bearing are equivalent"


@dataclass(frozen=True, slots=True, kw_only=True)
class StructuralMode:
    """A structural mode at a bearing cap.

    Parameters
    ----------
    form : {"support", "attached"}
        Under the bearing, or on the cap.
    mass : float
        Modal mass, kg; in cap masses where the mass of the cap is unknown.
    frequency_hz : float
        Natural frequency of the mode on its own, Hz.
    damping : float
        Damping ratio.
    """

    form: ModeForm
    mass: float
    frequency_hz: float
    damping: float

    def denominator(self, s: NDArray[Any]) -> Complexes:
        """s^2 + 2 zeta w0 s + w0^2 at s (f,) rad/s."""
        return np.asarray(s * s + self.damping_term(s) + self.w0**2)

    @property
    def w0(self) -> float:
        """Natural frequency, rad/s."""
        return 2.0 * np.pi * self.frequency_hz

    def damping_term(self, s: NDArray[Any]) -> Complexes:
        """2 zeta w0 s at s (f,) rad/s."""
        return np.asarray(2.0 * self.damping * self.w0 * s, np.complex128)

    def compliance(self, s: NDArray[Any]) -> Complexes:
        """(f,) m/N, displacement of a support per force of the bearing at s (f,) rad/s; 0 of a part on the cap."""
        if self.form != "support":
            return np.zeros(s.shape, np.complex128)
        return np.asarray(1.0 / (self.mass * self.denominator(s)), np.complex128)

    def attached_stiffness(self, s: NDArray[Any]) -> Complexes:
        """(f,) N/m, dynamic stiffness that a part adds to the cap at s (f,) rad/s; 0 of a support."""
        if self.form != "attached":
            return np.zeros(s.shape, np.complex128)
        return np.asarray(self.mass * s * s * (self.w0**2 + self.damping_term(s)) / self.denominator(s), np.complex128)


def all_under_bearing(
    stiffness: float, damping: float, modes: Sequence[StructuralMode]
) -> tuple[float, float, list[StructuralMode]]:
    """The bearing and structural modes under it that move the cap as a bearing with modes of both forms does.

    The motion of the cap alone does not tell one from the other where damping is light. The modes under the bearing are
    the zeros of the dynamic stiffness at the cap, and their masses its slopes there.

    Parameters
    ----------
    stiffness, damping : float
        Of the bearing, N/m and N s/m.
    modes : sequence of StructuralMode
        Modes under the bearing and on the cap.

    Returns
    -------
    stiffness, damping, modes
        Of the equivalent bearing, and under it.

    Raises
    ------
    ModelError
        No modes under a bearing are equivalent: the bearing is damped beyond critical.
    """
    w = modes[0].w0  # unit of s

    def product(some: Iterable[StructuralMode]) -> Polynomial:
        factors = (Polynomial([(m.w0 / w) ** 2, 2.0 * m.damping * m.w0 / w, 1.0]) for m in some)
        return prod(factors, start=Polynomial([1.0]))

    D = Polynomial([stiffness, damping * w])
    under, on = ([m for m in modes if m.form == form] for form in ("support", "attached"))
    above = product(under) + D * sum(product(m for m in under if m is not own) / (own.mass * w * w) for own in under)
    loads = (
        own.mass * w * w * Polynomial([0.0, 0.0, (own.w0 / w) ** 2, 2.0 * own.damping * own.w0 / w])
        * product(m for m in on if m is not own) for own in on
    )  # fmt: skip
    top = D * product(under) * product(on) + above * sum(loads, start=Polynomial([0.0]))
    bottom, slope = above * product(on), top.deriv()
    zeros = top.roots()
    alone = zeros[np.abs(zeros.imag) <= 1e-9 * np.abs(zeros)].real
    if alone.size != 1:
        raise ModelError(NO_EQUIVALENT)
    per = float((slope(alone[0]) / bottom(alone[0])).real)  # dynamic stiffness of the bearing per s
    out = []
    for zero in zeros[zeros.imag > 1e-9 * np.abs(zeros)]:
        mass = -0.5 / float((bottom(zero) / slope(zero) * np.conj(zero)).real) / (w * w)
        if mass <= 0.0:
            raise ModelError(NO_EQUIVALENT)
        w0 = float(np.abs(zero))
        out.append(StructuralMode(form="support", mass=mass, frequency_hz=w0 * w / (2.0 * np.pi),
                                  damping=float(-zero.real / w0)))  # fmt: skip
    return -per * float(alone[0]), per / w, out


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingBackground:
    """The background of one place.

    Parameters
    ----------
    modes : tuple of StructuralMode
        Structural modes.
    stiffness, damping : float
        Of the bearing with the mean tangents of its laws, N/m and N s/m, that the support is in series with.
    f_hz, psd_rel : (knots,) float64
        Spectrum of the force over that of the model, mean 1; linear between the knots in logarithms.
    noise_ratio : float
        Power of the sensor noise, referred to force, over that of the force: a start of the fit.
    knot_octaves : float
        Distance of the knots of the spline behind `psd_rel`; infinite of a white force.
    fall_power : int
        Power of the frequency in the logarithm of the spectrum towards the upper edge of the band; 0 for none.
    stiffness_sd_rel, damping_sd_rel : float
        Standard deviations that the unknown background adds to those of kL and c, relative.
    """

    modes: tuple[StructuralMode, ...]
    stiffness: float
    damping: float
    f_hz: Array
    psd_rel: Array
    noise_ratio: float = 0.0
    knot_octaves: float = np.inf
    fall_power: int = 0
    stiffness_sd_rel: float = 0.0
    damping_sd_rel: float = 0.0

    def agrees_with(self, other: BearingBackground) -> bool:
        """Whether another background has the same modes, and a bearing as stiff and damped within its certainty."""
        if [m.form for m in self.modes] != [m.form for m in other.modes]:
            return False
        stiffness_sd, damping_sd = np.hypot([self.stiffness_sd_rel, self.damping_sd_rel], LIMITS.min_change_rel)
        return bool(
            abs(self.stiffness / other.stiffness - 1.0) < 0.5 * stiffness_sd
            and abs(self.damping / other.damping - 1.0) < 0.5 * damping_sd
        )

    def deflection(self, s: NDArray[Any]) -> Complexes:
        """(f,) deflection of the bearing per displacement of the cap at s (f,) rad/s."""
        D = self.stiffness + self.damping * s
        return np.asarray(1.0 / (1.0 + D * sum(m.compliance(s) for m in self.modes)), np.complex128)

    def attached_stiffness(self, s: NDArray[Any]) -> Complexes:
        """(f,) N/m, dynamic stiffness that masses on the cap add at s (f,) rad/s."""
        return np.asarray(sum((m.attached_stiffness(s) for m in self.modes), np.zeros(s.shape, np.complex128)))

    def force_shape(self, f_hz: Array) -> Array:
        """(f,) spectrum of the force at f_hz over that of the model."""
        return np.asarray(np.exp(np.interp(np.log(f_hz), np.log(self.f_hz), np.log(self.psd_rel))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """The background of all places of a rig, by place; a place without an entry has a white force and no mode.

    Parameters
    ----------
    at : mapping of str to BearingBackground
        By place.
    """

    at: Mapping[str, BearingBackground] = field(default_factory=dict)

    @property
    def longest_ringing_s(self) -> float:
        """1 / (zeta w0) of the mode that rings longest, s; 0 without a mode."""
        modes = [m for own in self.at.values() for m in own.modes]
        return max((1.0 / (m.damping * m.w0) for m in modes), default=0.0)

    def agrees_with(self, other: Background | None) -> bool:
        """Whether another background has the same modes, and bearings as stiff and damped within their certainty."""
        if other is None or self.at.keys() != other.at.keys():
            return False
        return all(own.agrees_with(other.at[place]) for place, own in self.at.items())

    def deflections(self, places: tuple[str, ...], s: NDArray[Any]) -> Complexes:
        """(f, places) deflection of each bearing per displacement of its cap at s (f,) rad/s."""
        one = np.ones(s.shape, np.complex128)
        return np.stack([self.at[p].deflection(s) if p in self.at else one for p in places], axis=1)

    def attached_stiffness(self, places: tuple[str, ...], s: NDArray[Any]) -> Complexes:
        """(f, places) N/m at s (f,) rad/s."""
        none = np.zeros(s.shape, np.complex128)
        return np.stack([self.at[p].attached_stiffness(s) if p in self.at else none for p in places], axis=1)

    def force_shapes(self, places: tuple[str, ...], f_hz: Array) -> Array:
        """(places, f) spectrum of the force at each place over that of the model."""
        flat = np.ones(f_hz.size)
        return np.stack([self.at[p].force_shape(f_hz) if p in self.at else flat for p in places])
