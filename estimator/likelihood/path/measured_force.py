"""The likelihood where the force is measured at every place: no determinant.

What is left, r = F(y) - f, is noise of the sensors: A n of those of motion and e of those of force, S_r = |A|^2 N + S.
The true force may be anything: every bin has an unknown of its own. Integrated out, it leaves the density of y given
the force measured, |r|^2 / S_r + log S_r - log |A|^2; but f is no random number about f measured, it is the other way
round, and c comes out too large by S over the power of the force. At its most likely value it leaves |r|^2 / S_r, whose
slope by A is 0 in the mean whatever the force was: dS_r takes back what the noise in y adds (errors in variables). So
the gradient has dS_r / S_r in place of the determinant's slope; S and N follow from log S_r + |r|^2 / S_r, which knows
no force. Laws act along the most likely path, which is independent of r: nothing is taken back there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.force_balance import Balance


def is_force_measured(balance: Balance) -> bool:
    """Whether the force is measured at every place of a balance."""
    return {c.row for c in balance.columns if c.kind == "f"} == set(range(len(balance.places)))


def noise_responses(balance: Balance, R: Complexes) -> Complexes:
    """(f, columns, places) responses by which sensor noise enters each column: R without that of laws."""
    out = R.copy()
    out[:, [c.kind == "law" for c in balance.columns]] = 0.0
    return out


def noise_bias(
    A: Complexes, R: Complexes, row: NDArray[np.intp], column: NDArray[np.intp], share: Array
) -> tuple[Array, Array]:
    """Gradient (E,) and Hessian (E, E) by the entries of B of half of sum(|A|^2 N / S_r), S_r held; A = B R.

    A : (f, P, P); R : (f, columns, P) as the noise sees them; share : (f, P, P), N of each place over S_r of each row.
    """
    seen = R[:, column]  # (f, E, P)
    own = share[:, row]
    g = np.einsum("fep,fep,fep->e", A[:, row].conj(), seen, own).real
    h = np.einsum("fap,fbp,fap->ab", seen.conj(), seen, own).real
    return g, np.where(row[:, None] == row, h, 0.0)


def residual_over_noise(power: Array, spread: Array, count: Array) -> float:
    """Residual power (cells, P) over its expected PSD `spread` (cells, P), summed. count : (cells,) bins."""
    return float(count @ (power / spread).sum(axis=1))
