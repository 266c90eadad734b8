"""The path from a measured force to the motion of a cap that a shaft couples to others: exact moments of a rotor of any
matrix, by cells, in place of a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.identification.structure.transfer_faults import coherent_remainder
from estimator.likelihood.fitting.transfer_function import PathSpectra, Peak, residual_and_noise

Complexes = NDArray[np.complex128]
CELLS, PLACES, HERE = 40, 3, 1


def mean(one: Complexes, other: Complexes, power: NDArray[np.float64]) -> Complexes:
    """(cells,) E[one other*] of signals given by their parts of independent sources, (cells, sources) each."""
    return np.asarray(np.einsum("ks,ks,s->k", one, other.conj(), power))


@pytest.mark.parametrize("unmeasured", [0.0, 1.0])
@pytest.mark.parametrize("coupled", [0.0, 1.0])
def test_noise_leaves_nothing_odd(coupled: float, unmeasured: float) -> None:
    """Where the tangent of the place by itself is small the motion is that of the others' forces."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(CELLS, PLACES, PLACES)) + 1j * rng.normal(size=(CELLS, PLACES, PLACES))
    A *= np.where(np.eye(PLACES) > 0.0, 1.0, coupled)
    A[::4, HERE, HERE] *= 1e-2
    H = np.linalg.inv(A)
    N, Q = 2e-3, 5e-2  # of the sensor at HERE; beside the force there, or of its sensor
    power = np.array([1.0, 2.0, 0.5, Q, N])  # true forces, Q, N
    own, zero = np.tile(np.eye(PLACES), (CELLS, 1, 1)), np.zeros((CELLS, PLACES, 1))
    alone = zero + np.eye(PLACES)[:, HERE : HERE + 1]
    motion = np.concatenate([H, unmeasured * H @ alone, alone], axis=2)
    force = np.concatenate([own, (1 - unmeasured) * alone, zero], axis=2)
    R = (A @ motion - force)[:, HERE]
    a, f = motion[:, HERE], force[:, HERE]
    one = np.ones(CELLS)
    r = PathSpectra(
        w=one, n=one, rr=mean(R, R, power).real, ra=mean(R, a, power), aa=mean(a, a, power).real,
        rf=mean(R, f, power), af=mean(a, f, power), ff=mean(f, f, power).real, A=A[:, HERE, HERE], H=H[:, HERE, HERE],
        noise=one, hz=one, unmeasured=unmeasured,
    )  # fmt: skip
    peak = Peak(0.0, np.array([np.log(Q), np.log(N)]), np.eye(2), r.A)
    odd, noise = coherent_remainder(r, peak)
    assert np.max(odd / noise) < 1e-20
    P, _, s = residual_and_noise(r, peak.A, peak.u)
    assert pytest.approx(s, rel=1e-12) == P
    far = replace(peak, u=np.array([np.log(1e3 * Q), np.log(N)]))
    assert np.all(coherent_remainder(r, far)[0] <= residual_and_noise(r, far.A, far.u)[0]), (
        "no more than is left, whatever is taken for Q"
    )
    d = 0.1 * (rng.normal(size=CELLS) + 1j * rng.normal(size=CELLS))
    changed = A.copy()
    changed[:, HERE, HERE] += d
    assert r.answer(r.A + d) == pytest.approx(np.linalg.inv(changed)[:, HERE, HERE], rel=1e-9)
