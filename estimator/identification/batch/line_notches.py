"""Lines in the inferred force: shaft orders, mains and other tones, found and left out of the likelihood.

A tone is no part of a Gaussian force, and a rotor's tones stand on its resonances. They are seen in the force, which is
otherwise smooth, so that a resonance is not taken for one: a bin that stands out from those three and four bins away.
Its neighbourhood is taken out of the Gram matrices and of the Jacobian alike, which costs a little information and no
bias, and needs no knowledge of the speed. The tone's motion stays in the displacement that the effects see.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import build_balance
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS
from estimator.likelihood.motion.stream_record import CELLS_WITH_FORCE, Record, notches, stretches
from estimator.parallel import map_threads
from estimator.signals.blocks import FREQUENCY_CELLS, block_layout, block_spectra, valid_blocks
from estimator.signals.moving_lines import MovingLines

from .linear_start import LinearStart, linear_start, may_be_fed_energy, with_denoised_displacement
from .maximum import initial

FALSE_ALARMS_PER_RECORD = 1e-5  # of a record
MAX_BLOCK_LENGTHENING, MIN_LONG_BLOCKS = 4, 60  # blocks as much longer as leave this many, to resolve lines
STRONG_LINE_RATIO = 8.0  # over its surroundings, of a tone that is taken out before anything is known of the rotor
CONSTANT_SPEED_REL = 3e-3  # of the speed, by which it changes where its lines stand still
MAX_TONE_FOURTH_MOMENT = (
    1.5  # mean square over squared mean of a bin's powers, block by block: 1 of a tone, 2 of random motion
)


def spectrum_by_bin(record: Record, B: Array | None, start: LinearStart | None) -> tuple[Array, Array, float]:
    """(bins, places) mean |F|^2 and |F|^4 of the force of the linear balance B, and the number of blocks; without B: of
    a."""
    columns = None
    if B is not None and start is not None:
        columns = record.columns(build_balance(replace(record.model, effects=())), start.widths)
    blocks = valid_blocks(record.motion.valid, record.grid)

    def part(group: NDArray[np.intp]) -> Array:
        first, last = int(group[0]) * record.grid.hop, int(group[-1]) * record.grid.hop + record.grid.size
        stretch = record.stretch(first, last)
        if B is None or columns is None:
            force: Array = stretch.a[:, MARGIN_ROWS:-MARGIN_ROWS]
        else:
            force = B @ columns.evaluate(stretch)[0]
        F = block_spectra(force, group - group[0], record.grid)
        power = F.real**2 + F.imag**2
        return np.stack([power.sum(axis=1), np.einsum("pbf,pbf->pf", power, power)])

    power, fourth = np.sum(map_threads(part, stretches(blocks, 12)), axis=0)
    return power.T / blocks.size, fourth.T / blocks.size, float(blocks.size)


def linear_coefficients(record: Record, start: LinearStart) -> Array:
    """(places, columns) coefficients of the linear start."""
    balance = build_balance(replace(record.model, effects=()))
    return balance.coefficients(initial(balance, start, {}).beta)


def strong_lines(record: Record) -> tuple[tuple[float, float], ...]:
    """Those that stand out of the acceleration, in Hz. A resonance of light damping does too in bins of its width, but
    its motion comes and goes from block to block."""
    power, fourth, blocks = spectrum_by_bin(record, None, None)
    return find_lines(power, blocks, record.grid.f_hz, STRONG_LINE_RATIO, fourth < MAX_TONE_FOURTH_MOMENT * power**2)


def find_lines(
    power: Array, blocks: float, f_hz: Array, least: float = 1.0, steady: NDArray[np.bool_] | None = None
) -> tuple[tuple[float, float], ...]:
    """Stretches (f1, f2) in Hz to leave out. power : (bins, places); f_hz : (bins,) evenly spaced but for notches.

    least : ratio to the surroundings that a line must have, at least. steady : (bins, places) where one may be.
    """
    from scipy.special import betaincinv  # scipy.stats would take 0.7 s to import

    n, independent = power.shape[0], max(blocks * 0.75, 1.0)  # neighbouring blocks share half their rows
    tail = betaincinv(4 * independent, independent, FALSE_ALARMS_PER_RECORD / power.size)
    limit = max(4.0 * (1.0 - tail) / tail, least)  # of an F ratio with 2 and 8 degrees of freedom per block
    padded = np.pad(power, ((5, 5), (0, 0)), mode="reflect")
    around = np.stack([padded[5 + d : 5 + d + n] for d in (-5, -4, 4, 5)])
    # of four neighbours the larger ones: the side of a steep spectrum is no line
    ratio = power / np.maximum(around.mean(axis=0), np.sort(around, axis=0)[2])
    spacing = float(np.min(np.diff(f_hz)))
    found: list[tuple[float, float]] = []
    there = ratio > limit if steady is None else (ratio > limit) & steady
    for k in np.flatnonzero(there.any(axis=1)):
        strength = float(ratio[k].max())
        half = (3.5 if strength < 300.0 else 4.5 if strength < 1e5 else 10.5) * spacing  # out to 3 % or less of S
        a, b = float(f_hz[k] - half), float(f_hz[k] + half)
        if found and a <= found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return tuple(found)


def start_without_lines(
    record: Record, longest: int = MAX_BLOCK_LENGTHENING, known: tuple[tuple[float, float], ...] = ()
) -> tuple[Record, LinearStart]:
    """The record with its lines left out, and its linear start. Raises DataError as `linear_start` does.

    Strong lines are taken out of the acceleration first, so that the start is sound; then what stands out of the force.
    longest : how much longer the blocks may be made, to resolve lines. known : stretches in Hz to leave out anyhow.
    """
    if not valid_blocks(record.motion.valid, record.grid).size:
        length = record.grid.size / record.rate_hz
        raise DataError(f"nowhere {length:.2g} s of samples without a gap; look after the link, or record for longer")
    if known:
        record = _without_lines(record, known, record.grid.longer)
    strong = strong_lines(record)
    if strong:
        blocks, longer = valid_blocks(record.motion.valid, record.grid).size, 1
        while 2 * longer <= longest and blocks / (2 * longer) >= MIN_LONG_BLOCKS:
            longer *= 2
        if longer > 1:
            record = _without_lines(record, known, longer)
            strong = strong_lines(record)
        record = _without_lines(record, (*known, *strong), longer)
    start = linear_start(record)
    power, fourth, count = spectrum_by_bin(record, linear_coefficients(record, start), start)
    # what feeds a rotor makes resonances that the start knows nothing of
    steady = (
        fourth < MAX_TONE_FOURTH_MOMENT * power**2
        if any(may_be_fed_energy(record.model, p) for p in record.model.places)
        else None
    )
    more = find_lines(power, count, record.grid.f_hz, steady=steady)
    if more:
        record = _without_lines(record, tuple(sorted((*known, *strong, *more))), record.grid.longer)
        start = linear_start(record)
    return with_denoised_displacement(record, start)


def start_without_moving_lines(record: Record, start: LinearStart) -> tuple[Record, LinearStart]:
    """The same without the lines that a changing speed carries along, where a tacho tells it: block by block, as the
    rolling estimate leaves them out. Raises DataError as `linear_start` does."""
    grid, model = record.grid, record.model
    if model.tacho is None:
        return record, start
    begins = np.arange(0, record.motion.rows - grid.size + 1, grid.hop)
    turned = record.phase[begins + grid.size - 1] - record.phase[begins]
    speed_hz = turned * record.rate_hz / (2 * np.pi * (grid.size - 1))
    blocks = valid_blocks(record.motion.valid, grid)
    if np.ptp(speed_hz[blocks]) <= CONSTANT_SPEED_REL * np.abs(speed_hz[blocks]).max():
        return record, start
    B, lines = linear_coefficients(record, start), MovingLines(grid.f_hz, orders=True)
    columns = record.columns(build_balance(replace(model, effects=())), start.widths)
    weights, before = np.ones((begins.size, grid.bins.size)), -1
    for group in stretches(blocks, 12):
        stretch = record.stretch(int(group[0]) * grid.hop, int(group[-1]) * grid.hop + grid.size)
        F = block_spectra(B @ columns.evaluate(stretch)[0], group - group[0], grid)
        for k, b in enumerate(group.tolist()):
            if b != before + 1:
                lines.restart()
            own, before = lines(F[:, k], float(speed_hz[b])), b
            if own is not None:
                weights[b] = own
    if (weights == 1.0).all():
        return record, start
    record = replace(record, weights=weights)
    return record, linear_start(record)


def _without_lines(record: Record, lines: tuple[tuple[float, float], ...], longer: int) -> Record:
    cells = CELLS_WITH_FORCE if record.force else FREQUENCY_CELLS
    grid = block_layout(record.rate_hz, record.model.band, (*notches(record.model), *lines), cells, longer)
    return replace(record, grid=grid, lines=lines)


def lines_in_words(lines: tuple[tuple[float, float], ...], speed_rpm: float | None, most: int = 6) -> str:
    """The middles of the stretches, as orders of the shaft where they are."""
    words = []
    for a, b in lines[:most]:
        f, shaft = 0.5 * (a + b), (speed_rpm or 0.0) / 60.0
        order = round(f / shaft) if shaft else 0
        resolved = shaft > 2 * (b - a) and abs(f - order * shaft) < 0.25 * (b - a)
        words.append(f"{f:.0f} Hz ({order}X)" if resolved else f"{f:.0f} Hz")
    more = f" and {len(lines) - most} more" if len(lines) > most else ""
    return ", ".join(words) + more
