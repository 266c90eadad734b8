"""Spectral lines of the residual force: shaft orders, mains and other tones, found and left out of the likelihood.

A tone is no part of a Gaussian force. Lines are sought in the residual force, whose spectrum is smooth, so that a
resonance is not taken for a line: a bin counts that exceeds those four and five bins away. Its neighbourhood is left
out of the Gram matrices and of the Jacobian. This costs a little information and no bias, and needs no shaft speed. The
motion of the tone stays in the displacement that the laws act along.
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

FALSE_ALARMS_PER_RECORD = 1e-5  # probability of a line in a record without any
MAX_BLOCK_LENGTHENING = 4  # factor, to resolve lines
MIN_LONG_BLOCKS = 60  # that lengthening must leave
STRONG_LINE_RATIO = 8.0  # power over the surroundings of a line that is left out before any fit
CONSTANT_SPEED_REL = 3e-3  # change of the speed up to which its lines do not move
MAX_TONE_FOURTH_MOMENT = (
    1.5  # mean square over squared mean of a bin's powers, block by block: 1 of a tone, 2 of random motion
)


def spectrum_by_bin(record: Record, B: Array | None, start: LinearStart | None) -> tuple[Array, Array, float]:
    """(bins, places) mean |F|^2 and |F|^4 over blocks, and the number of blocks.

    F is the residual force of the linear coefficients B; without B it is the acceleration.
    """
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
    """(places, columns) coefficients of the force balance at the linear start."""
    balance = build_balance(replace(record.model, effects=()))
    return balance.coefficients(initial(balance, start, {}).beta)


def strong_lines(record: Record) -> tuple[tuple[float, float], ...]:
    """Lines of the acceleration as (f1, f2) in Hz. A lightly damped resonance is as narrow, but its power varies from
    block to block."""
    power, fourth, blocks = spectrum_by_bin(record, None, None)
    return find_lines(power, blocks, record.grid.f_hz, STRONG_LINE_RATIO, fourth < MAX_TONE_FOURTH_MOMENT * power**2)


def find_lines(
    power: Array, blocks: float, f_hz: Array, min_ratio: float = 1.0, steady: NDArray[np.bool_] | None = None
) -> tuple[tuple[float, float], ...]:
    """Stretches (f1, f2) in Hz to leave out.

    power : (bins, places) mean power of `blocks` blocks. f_hz : (bins,) evenly spaced but for notches.
    min_ratio : least power of a line over its surroundings. steady : (bins, places) where a line may be; None: all.
    """
    from scipy.special import betaincinv  # scipy.stats would take 0.7 s to import

    n, independent = power.shape[0], max(blocks * 0.75, 1.0)  # neighbouring blocks share half their rows
    tail = betaincinv(4 * independent, independent, FALSE_ALARMS_PER_RECORD / power.size)
    limit = max(4.0 * (1.0 - tail) / tail, min_ratio)  # of an F ratio with 2 and 8 degrees of freedom per block
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

    Strong lines of the acceleration are left out first, so that the start is sound; then lines of the residual force.
    longest : factor by which blocks may be lengthened to resolve lines. known : stretches in Hz to leave out anyhow.
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
    # an effect that feeds energy makes resonances that the linear start does not have
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
    """The record and its start without the lines that move with a changing shaft speed, block by block; unchanged
    without a tacho or at constant speed. Raises DataError as `linear_start` does."""
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
    """The record with stretches (Hz) left out, in blocks that are `longer` times as long."""
    cells = CELLS_WITH_FORCE if record.force else FREQUENCY_CELLS
    grid = block_layout(record.rate_hz, record.model.band, (*notches(record.model), *lines), cells, longer)
    return replace(record, grid=grid, lines=lines)


def lines_in_words(lines: tuple[tuple[float, float], ...], speed_rpm: float | None, most: int = 6) -> str:
    """The centres of stretches (Hz) in words, the first `most` of them, with the shaft order where there is one."""
    words = []
    for a, b in lines[:most]:
        f, shaft = 0.5 * (a + b), (speed_rpm or 0.0) / 60.0
        order = round(f / shaft) if shaft else 0
        resolved = shaft > 2 * (b - a) and abs(f - order * shaft) < 0.25 * (b - a)
        words.append(f"{f:.0f} Hz ({order}X)" if resolved else f"{f:.0f} Hz")
    more = f" and {len(lines) - most} more" if len(lines) > most else ""
    return ", ".join(words) + more
