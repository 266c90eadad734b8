"""Forces with memory in a rolling fit: their mean responses, about the point where the fit is."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.force_balance import Balance
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.stream_record import Record


def linear_of(balance: Balance, B: Array) -> Array:
    """(places, 3) m, kL, c of coefficients B, without what the shaft adds."""
    P = len(B)
    i = np.arange(P)
    parts = [B[i, i], B[i, 2 * P + i] - balance.fixed[i, 2 * P + i], B[i, P + i] - balance.fixed[i, P + i]]
    return np.stack(parts, axis=1)


class HiddenStates:
    """Of the columns of a balance that have memory. columns : (m,) which; dressing : (f, columns) at f_hz, their
    response to the acceleration of their place, beside which their mean tangents count for nothing; None without any.
    """

    def __init__(self, columns: Columns, f_hz: Array) -> None:
        balance, self._columns, self._f_hz = columns.balance, columns, f_hz
        laws = {k: balance.laws[c.law] for k, c in enumerate(balance.columns) if c.kind == "law"}
        self.columns = np.array([k for k, law in laws.items() if law.effect.kind == "memory"], np.intp)
        self.dressing: Complexes | None = None

    def follow(self, B: Array, record: Record | None = None) -> None:
        """To the point with coefficients B (places, columns).

        record : of whose motion a response is an average; without one only exact responses are renewed.
        """
        if not self.columns.size:
            return
        self._columns.linear[:] = linear_of(self._columns.balance, B)
        if self.dressing is None:
            self.dressing = np.zeros((self._f_hz.size, len(self._columns.balance.columns)), complex)
        stretch = None if record is None else record.stretch(0, record.motion.rows)
        for k in self.columns.tolist():
            T = self._columns.mean_response(k, stretch, self._f_hz)
            if T is not None:
                self.dressing[:, k] = -T / (2 * np.pi * self._f_hz) ** 2
