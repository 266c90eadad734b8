"""Spectra of the path from a measured force to a motion, by cells of the band, and the aliased motion in both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes


@dataclass(frozen=True, slots=True)
class Folded:
    """density : (2, cells) PSD in the record from below and from beyond the rate, 0 where none is seen. passed : (2,
    cells) of these by the sensor; undone : the same by what is undone. back : (cells,) as `alike` gives it. likely :
    whether it is seen, or less sure than is asked for and likelier than noise of the sensor. rival : density of what is
    not seen, as noise of the sensor is about as likely by its coherence with the motion."""

    density: Array
    passed: Complexes
    undone: Complexes
    back: Complexes
    likely: bool
    rival: Array | None = None

    @property
    def seen(self) -> Array:
        """(cells,) PSD in the record."""
        return np.asarray(np.sum(self.density, axis=0))

    @property
    def force(self) -> Complexes:
        """(cells,) per acceleration in the record."""
        with np.errstate(invalid="ignore"):
            force = self.back * np.sum(self.density / self.passed, axis=0) / self.seen
        return np.where(self.seen > 0.0, force, self.back)

    @property
    def apart(self) -> Array:
        """(cells,) PSD of the force that is folded with no motion: where what comes from both sides of the rate is as
        strong and a sensor of velocity, which has it with two signs, sees none of it."""
        D = self.density / np.abs(self.passed) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = np.abs(np.sum(self.passed.conj() * D, axis=0)) ** 2 / self.seen
        return np.where(self.seen > 0.0, np.abs(self.back) ** 2 * np.maximum(np.sum(D, axis=0) - seen, 0.0), 0.0)

    def through(self, further: Complexes) -> Folded:
        """The aliased motion through a sensor with a further response (2, cells), given at the images."""
        return replace(self, passed=self.undone * np.stack([further[0].conj(), further[1]]))


@dataclass(frozen=True, slots=True, kw_only=True)
class PathSpectra:
    """Residual force R, acceleration a and measured force f of one place, by cells of the band.

    w : (cells,) rad/s. n : (cells,) independent numbers. rr, ra, aa, rf, af, ff : (cells,) mean |R|^2, R a*, |a|^2, R
    f*, a f* and |f|^2, one-sided PSD. A : (cells,) kg, tangent. H : (cells,) acceleration per force, the other places
    free; 1 / A of a place that is not coupled. noise : (cells,) PSD of acceleration of white sensor noise. hz :
    (cells,) width. unmeasured : share of the noise Q of the force that is an unmeasured force, not sensor noise. alike
    : (cells,) kg, force per acceleration of the aliased motion. folded : (cells,) PSD of the aliased acceleration.
    apart : (cells,) PSD of aliased force without motion. across : (cells,) PSD in R of sensor noise and aliased motion
    of other places. fold : the aliased motion, found or not; None before it is sought. bare : the spectra with the
    aliased motion; None where none was taken out.
    """

    w: Array
    n: Array
    rr: Array
    ra: Complexes
    aa: Array
    rf: Complexes
    af: Complexes
    ff: Array
    A: Complexes
    H: Complexes
    noise: Array
    hz: Array
    unmeasured: float = 0.0
    alike: Complexes | float = 0.0
    folded: Array | float = 0.0
    apart: Array | float = 0.0
    across: Array | float = 0.0
    fold: Folded | None = None
    bare: PathSpectra | None = None

    def share(self, Q: float) -> Array:
        """(cells,) share of noise in the power of the measured force. Q : N^2/Hz, its density."""
        return np.minimum(((1.0 - self.unmeasured) * Q + self.apart) / self.ff, 0.5)

    def answer(self, A: Complexes) -> Complexes:
        """(cells,) acceleration per force at another tangent A (cells,)."""
        return np.asarray(self.H / (1 + (A - self.A) * self.H))

    def through(self, further: Complexes) -> PathSpectra:
        """The spectra through a sensor with a further response (2, cells) at the images of the aliased motion."""
        if self.fold is None or self.bare is None:
            return self
        return replace(self.bare, unmeasured=self.unmeasured).less(self.fold.through(further))

    def less(self, fold: Folded) -> PathSpectra:
        """The spectra without the aliased motion that the measured force determines; its rest counts as noise."""
        alike = fold.force
        folded = np.minimum(fold.seen, 0.5 * self.ff / np.abs(alike) ** 2)
        determined = alike.conj() * folded / self.ff
        B, rest = determined * (self.A - alike), 1 - (determined * alike).real
        return replace(
            self,
            rr=self.rr - 2 * np.real(B.conj() * self.rf) + np.abs(B) ** 2 * self.ff,
            ra=self.ra - determined.conj() * self.rf - B * self.af.conj() + B * determined.conj() * self.ff,
            aa=self.aa - 2 * np.real(determined.conj() * self.af) + np.abs(determined) ** 2 * self.ff,
            rf=rest * (self.rf - B * self.ff),
            af=rest * (self.af - determined * self.ff),
            ff=rest**2 * self.ff, alike=alike, folded=rest * folded, apart=rest**2 * fold.apart, fold=fold, bare=self,
        )  # fmt: skip
