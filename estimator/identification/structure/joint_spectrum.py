"""Likelihood of spectral matrices: a rotor whose bearings have structural modes beside them, under smooth forces.

The acceleration of the caps of one direction has the spectral matrix

    Sigma(w) = T diag(S_i(w)) T^H + diag(N_i n(w)),    T = -w^2 Z^-1,    Z = Z_0 + diag(B_i(jw) + Q_i(jw))

Z_0 is the dynamic stiffness of cap masses, shaft and disc. B_i is the bearing in series with its support, Q_i the parts
on the cap (see `estimator.model.background`). S_i is the spectrum of the force at cap i, a spline of ln S in ln f, and
N_i the white noise of the sensor. The averaged matrices are complex Wishart distributed. Fisher scoring finds the
maximum of their likelihood (Whittle 1953; Brillinger, Time Series, 1981, ch. 7).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from estimator.arrays import Array, Complexes, products
from estimator.likelihood.response.spectral_matrices import (
    derivative_rows,
    response_ends,
    rows_of_matrices,
    spectral_model,
)
from estimator.model.background import ModeForm, StructuralMode

from .cross_spectra import CrossSpectra, Work
from .excitation import spline_basis
from .thresholds import LIMITS

# in cap masses: a lighter support, or a heavier part on the cap, is a rotor of its own
MASS_RATIO_LIMITS: dict[ModeForm, tuple[float, float]] = {"support": (0.7, 300.0), "attached": (3e-4, 0.4)}


@dataclass(frozen=True, slots=True)
class ModePlace:
    """Where a structural mode is. cap : number of the cap among those of the spectra."""

    cap: int
    form: ModeForm


@dataclass(frozen=True, slots=True, kw_only=True)
class JointValues:
    """Values of all parameters, in logarithms.

    Parameters
    ----------
    force : (caps, splines) float64
        Coefficients of ln S.
    noise, stiffness, damping : (caps,) float64
        ln N, ln kL, ln c.
    modes : tuple of ModePlace
        Structural modes.
    q : (modes, 3) float64
        ln of frequency in Hz, of damping ratio, and of mass over the cap's.
    heavier : (loose,) float64
        ln of the mass of each loose cap over that of the problem. All else at the cap is in proportion to it.
    """

    force: Array
    noise: Array
    stiffness: Array
    damping: Array
    modes: tuple[ModePlace, ...] = ()
    q: Array = field(default_factory=lambda: np.zeros((0, 3)))
    heavier: Array = field(default_factory=lambda: np.zeros(0))

    def vector(self) -> Array:
        """(parameters,) all values as one vector."""
        parts = self.force.ravel(), self.noise, self.stiffness, self.damping, self.heavier, self.q.ravel()
        return np.concatenate(parts)

    def at_vector(self, vector: Array) -> JointValues:
        """The values with all parameters of a vector (parameters,) as of `vector`."""
        caps, splines = self.force.shape
        force, noise, stiffness, damping, heavier, q = np.split(
            vector, np.cumsum([caps * splines, caps, caps, caps, self.heavier.size])
        )
        return JointValues(
            force=force.reshape(caps, splines), noise=noise, stiffness=stiffness, damping=damping, modes=self.modes,
            q=q.reshape(-1, 3), heavier=heavier,
        )  # fmt: skip

    def with_mode(self, mode: ModePlace, q: Array) -> JointValues:
        """The values with one more mode."""
        return replace(self, modes=(*self.modes, mode), q=np.vstack([self.q, q]))

    def with_bearing(self, cap: int, stiffness: float, damping: float) -> JointValues:
        """The values with another bearing at a cap. stiffness : N/m. damping : N s/m."""
        all_stiffness, all_damping = self.stiffness.copy(), self.damping.copy()
        all_stiffness[cap], all_damping[cap] = np.log(stiffness), np.log(damping)
        return replace(self, stiffness=all_stiffness, damping=all_damping)

    def without_mode(self, k: int) -> JointValues:
        """The values without the k-th mode."""
        return replace(self, modes=(*self.modes[:k], *self.modes[k + 1 :]), q=np.delete(self.q, k, axis=0))


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPoint:
    """The spectral model at some values.

    values. log_likelihood : nats. s : (cells,) rad/s. D, B : (cells, caps) N/m, dynamic stiffness of each bearing,
    alone and in series with its support. T : (cells, caps, caps) 1/kg. S, N : (cells, caps) PSD of force and noise.
    signal : (cells, caps, caps) Sigma without noise. W : whitens Sigma, W Sigma W^H = 1. R : whitened measured matrix.
    """

    values: JointValues
    log_likelihood: float
    s: Complexes
    D: Complexes
    B: Complexes
    T: Complexes
    S: Array
    N: Array
    signal: Complexes
    W: Complexes
    R: Complexes


@dataclass(frozen=True, kw_only=True)
class JointSpectrum:
    """The likelihood of the spectral matrices of one direction.

    Parameters
    ----------
    spectra : CrossSpectra
        The measurement.
    Z0 : (cells, caps, caps) complex128
        Dynamic stiffness without bearings, N/m.
    laws : (cells, caps) complex128
        Mean tangents of the laws at each bearing, N/m.
    mass : (caps,) float64
        kg.
    shape : (cells, caps) float64
        Spectrum of the force that the model gives.
    octaves : float
        Least distance of the knots of ln S; infinite for a white force.
    fall_power : int
        Power of the frequency in ln S towards the upper edge of the band, as of an unknown filter; 0 for none.
    damping0 : (caps,) float64
        ln c about which the damping is expected.
    loose : tuple of int
        Caps whose mass is fitted.
    shaft : (cells, caps, caps) complex128
        Dynamic stiffness of the shaft, N/m, that sets these masses; empty where there are none.
    """

    spectra: CrossSpectra
    Z0: Complexes
    laws: Complexes
    mass: Array
    shape: Array
    damping0: Array
    loose: tuple[int, ...] = ()
    shaft: Complexes = field(default_factory=lambda: np.zeros((0, 0, 0), np.complex128))
    octaves: float = np.inf
    fall_power: int = 0
    work: Work = field(default_factory=Work)  # of this problem and of those made from it

    @cached_property
    def basis(self) -> Array:
        """(cells, splines) the curves of which ln S is made."""
        f = self.spectra.f_hz
        pieces = int(np.log2(f[-1] / f[0]) / self.octaves)
        splines = spline_basis(np.log(f), max(pieces, 1), min(LIMITS.spline_degree, pieces))
        fall = (f[:, None] / f[-1]) ** self.fall_power if self.fall_power else np.zeros((f.size, 0))
        return np.hstack([splines, fall])

    @property
    def flat(self) -> Array:
        """(splines,) coefficients of ln S = 1."""
        return np.append(np.ones(self.basis.shape[1] - 1), 0.0 if self.fall_power else 1.0)

    @property
    def refinements(self) -> int:
        """Steps from a white force to the form of its spectrum, each of which has to gain what a mode has to."""
        return sum(self.octaves <= own for own in LIMITS.tried_knot_octaves) + (self.fall_power > 0)

    def respaced(self, values: JointValues, old: JointSpectrum) -> JointValues:
        """Values of another spacing of the knots, as near as these knots allow."""
        coefficients = np.linalg.lstsq(self.basis, old.basis @ values.force.T, rcond=None)[0].T
        return replace(values, force=np.asarray(coefficients, np.float64))

    def at(self, values: JointValues) -> JointPoint:
        """The model at some values. Raises numpy.linalg.LinAlgError where Sigma is not positive."""
        spectra, caps = self.spectra, np.arange(self.mass.size)
        s = np.asarray(2j * np.pi * spectra.f_hz, np.complex128)
        D = np.exp(values.stiffness) + self.laws + s[:, None] * np.exp(values.damping)
        yielding, attached = np.zeros((2, *D.shape), np.complex128)
        for cap, mode in self.modes(values):
            yielding[:, cap] += mode.compliance(s)
            attached[:, cap] += mode.attached_stiffness(s)
        B = D / (1.0 + D * yielding)
        Z = self.Z0.copy()
        Z[:, caps, caps] += B + attached
        for cap, heavier in zip(self.loose, values.heavier.tolist(), strict=True):
            Z[:, cap] += np.expm1(-heavier) * self.shaft[:, cap]
        S = self.shape * np.exp(self.basis @ values.force.T)
        N = np.exp(values.noise) * spectra.noise
        nats, T, signal, W, R = spectral_model(Z, s, S, N, spectra.psd, spectra.n)
        prior, expected = self.prior
        apart = values.vector()[: expected.size] - expected
        nats -= 0.5 * float(apart @ prior @ apart)
        return JointPoint(values=values, log_likelihood=nats, s=s, D=D, B=B, T=T, S=S, N=N, signal=signal, W=W, R=R)

    def modes(self, values: JointValues) -> Iterator[tuple[int, StructuralMode]]:
        """Each structural mode with the number of its cap."""
        for where, (f_hz, damping, ratio) in zip(values.modes, np.exp(values.q).tolist(), strict=True):
            mass = ratio * float(self.mass[where.cap])
            yield where.cap, StructuralMode(form=where.form, mass=mass, frequency_hz=f_hz, damping=damping)

    def by_stiffness(self, point: JointPoint) -> list[Complexes]:
        """(cells, caps, caps) by cap: half of the derivative of whitened Sigma by the dynamic stiffness at the cap.

        The derivative by a stiffness dz is that times dz and its conjugate transpose.
        """
        columns, rows = response_ends(point.W, point.T, point.signal, point.s)
        return [columns[:, :, i, None] * rows[:, i, None, :] for i in range(self.mass.size)]

    def score(self, point: JointPoint) -> tuple[Array, Array]:
        """Rows of a least-squares problem whose normal equations are those of Fisher scoring.

        Returns (parameters, rows) derivatives and (rows,) residuals.
        """
        n = self.spectra.n
        columns, rows = response_ends(point.W, point.T, point.signal, point.s)
        changed = list(self._changes(point))
        dZ = np.zeros((len(changed), *point.S.shape), np.complex128)
        for k, (cap, dz) in enumerate(changed):
            if dz.ndim == 1:
                dZ[k, :, cap] = dz
            else:
                dZ[k] = dz
        cap_of = np.array([cap for cap, _ in changed])
        J = derivative_rows(point.W, point.s, point.S, point.N, self.basis, n, columns, rows, cap_of, dZ)
        self.work.add(J.size)
        return J, rows_of_matrices(point.R - np.eye(self.mass.size), n)

    def _changes(self, point: JointPoint) -> Iterator[tuple[int, Complexes]]:
        """Cap and derivative of its dynamic stiffness (cells,), or of that to all caps (cells, caps), by parameter.

        In the order of `JointValues.vector`, after force and noise.
        """
        values, s = point.values, point.s
        series, caps = (point.B / point.D) ** 2, range(self.mass.size)
        yield from ((i, series[:, i] * np.exp(values.stiffness[i])) for i in caps)
        yield from ((i, series[:, i] * s * np.exp(values.damping[i])) for i in caps)
        for cap, heavier in zip(self.loose, values.heavier.tolist(), strict=True):
            yield cap, -np.exp(-heavier) * self.shaft[:, cap]
        for cap, mode in self.modes(values):
            damp, den = mode.damping_term(s), mode.denominator(s)
            d_frequency = damp + 2.0 * mode.w0**2
            if mode.form == "support":
                through = point.B[:, cap] ** 2 / (mode.mass * den * den)
                yield from ((cap, through * dz) for dz in (d_frequency, damp, den))
            else:
                top, per = mode.w0**2 + damp, mode.mass * s * s / den**2
                yield from ((cap, per * dz) for dz in (d_frequency * (den - top), damp * (den - top), top * den))

    def matrices(self, rows: Array) -> Complexes:
        """(cells, caps, caps) Hermitian matrices of some rows, weighted once more."""
        caps, root = range(self.mass.size), np.sqrt(self.spectra.n)
        out = np.zeros((root.size, len(caps), len(caps)), np.complex128)
        parts = iter(rows.reshape(-1, root.size))
        for i in caps:
            out[:, i, i] = next(parts) * root
        for i, j in combinations(caps, 2):
            out[:, i, j] = (next(parts) + 1j * next(parts)) * (root / np.sqrt(2.0))
            out[:, j, i] = out[:, i, j].conj()
        return out

    def misfit(self, point: JointPoint) -> Array:
        """(caps,) rms of ln(measured / model) of the whitened spectra beyond their scatter."""
        n = self.spectra.n
        return np.asarray(np.sqrt(np.maximum(n @ (_squared_ln_ratio(point) - 1.0 / n[:, None]) / n.sum(), 0.0)))

    def dispersion(self, point: JointPoint) -> float:
        """Mean square of ln(measured / model) of the whitened spectra over its expectation."""
        return float(np.mean(self.spectra.n[:, None] * _squared_ln_ratio(point)))

    def coherence(self, point: JointPoint) -> tuple[float, int]:
        """Log-likelihood ratio, nats, of free cross spectra of the whitened caps in wide cells, and its parameters."""
        n, caps = self.spectra.n, range(self.mass.size)
        edges = np.geomspace(LIMITS.first_coherence_cell, n.size, LIMITS.coherence_cells + 1)[:-1]
        first = np.unique(np.append(0, np.round(edges).astype(int)))
        first = first[first < n.size]

        def summed(i: int, j: int) -> Complexes:
            return np.asarray(np.add.reduceat(n * point.R[:, i, j], first))

        nats = 0.0
        for i, j in combinations(caps, 2):
            share = np.abs(summed(i, j)) ** 2 / np.maximum((summed(i, i) * summed(j, j)).real, 1e-300)
            nats -= float(np.add.reduceat(n, first) @ np.log1p(-np.minimum(share, 1.0 - 1e-9)))
        return nats, len([*combinations(caps, 2)]) * 2 * first.size

    def maximised(self, values: JointValues, steps: int = 40, tolerance_nats: float = 0.1) -> JointPoint:
        """The point of largest likelihood, by damped Fisher scoring from some values.

        A value at its limit stays there as long as the likelihood rises beyond it: a step of all others that counts on
        its move would fail.
        """
        point = self.at(values)
        low, high = self._limits(values)
        prior, expected = self.prior
        known, damped = slice(expected.size), 1e-3
        for _ in range(steps):
            J, r = self.score(point)
            x = point.values.vector()
            information, gradient = products(J), J @ r
            information[known, known] += prior
            gradient[known] -= prior @ (x[known] - expected)
            free = np.flatnonzero(~((x <= low) & (gradient < 0.0) | (x >= high) & (gradient > 0.0)))
            information, gradient = information[np.ix_(free, free)], gradient[free]
            new: JointPoint | None = None
            while new is None and damped < 1e7:
                # a parameter without information does not move far
                more = np.diag(damped * np.diag(information) + 0.1)
                step = np.zeros(x.size)
                step[free] = np.clip(np.linalg.solve(information + more, gradient), -LIMITS.max_step, LIMITS.max_step)
                new = self._better(point, point.values.at_vector(np.clip(x + step, low, high)))
                damped = max(0.2 * damped, 1e-7) if new is not None else max(5.0 * damped, 1e-4)
            if new is None:
                break
            gained, point = new.log_likelihood - point.log_likelihood, new
            if gained < tolerance_nats:
                break
        return point

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Information on the parameters of forces, noise, stiffness and damping, and their expected values.

        (k, k) and (k,), in the order of `JointValues.vector`; nothing is known before on those that follow.
        """
        caps, about_mean = np.eye(self.mass.size), np.diag(self.flat) - np.outer(self.flat, self.flat) / self.flat.sum()
        force, unknown = np.kron(caps, about_mean / LIMITS.spline_prior_sd**2), np.zeros(2 * len(caps))
        expected = np.concatenate([np.zeros(len(force)), unknown, self.damping0])
        return block_diag(force, np.diag(unknown), caps / LIMITS.damping_prior_sd**2), expected

    def _better(self, point: JointPoint, values: JointValues) -> JointPoint | None:
        """The point at some values if it is likelier; None if not."""
        try:
            new = self.at(values)
        except np.linalg.LinAlgError:
            return None
        return new if new.log_likelihood > point.log_likelihood else None

    def _limits(self, values: JointValues) -> tuple[Array, Array]:
        """(parameters,) lower and upper limits: of the modes alone."""
        f = self.spectra.f_hz[[0, -1]] * LIMITS.band_margins_rel
        damping = LIMITS.damping_ratio_limits
        both = np.array([(f, damping, MASS_RATIO_LIMITS[mode.form]) for mode in values.modes]).reshape(-1, 2)
        high = np.full(values.vector().size, np.inf)
        low, first = -high, high.size - len(both)
        low[first:], high[first:] = np.log(both.T)
        return low, high


Solution = tuple[JointSpectrum, JointPoint]


def _squared_ln_ratio(point: JointPoint) -> Array:
    """(cells, caps) squared ln(measured / model) of the whitened spectra."""
    return np.asarray(np.log(np.maximum(np.einsum("fii->fi", point.R).real, 1e-300)) ** 2)
