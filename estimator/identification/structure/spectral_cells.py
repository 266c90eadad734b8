"""The spectrum of the inferred force at a place in narrow cells, and what a rotor of another tangent leaves there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.path.sensor_noise import aliased_psd, referred_psd
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.recorder import images

MIN_NOISE_SHARE = 1e-3  # of the power of the noisiest sensor's noise, that every sensor is given
MAX_CELLS = 260  # over the band


@dataclass(frozen=True, slots=True)
class Cells:
    """Mean spectra of one place."""

    power: Array  # (cells,) N^2/Hz, mean |F|^2
    n: Array  # (cells,) bins, over all blocks
    w: Array  # (cells,) rad/s
    A: NDArray[np.complex128]  # (cells,) tangent, the other caps answering
    colour: Array  # (cells,) shape of the force that the model has
    heard: Array  # (cells,) force that the noise of the sensors at all caps makes, over that of its own
    others: Array  # (cells,) (m/s^2)^2/Hz that the forces at the other caps move this one by
    back: Array  # (cells,) over S, the force that what sampling folds back at all caps makes
    white: Array  # (2, cells) over S, the force that the accelerations of free masses under the S of each cap make:
    # by the own sensor, by those at the other caps
    echoes: Array  # (images, cells) of that the own sensor's, by image
    images: Array  # (images, cells) Hz of these

    def at(self, keep: NDArray[np.bool_]) -> Cells:
        """Some of them."""
        return Cells(*(getattr(self, f.name)[..., keep] for f in fields(self)))

    def tangent(self, u: Array) -> NDArray[np.complex128]:
        """A with u[2:4], changes of k and c. Here and below u may be (numbers, m, 1), for (m, cells) at once."""
        return np.asarray(self.A - u[2] / self.w**2 + u[3] / (1j * self.w))

    def spectrum(self, u: Array, A: NDArray[np.complex128], factor: float | Array = 1.0) -> Array:
        """Of the inferred force, if A is the rotor's. u : ln S, ln of the noise; factor : of the force spectrum.

        Inferred is F - d a, d = A - self.A, of a = (F + self.A o) / A, where o is the motion by the other forces alone.
        What is no motion comes into it as the model infers it, whatever the rotor's A.
        """
        S, noise = finite_exp(u[0]), finite_exp(u[1])
        force = S * self.colour * factor + np.abs(A - self.A) ** 2 * self.others
        return np.asarray(force * np.abs(self.A / A) ** 2 + noise * self.heard + S * self.back)


def _noise_gain(point: WorkingPoint, i: int) -> Array:
    """(bins,) as Cells.heard: sensors are as noisy to each other as the fit has them, alike where it has none."""
    N = point.nu * point.S
    N = np.maximum(N, MIN_NOISE_SHARE * N.max()) if N.any() else np.ones(N.size)
    return np.asarray(referred_psd(point.data, point.A, N)[i] / N[i])


def cells_of(point: WorkingPoint, i: int) -> Cells:
    """Cells about evenly spread in log frequency, fine at the resonance."""
    data, power = point.data, mean_power(point, i)
    edges = np.unique(np.round(np.geomspace(12, power.size, MAX_CELLS)).astype(int))
    first = np.concatenate([[0], edges[:-1]])
    width = np.diff(np.append(first, power.size)).astype(np.float64)

    def mean(z: Array) -> Array:
        return np.asarray(np.add.reduceat(z, first, axis=-1) / width)

    w = 2 * np.pi * data.f_hz
    A, others = with_others_answering(point.A, point.S, i)
    through = np.abs(point.A[:, i].T) ** 2
    made = through * (point.S / point.S[i] / data.mass**2)[:, None]
    white = mean(np.stack([made[i], made.sum(axis=0) - made[i]]))
    echoes = through[i] * data.echoes[:, i]
    return Cells(
        mean(power), width * data.blocks, mean(w), mean(A.real) + 1j * mean(A.imag), mean(data.colour[i]),
        mean(_noise_gain(point, i)), mean(others), mean(aliased_psd(data, point.A, point.S)[i]), white,
        mean(echoes), mean(images(data.rate_hz, data.f_hz)[: len(echoes)]),
    )  # fmt: skip


def with_others_answering(A: NDArray[np.complex128], S: Array, i: int) -> tuple[NDArray[np.complex128], Array]:
    """(f,) force per acceleration of place i while the others answer, and (f,) PSD of the acceleration that the forces
    S (places,) at the others give it. A : (f, places, places)."""
    H = np.asarray(np.linalg.inv(A)[:, i], dtype=np.complex128)
    others = np.delete(np.arange(len(S)), i)
    return 1.0 / H[:, i], np.asarray(np.abs(H[:, others]) ** 2 @ S[others], dtype=np.float64)


def mean_power(point: WorkingPoint, i: int) -> Array:
    """(bins,) mean |F|^2 of the force at a place, N^2/Hz."""
    Z = point.spectra[i].reshape(point.data.blocks, -1, 2)
    power = np.einsum("bkc,bkc->k", Z, Z).astype(np.float64) / point.data.blocks / point.whitening.weight[i]
    return np.asarray(power if point.whitening.ringing is None else power / point.whitening.ringing.kept[i])


def finite_exp(z: Array) -> Array:
    """exp, kept finite on the way to the maximum."""
    return np.asarray(np.exp(np.clip(z, -80.0, 20.0)))
