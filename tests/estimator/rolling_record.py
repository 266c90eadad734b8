"""A whole record as a rolling estimate holds its motion, and its Gram matrices, for tests of the rolling likelihood."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.identification.rolling.start import RollingStart, first_fit, start_without_lines
from estimator.likelihood.motion.force_balance import Balance, force_channels, motion_channels, shaft_reaction
from estimator.likelihood.motion.stream_record import CELLS_WITH_FORCE, Record, as_record, gather, notches
from estimator.likelihood.path.gram_likelihood import Evidence
from estimator.model.rig import Model
from estimator.signals.band_limit import BandLimit
from estimator.signals.blocks import FREQUENCY_CELLS, FrequencyNodes, block_layout, frequency_nodes

Floats = NDArray[np.float64]


def record_of(model: Model, y: Floats, rate_hz: float) -> Record:
    """The record of y (n, channels), SI."""
    used = [*motion_channels(model), *force_channels(model).values()]
    kinds = [model.channels[c].kind for c in used]
    stream = BandLimit(kinds, rate_hz, model.band, shaft_reaction(model), slow=True)
    cells = CELLS_WITH_FORCE if force_channels(model) else FREQUENCY_CELLS
    grid = block_layout(rate_hz, model.band, notches(model), cells)
    return as_record(model, rate_hz, [part for part in (stream.push(y[:, used]), stream.flush()) if part.rows], grid)


def started(model: Model, y: Floats, rate_hz: float) -> tuple[Record, RollingStart]:
    """The record without its lines, and the start from a fit of all of it."""
    record = record_of(model, y, rate_hz)
    found, point = first_fit(model, y, rate_hz, record.grid.size // 2)
    return start_without_lines(record, found, point)


def evidence_of(
    record: Record, balance: Balance, widths: Floats, linear: Floats | None = None, nodes: FrequencyNodes | None = None
) -> Evidence:
    """What a record says about a balance. nodes : of the Jacobian; None: every bin."""
    gram, blocks, tangents = gather(record, balance, widths, linear)
    nodes = frequency_nodes(record.grid) if nodes is None else nodes
    return Evidence(balance=balance, grid=record.grid, gram=gram, blocks=blocks, tangents=tangents, nodes=nodes)
