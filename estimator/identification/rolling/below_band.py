"""The displacement below the band that laws with an even part make, along a block of a stream."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.motion.law_columns import Columns, Stretch
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS, LawStates
from estimator.likelihood.motion.stream_record import Record
from estimator.likelihood.response.below_band import (
    below_band_compliance,
    below_band_displacement,
    has_even_part,
    usual_parameters,
)
from estimator.likelihood.response.modal_response import compliance
from estimator.signals.band_limit import half_length

CENTRE_ROUNDS = 2  # the law is evaluated about the centre, then about the one that it makes: off by its slope squared


class SlowMotion:
    """Of the laws of a balance. reach : rows needed on either side of those that come out, 0 if no law is lopsided."""

    def __init__(self, columns: Columns, record: Record) -> None:
        """record : whose motion says how large the states of the laws are."""
        balance, self._columns, rms = columns.balance, columns, record.scales
        self._rate_hz, self._band = record.rate_hz, record.model.band
        self._laws: dict[int, list[int]] = {}
        for k, column in enumerate(balance.columns):
            if column.kind != "law":
                continue
            law, other = balance.laws[column.law], balance.other(column.row)
            p, sizes = law.p.copy(), np.concatenate([rms[column.row], rms[other] if other >= 0 else np.zeros(2)])
            p[list(law.linear)] = usual_parameters(law.effect)[list(law.linear)]
            if has_even_part(law.effect, p, sizes):
                self._laws.setdefault(column.row, []).append(k)
        self.reach = half_length(self._rate_hz, self._band) if self._laws else 0

    def whole(self, record: Record, B: Array) -> Record:
        """The record with it. B : (places, columns) coefficients of the balance."""
        if not self._laws:
            return record
        wide = replace(record, slow=None).stretch(-self.reach, record.motion.rows + self.reach)
        return replace(record, slow=self._along(wide, B)[:, self.reach : -self.reach])

    def stretch(self, record: Record, start: int, stop: int, B: Array) -> Stretch:
        """Rows start ... stop - 1 of a record with it."""
        if not self._laws:
            return record.stretch(start, stop)
        more = self.reach + MARGIN_ROWS
        slow = self._along(record.stretch(start - more, stop + more), B)[:, self.reach : -self.reach]
        return replace(record.stretch(start, stop), slow=slow)

    def _along(self, stretch: Stretch, B: Array) -> Array:
        """(places, rows), sound but for `reach` rows at either end; a missing sample has the mean of the force."""
        balance, P, inner = self._columns.balance, len(B), slice(MARGIN_ROWS, MARGIN_ROWS + stretch.rows)
        measured = np.zeros((P, stretch.t.size)) if stretch.slow is None else stretch.slow
        valid, out = stretch.valid[inner], np.zeros((P, stretch.rows))
        if not valid.any():
            return out
        D = np.stack([np.diag(np.diag(B[:, n * P : (n + 1) * P])) for n in (2, 1)], axis=-1)
        own = partial(compliance, mass=np.diag(B), D=balance.by_itself(D), places=balance.places, disc=balance.disc)
        response = below_band_compliance(own, self._rate_hz, self._band, balance.kinds)
        rest = response(np.zeros(1))[0].real
        for _ in range(CENTRE_ROUNDS):
            seen = replace(stretch, slow=measured + np.pad(out, [(0, 0), (MARGIN_ROWS, MARGIN_ROWS)], mode="edge"))
            states: dict[tuple[int, bool], LawStates] = {}
            push, out = {}, np.zeros_like(out)
            for row, laws in self._laws.items():
                total = np.sum([B[row, k] * self._columns.law(k, seen, states)[0] for k in laws], axis=0)
                mean = float(total[valid].mean())
                push[row] = np.where(valid, total - mean, 0.0)
                out -= mean * rest[:, row, None]
            for i, x in below_band_displacement(push, response, self._rate_hz, self._band[0]).items():
                out[i] += x
        return np.asarray(measured[:, inner] + out)
