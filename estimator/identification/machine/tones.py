"""Narrow lines of the measured spectra: kind, amplitude and significance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array
from estimator.model.rig import LineBand

from .machine_survey import ShaftSpeed, StrikeTrain, Tone, ToneKind
from .spectra import LevelSpectrum
from .thresholds import LIMITS

STRONG_ORDERS = range(1, 6)  # of every shaft, also where a bearing strikes


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A significant line of one channel.

    hz : Hz. half_width_hz : to either side, within which it is not resolved. amplitude : peak, in the channel's unit.
    log_p : of the record, everything searched paid for. power_ratio : over the noise. narrow : whether it is no
    resonance, because no structure is damped as little or because its power is steady. has_cause : whether it is known
    to be a harmonic of shaft or mains. range_rel : of an order, the least and largest speed over the mean.
    """

    channel: str
    hz: float
    half_width_hz: float
    amplitude: float
    log_p: float
    power_ratio: float
    narrow: bool
    has_cause: bool = False
    range_rel: tuple[float, float] = (1.0, 1.0)

    @property
    def band(self) -> LineBand:
        """The band that holds the line, skirts of one that wanders included."""
        reach = LIMITS.reach_half_widths * self.half_width_hz
        power = self.power_ratio * LIMITS.hann_bin_correlation * self.half_width_hz
        low_hz, high_hz = (self.hz * end for end in self.range_rel)
        return LineBand(
            low_hz=low_hz - reach,
            high_hz=high_hz + reach,
            power_over_psd_hz=power,
            has_cause=self.has_cause,
            swept=high_hz > low_hz,
        )


def lines_to_leave_out(
    lines: Sequence[Line], band: tuple[float, float], speed: ShaftSpeed | None = None
) -> list[Line]:  # fmt: skip
    """Lines to leave out of a force balance: too narrow for a resonance, beside the band, or of shaft and mains.

    Parameters
    ----------
    lines : sequence of Line
        Of all channels.
    band : (float, float)
        Hz.
    speed : ShaftSpeed or None
        Of the shaft; its wander widens its harmonics.
    """
    mains = _mains_hz(lines, speed)

    def is_harmonic(line: Line) -> bool:
        if line.half_width_hz > LIMITS.max_wander_rel * line.hz:
            return False
        return shaft_order(line, speed) in STRONG_ORDERS or mains is not None and _is_mains(line, mains)

    known = [replace(line, has_cause=is_harmonic(line)) for line in lines]
    return [line for line in known if line.narrow or not band[0] < line.hz < band[1] or line.has_cause]


def joined_bands(bands: Iterable[LineBand]) -> list[LineBand]:
    """Bands of lines of several channels, rising, overlapping ones joined.

    Parameters
    ----------
    bands : iterable of LineBand
        In any order.
    """
    out: list[LineBand] = []
    for band in sorted(bands, key=lambda band: band.centre_hz):
        if out and band.low_hz <= out[-1].high_hz:
            last = out.pop()
            band = LineBand(
                low_hz=last.low_hz,
                high_hz=max(band.high_hz, last.high_hz),
                power_over_psd_hz=max(band.power_over_psd_hz, last.power_over_psd_hz),
                has_cause=band.has_cause and last.has_cause,
                swept=band.swept or last.swept,
            )
        out.append(band)
    return out


def significant_lines(spectra: Mapping[str, Sequence[LevelSpectrum]]) -> list[Line]:
    """Lines of all channels, clearest first; of a line that several resolutions show, the clearest.

    spectra : channel -> its spectra.
    """
    searched = sum(level.power.size for levels in spectra.values() for level in levels)
    lines: list[Line] = []
    for channel, levels in spectra.items():
        found = [line for level in levels for line in _lines_of(channel, level, float(np.log(max(searched, 1))))]
        lines += _resolved(found)
    return sorted(lines, key=lambda line: line.log_p)


def _lines_of(channel: str, level: LevelSpectrum, log_searched: float) -> list[Line]:
    """Significant peaks of one spectrum."""
    P, edge = level.power, LIMITS.edge_bins
    inner = np.arange(edge, P.size - edge)
    beside = (P[edge + d : edge + d + inner.size] for d in (-2, -1, 1, 2))
    peaks = inner[np.all([P[edge : edge + inner.size] > power for power in beside], axis=0)]
    log_p = level.log_p(peaks) + log_searched
    clear = np.flatnonzero(log_p < np.log(LIMITS.max_false_tone_chance))
    clear = clear[np.argsort(log_p[clear])][: LIMITS.max_lines_per_level]
    out = []
    for k, own in zip(peaks[clear], log_p[clear], strict=True):
        lobe = slice(k - LIMITS.lobe_bins, k + LIMITS.lobe_bins + 1)
        power = np.maximum(P[lobe] - level.noise[k], 0.0)
        hz = float(np.arange(lobe.start, lobe.stop) @ power / power.sum() / level.seconds)
        damping = 0.5 * LIMITS.hann_half_power_bins / level.seconds / hz
        out.append(
            Line(
                channel=channel,
                hz=hz,
                half_width_hz=LIMITS.resolution_bins / level.seconds,
                amplitude=float(np.sqrt(power.sum() / LIMITS.hann_bin_correlation)),
                log_p=float(own),
                power_ratio=float(P[k] / level.noise[k]),
                narrow=damping < LIMITS.min_damping_ratio or level.is_steady(int(k)),
            )
        )
    return out


def _resolved(lines: Iterable[Line]) -> list[Line]:
    """Lines of one channel without duplicates of a clearer line, each at the frequency of the finest resolution."""
    groups: list[list[Line]] = []
    for line in sorted(lines, key=lambda line: line.log_p):
        near = (g for g in groups if abs(line.hz - g[0].hz) <= 2.0 * max(line.half_width_hz, g[0].half_width_hz))
        group = next(near, None)
        if group is None:
            groups.append([line])
        elif abs(line.hz - group[0].hz) <= group[0].half_width_hz:
            group.append(line)
    return [_at_finest(group) for group in groups]


def _at_finest(group: Sequence[Line]) -> Line:
    """The first line of a group, at the frequency that the finest resolution gives; narrow if it is so at any."""
    finest = min(line.half_width_hz for line in group)
    lines = [line for line in group if line.half_width_hz == finest]
    hz, power = np.array([line.hz for line in lines]), np.array([line.amplitude**2 for line in lines])
    mean = float(hz @ power / power.sum())
    narrow = any(line.narrow for line in group)
    return replace(group[0], hz=mean, half_width_hz=max(finest, float(np.abs(hz - mean).max())), narrow=narrow)


def without_strike_lines(
    lines: Sequence[Line], strikes: Sequence[StrikeTrain], speed: ShaftSpeed | None
) -> list[Line]:  # fmt: skip
    """Lines that are no harmonics of a strike train, with their sidebands at the shaft speed; orders are kept."""
    turn_hz = 0.0 if speed is None else speed.hz
    return [
        line
        for line in lines
        if shaft_order(line, speed) in STRONG_ORDERS
        or not any(_is_of_train(line, train.frequency_hz, turn_hz) for train in strikes)
    ]


def _is_of_train(line: Line, train_hz: float, shaft_hz: float) -> bool:
    """Whether a line is a harmonic of a train or a sideband of one."""
    for side in np.arange(-LIMITS.strike_sidebands, LIMITS.strike_sidebands + 1) * shaft_hz:
        k = round((line.hz - side) / train_hz)
        reach = line.half_width_hz + LIMITS.strike_tolerance_rel * k * train_hz
        if k >= 1 and abs(line.hz - side - k * train_hz) <= reach:
            return True
    return False


def tones_of(
    lines: Sequence[Line], speed: ShaftSpeed | None, units: Mapping[str, str], rms: Mapping[str, float]
) -> list[Tone]:
    """Lines as tones: named, the same tone of several channels as one, strongest first.

    Parameters
    ----------
    lines : sequence of Line
        Of all channels.
    speed : ShaftSpeed or None
        Of the shaft.
    units : mapping of str to str
        Channel -> SI unit.
    rms : mapping of str to float
        Channel -> standard deviation of its samples, the measure of strength.
    """
    mains = _mains_hz(lines, speed)
    named = [(line, *_name(line, speed, mains)) for line in lines]
    named = [entry for entry in named if entry[0].narrow or entry[1] != "other"]
    out: list[tuple[float, Tone]] = []
    while named:
        same = [e for e in named if _is_same(e, named[0]) and units[e[0].channel] == units[named[0][0].channel]]
        named = [e for e in named if e not in same]
        line, kind, order = min(same, key=lambda e: e[0].half_width_hz)
        amplitude: dict[str, float] = {}
        for other, _, _ in same:
            amplitude.setdefault(other.channel, other.amplitude)
        share = max(a / max(rms[c], 1e-300) for c, a in amplitude.items())
        tone = Tone(
            kind=kind,
            order=order,
            frequency_hz=line.hz,
            amplitude=amplitude,
            unit=units[line.channel],
            p_value=float(np.exp(max(min(e[0].log_p for e in same), -690.0))),
        )
        out.append((share, tone))
    return [tone for _, tone in sorted(out, key=lambda entry: -entry[0])]


Named = tuple[Line, ToneKind, float | None]


def _is_same(a: Named, b: Named) -> bool:
    """Whether two named lines are one tone: one order, or one frequency within the resolution."""
    if a[1] == b[1] == "order" and a[2] == b[2]:
        return True
    return abs(a[0].hz - b[0].hz) <= max(a[0].half_width_hz, b[0].half_width_hz)


def _name(line: Line, speed: ShaftSpeed | None, mains: float | None) -> tuple[ToneKind, float | None]:
    """Kind and order of a line. mains : Hz of the grid; None where the record shows none."""
    if k := shaft_order(line, speed):
        return "order", float(k)
    order = None if speed is None else line.hz / speed.hz
    return ("mains" if mains is not None and _is_mains(line, mains) else "other"), order


def shaft_order(line: Line, speed: ShaftSpeed | None) -> int:
    """The shaft order that a line is; 0 for none, and where the speed is unknown."""
    if speed is None:
        return 0
    k = round(line.hz / speed.hz)
    tolerance = line.half_width_hz + 2.0 * k * speed.sd_hz
    limit = LIMITS.max_strong_order_tolerance if k in STRONG_ORDERS else LIMITS.max_order_tolerance
    near = k >= 1 and abs(line.hz - k * speed.hz) <= tolerance and tolerance <= limit * speed.hz
    return k if near else 0


def _is_mains(line: Line, mains: float) -> bool:
    """Whether a line is a multiple of the mains frequency (Hz)."""
    resolution = 0.5 * line.half_width_hz
    return resolution < LIMITS.max_mains_tolerance_rel * mains and is_mains_multiple(line.hz, (mains,), resolution)


def is_mains_multiple(hz: float, grids_hz: Sequence[float] = LIMITS.mains_hz, resolution_hz: float = 0.0) -> bool:
    """Whether a frequency is a multiple of that of one of some grids."""
    reach_hz = resolution_hz + LIMITS.mains_tolerance_rel * hz
    multiples = ((round(hz / grid), grid) for grid in grids_hz)
    return any(1 <= k <= LIMITS.max_mains_multiple and abs(hz - k * grid) <= reach_hz for k, grid in multiples)


def mains_at(lines: Sequence[Line], ratio: float) -> float | None:
    """The grid, Hz, whose multiples are in the record scaled by a ratio; None if one is there unscaled too.

    The first or the second multiple has to stand at the ratio.
    """
    for mains in LIMITS.mains_hz:
        there = _multiples(lines, mains * ratio) & {1, 2}
        if there and (ratio == 1.0 or not _multiples(lines, mains)):
            return mains
    return None


def _multiples(lines: Sequence[Line], hz: float) -> set[int]:
    """Which multiples of a frequency are lines."""
    return {
        k
        for line in lines
        if 1 <= (k := round(line.hz / hz)) <= LIMITS.max_mains_multiple
        and line.half_width_hz < LIMITS.max_mains_tolerance_rel * hz
        and abs(line.hz / (k * hz) - 1.0) < LIMITS.mains_tolerance_rel
    }


def _mains_hz(lines: Sequence[Line], speed: ShaftSpeed | None) -> float | None:
    """The grid, Hz, with more multiples in the record; None without a multiple that is no order of the shaft."""
    free = [line for line in lines if not shaft_order(line, speed)]
    evidence: Array = np.array([sum(-line.log_p for line in free if _is_mains(line, hz)) for hz in LIMITS.mains_hz])
    return LIMITS.mains_hz[int(np.argmax(evidence))] if evidence.any() else None
