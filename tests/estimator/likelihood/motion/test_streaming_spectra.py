"""Blocks one at a time, laws once a row, single-precision transforms: the Gram matrices of the whole record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_rig import RATE, rig_model, rig_record
from rolling_record import record_of

from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import build_balance
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.stream_record import Record
from estimator.likelihood.motion.streaming_spectra import BlockSpectra
from estimator.signals.blocks import block_spectra, gram_by_cell

EFFECTS = ("cubic", "coulomb", "bouc_wen", "quintic", "cross_coupling")  # smooth, with a jump, with a memory
BLOCKS, GAP = (0, 1, 2, 3, 6, 7), 6  # the last two follow on nothing


@pytest.fixture(scope="module")
def record() -> Record:
    return record_of(rig_model(*EFFECTS), rig_record(2.5, seed=3), RATE)


def columns_of(record: Record, fine: int | None = None) -> Columns:
    balance = build_balance(record.model, search=False)
    return Columns(balance, record.scales, 0.05 * record.scales, fine=fine)


@pytest.mark.slow
def test_the_same_gram_matrices_and_tangents_as_of_whole_blocks(record: Record) -> None:
    grid, columns = record.grid, columns_of(record)
    k = len(columns.balance.columns)
    own = np.flatnonzero([c.kind != "law" or c.law < 8 for c in columns.balance.columns])
    stream = BlockSpectra(columns, own, grid)
    weights = np.ones(grid.bins.size)
    weights[100:110], weights[110:120] = 0.0, 2.0
    B = np.random.default_rng(0).normal(size=(4, k)) / record.rms("a").mean()
    for turn, block in enumerate(BLOCKS):
        wide = turn in (0, 2, 5)
        asked = np.arange(k) if wide else own
        if block == GAP:
            stream.restart()
        stretch = record.stretch(block * grid.hop, block * grid.hop + grid.size)
        Z, tangents = stream.take(stretch, wide)
        z, sums = columns.evaluate(stretch)
        exact = block_spectra(z[asked], np.zeros(1, np.intp), grid)
        for w in (None, weights):
            G = gram_by_cell(exact if w is None else exact * np.sqrt(w), grid)
            size = np.sqrt(np.einsum("ckk->k", G))
            assert np.abs(Z.gram(grid, w) - G).max(axis=0) / np.outer(size, size) == pytest.approx(0.0, abs=2e-7)
        assert tangents == pytest.approx(sums[asked], rel=1e-9, abs=1e-9 * np.abs(sums).max())
        F = B[:, asked] @ exact[:, 0]
        assert Z.force(B[:, asked], np.arange(asked.size)) == pytest.approx(F, rel=1e-4, abs=1e-5 * np.abs(F).max())


def test_motion_of_a_nanometre_and_of_a_metre(record: Record) -> None:
    """Powers of displacement beyond the reach of single precision."""
    for factor in (1e-6, 1e6):
        m = record.motion
        motion = replace(m, a=factor * m.a, v=factor * m.v, x=factor * m.x, u=factor * m.u)  # type: ignore[type-var]
        columns = columns_of(replace(record, motion=motion))
        stretch = replace(record, motion=motion).stretch(0, record.grid.size)
        G = BlockSpectra(columns, np.arange(len(columns.balance.columns)), record.grid).take(stretch, False)[0]
        exact = gram_by_cell(
            block_spectra(columns.evaluate(stretch)[0], np.zeros(1, np.intp), record.grid), record.grid
        ).sum(axis=0)
        size = np.sqrt(np.diag(exact))
        assert (size > 0).all()
        assert G.gram(record.grid).sum(axis=0) / np.outer(size, size) == pytest.approx(
            exact / np.outer(size, size), abs=1e-6
        )


def test_a_force_that_is_no_number_is_named(record: Record) -> None:
    columns = columns_of(record)
    stretch = record.stretch(0, record.grid.size)
    stretch.x[0, 5000] = np.nan
    with pytest.raises(DataError, match=r"cubic at bearing1.x is not finite"):
        BlockSpectra(columns, np.flatnonzero([c.kind == "law" for c in columns.balance.columns]), record.grid).take(
            stretch, False
        )
