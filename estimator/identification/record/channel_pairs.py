"""Faults that two channels show together: copies, wrong polarity, swapped kinds, a unit that differs, a lost level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.fft import rfft

from estimator.arrays import Array, Complexes
from estimator.model.rig import MOTION_UNITS

from .channel_faults import ChannelRecord
from .channel_summary import longest_run, segment_starts, segments
from .findings import RecordFinding
from .thresholds import PIECE_ROWS, RECORD_LIMITS

DERIVATIVE_ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}  # of the displacement
UNIT_FACTORS = {  # between two units that are mixed up
    9.80665: "g taken for m/s^2",
    1000.0: "a factor of 1000, such as mm for m",
    25.4: "inches taken for millimetres",
    1e6: "a factor of 1e6, such as um for m",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class PairSpectra:
    """Averaged spectra of two channels at (f,) frequencies in Hz."""

    f: Array
    first: Array
    second: Array
    cross: Complexes

    @property
    def coherence(self) -> Array:
        """(f,) from 0 to 1."""
        both = self.first * self.second
        return np.abs(self.cross) ** 2 / np.where(both > 0.0, both, 1.0)


def pair_spectra(a: ChannelRecord, b: ChannelRecord) -> PairSpectra | None:
    """Spectra, each channel over its largest value, where both have samples; None with too few segments."""
    both = np.isfinite(a.y) & np.isfinite(b.y)
    size = min(RECORD_LIMITS.segment_samples, 1 << max(longest_run(both), 1).bit_length() - 1)
    if size < 64:
        return None
    window = np.hanning(size + 1)[:-1]
    sums, count = np.zeros((3, size // 2 + 1), np.complex128), 0
    for starts in segment_starts(both, size, RECORD_LIMITS.max_pair_segments):
        p, q = (rfft(segments(r.y, starts, size) * (window / _scale(r)), axis=1) for r in (a, b))
        sums += np.stack([np.sum(p * p.conj(), 0), np.sum(q * q.conj(), 0), np.sum(p.conj() * q, 0)])
        count += starts.size
    if count < RECORD_LIMITS.min_segments:
        return None
    sums /= count
    f = np.asarray(np.fft.rfftfreq(size, 1.0 / a.rate_hz))
    return PairSpectra(f=f[3:], first=sums[0, 3:].real, second=sums[1, 3:].real, cross=sums[2, 3:])


def find_pair_faults(records: Sequence[ChannelRecord], band: tuple[float, float]) -> list[RecordFinding]:
    """Findings on pairs of channels.

    Parameters
    ----------
    records : sequence of ChannelRecord
        Channels that move; none that is dead, frozen or of few levels.
    band : (float, float)
        Analysed band, Hz.
    """
    found: list[RecordFinding] = []
    copies: set[str] = set()
    for a, b in combinations([r for r in records if r.channel.kind in (*MOTION_UNITS, "force")], 2):
        if {a.channel.name, b.channel.name} & copies:
            continue
        if (copy := _copy(a, b)) is not None:
            copies.update(copy.unusable)
            found.append(copy)
        elif a.channel.place == b.channel.place and {a.channel.kind, b.channel.kind} <= MOTION_UNITS.keys():
            found += _same_dof(a, b, band)
    kept = [r for r in records if r.channel.kind in MOTION_UNITS and r.channel.name not in copies]
    return found + _level_steps(kept)


def _scale(record: ChannelRecord) -> float:
    """A size of the channel, for powers that neither overflow nor vanish."""
    return max(record.moments.high, -record.moments.low) or 1.0


def _finding(code: str, a: ChannelRecord, b: ChannelRecord, text: str, unusable: tuple[str, ...] = ()) -> RecordFinding:
    """A finding on two channels."""
    return RecordFinding(
        code=code,
        channels=(a.channel.name, b.channel.name),
        text=text,
        places=(a.channel.place, b.channel.place),
        condemned=unusable,
        unusable=unusable,
    )


def _copy(a: ChannelRecord, b: ChannelRecord) -> RecordFinding | None:
    """The second channel as a copy of the first one, but for gain and offset."""
    share, factor = _residual_of_copy(a, b)
    if share > RECORD_LIMITS.max_copy_residual_share:
        return None
    gain = factor * _scale(b) / _scale(a)
    exact = share < 1e-12
    if not exact:
        spectra = pair_spectra(a, b)
        if spectra is None or float(np.median(spectra.coherence)) < RECORD_LIMITS.min_copy_coherence:
            return None
    one, other = a.channel.name, b.channel.name
    how = "identical" if exact and gain == 1.0 else f"a copy: {gain:.4g} times {one}"
    polarity = ", with the polarity inverted" if gain < 0.0 else ""
    return _finding(
        "copied_channel",
        a,
        b,
        f"{one} and {other} carry the same signal, one sensor ({other} is {how}{polarity}): {other} is not used; check "
        "the cables and the signals in the rig file",
        (other,),
    )


def _residual_of_copy(a: ChannelRecord, b: ChannelRecord) -> tuple[float, float]:
    """Share of the power of the second channel that is not proportional to the first one, and the factor between them.

    Each channel is over its largest value. Share 1 where fewer than 64 samples are common or one does not move, and
    where the residual of the first samples alone is more than the share of a copy of the whole power.
    """
    total, products, means = 0, np.zeros((2, 2)), np.zeros(2)
    whole, max_share = b.moments.count * (b.moments.sd / _scale(b)) ** 2, RECORD_LIMITS.max_copy_residual_share
    for p, q in _common_pieces(a, b):
        total += p.size
        pieces = np.stack([p, q])
        own, weight = pieces.mean(axis=1), p.size / total
        products += (pieces - own[:, None]) @ (pieces - own[:, None]).T
        products += np.outer(own - means, own - means) * p.size * (1.0 - weight)
        means += (own - means) * weight
        if products[1, 1] - products[0, 1] ** 2 / max(products[0, 0], 1e-300) > (max_share + 1e-9) * whole:
            return 1.0, 0.0  # more samples only add to a residual
    (pp, pq), (_, qq) = products
    if total < 64 or not pp * qq > 0.0:
        return 1.0, 0.0
    factor = pq / pp
    share = 1.0 - pq * pq / (pp * qq)
    if share < 1e-9:  # rounding of sums: the residual itself is exact
        share = sum(
            float(np.sum((q - means[1] - factor * (p - means[0])) ** 2)) for p, q in _common_pieces(a, b)
        ) / qq  # fmt: skip
    return float(share), float(factor)


def _common_pieces(a: ChannelRecord, b: ChannelRecord) -> Iterator[tuple[Array, Array]]:
    """The samples that two channels both have, each over its largest value, some at a time."""
    for first in range(0, len(a.y), PIECE_ROWS):
        p, q = (np.asarray(r.y[first : first + PIECE_ROWS], np.float64) / _scale(r) for r in (a, b))
        both = np.isfinite(p) & np.isfinite(q)
        if both.any():
            yield (p, q) if both.all() else (p[both], q[both])


def _same_dof(a: ChannelRecord, b: ChannelRecord, band: tuple[float, float]) -> list[RecordFinding]:
    """Findings on two sensors of one degree of freedom: b over a must be (j w)^(difference of order)."""
    if (spectra := pair_spectra(a, b)) is None:
        return []
    use = (spectra.f >= band[0]) & (spectra.f <= min(band[1], 0.4 * a.rate_hz))
    use &= spectra.coherence > RECORD_LIMITS.min_same_dof_coherence
    if np.count_nonzero(use) < 4:
        return []
    orders = DERIVATIVE_ORDERS[b.channel.kind] - DERIVATIVE_ORDERS[a.channel.kind]
    ratio = (spectra.cross / np.where(spectra.first > 0.0, spectra.first, 1.0))[use] * _scale(b) / _scale(a)
    w = 2.0 * np.pi * spectra.f[use]
    gain, spread = _gain(ratio / (1j * w) ** orders)
    one, other = a.channel.name, b.channel.name
    if orders and spread > 0.5:
        _, spread_swapped = _gain(ratio * (1j * w) ** orders)
        if spread_swapped < 0.2:
            text = (
                f"{one} and {other} are swapped: as measured, {one} is the {b.channel.kind} and {other} the "
                f"{a.channel.kind}; check the kinds in the rig file, or the cables"
            )
            return [_finding("swapped_channels", a, b, text)]
    if spread > 0.3:
        return []
    if gain.real < 0.0:
        text = f"{one} and {other} of {a.channel.place} have opposite polarity: one sensor or one cable is inverted"
        return [_finding("inverted_channel", a, b, text)]
    size = abs(gain)
    for factor, words in UNIT_FACTORS.items():
        for expected in (factor, 1.0 / factor):
            if abs(size / expected - 1.0) < RECORD_LIMITS.max_gain_error:
                text = f"{one} and {other} of {a.channel.place} differ by a factor of {size:.4g}: {words}?"
                return [_finding("wrong_unit", a, b, text)]
    return []


def _gain(values: Complexes) -> tuple[complex, float]:
    """Median of complex gains, and their relative scatter about it."""
    gain = complex(np.median(values.real), np.median(values.imag))
    scatter = float(np.median(np.abs(values - gain)))
    return gain, scatter / abs(gain) if abs(gain) > 0.0 else np.inf


def _level_steps(records: Sequence[ChannelRecord]) -> list[RecordFinding]:
    """Channels whose level drops or jumps while the others keep theirs."""
    if len(records) < 2 or len(records[0].y) < 16 * RECORD_LIMITS.level_pieces:
        return []
    size = len(records[0].y) // RECORD_LIMITS.level_pieces
    levels = np.array([_levels_db(r.y, size, _scale(r)) for r in records])
    out = []
    for i, record in enumerate(records):
        others = np.delete(levels, i, axis=0)
        relative = levels[i] - np.mean(others, axis=0)
        there = relative[np.isfinite(relative)]
        if not there.size or np.ptp(there) <= RECORD_LIMITS.min_level_step_db:
            continue
        at, step = _largest_step(relative)
        steps_of_others = np.array([_step_at(o, at) for o in others])
        if abs(step) > RECORD_LIMITS.min_level_step_db and np.all(np.abs(steps_of_others) < 0.25 * abs(step)):
            word, cause = ("drops", "a loose sensor or cable") if step < 0.0 else ("rises", "a loose contact")
            name, time = record.channel.name, at * size / record.rate_hz
            text = f"{name} {word} by {abs(step):.0f} dB at {time:.3g} s and the other channels do not: {cause}?"
            out.append(
                RecordFinding(
                    code="level_step",
                    channels=(name,),
                    text=text,
                    places=(record.channel.place,),
                    rows=((at * size, len(record.y)),),
                )
            )
    return out


def _levels_db(y: Array, size: int, largest: float) -> Array:
    """(level_pieces,) level of each piece in dB below the largest value; NaN where half of the samples are missing."""
    out = np.full(RECORD_LIMITS.level_pieces, np.nan)
    for k in range(RECORD_LIMITS.level_pieces):
        piece = y[k * size : (k + 1) * size]
        there = np.isfinite(piece)
        if 2 * np.count_nonzero(there) > size:
            sd = float(np.std(piece if there.all() else piece[there], dtype=np.float64))
            out[k] = 20.0 * np.log10(max(sd / largest, 1e-15))
    return out


def _largest_step(level: Array) -> tuple[int, float]:
    """Piece at which the level steps most, and the step of the median in dB; four pieces on either side."""
    steps = [(_step_at(level, at), at) for at in range(4, RECORD_LIMITS.level_pieces - 3)]
    step, at = max(steps, key=lambda s: abs(s[0]))
    return at, step


def _step_at(level: Array, at: int) -> float:
    """Median after a piece less the median before it, if nearly all pieces lie on the side of the nearer median."""
    before, after = level[:at][np.isfinite(level[:at])], level[at:][np.isfinite(level[at:])]
    if before.size < 3 or after.size < 3:
        return 0.0
    low, high = float(np.median(before)), float(np.median(after))
    step, middle = high - low, 0.5 * (high + low)
    sides = np.sign(step) * np.concatenate([middle - before, after - middle])
    return step if np.mean(sides > 0.0) > 0.9 else 0.0
