"""Speed of the shaft: from a tacho, from the harmonics of the shaft in the spectra, or from the rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.model.rig import Model
from estimator.results import Message
from estimator.signals.shaft_angle import measured_phase

from .machine_survey import ShaftSpeed
from .spectra import LevelSpectrum
from .thresholds import LIMITS
from .tones import Line, mains_at

SPEED_CONTRADICTED = "speed_contradicted"  # the record turns at another speed than the rig file says
RATE_UNCONFIRMED = "rate_unconfirmed"  # a wrong rate explains the other speed as well, and no mains line denies it
RATE_CONTRADICTED = "rate_contradicted"  # the record was sampled at another rate than it says
SPEED_SUGGESTED = "speed_suggested"  # no speed is given; one comb of harmonics may be the shaft
SPEED_NOT_SEEN = "speed_not_seen"  # no comb of harmonics of the shaft stands out
RECORD_SOURCE: Final = "record"  # of a speed that the harmonics of the shaft show
HARMONIC_COUNTS = (1, 3, 6)  # of the combs that are tried
MAX_HARMONICS = HARMONIC_COUNTS[-1]


def shaft_speed(
    model: Model, y: Array, rate_hz: float, spectra: Mapping[str, Sequence[LevelSpectrum]]
) -> tuple[ShaftSpeed | None, list[Message]]:
    """Speed of the shaft and remarks on it. spectra : channel -> its spectra, finest first."""
    measured = tacho_speed(model, y, rate_hz)
    if measured is not None:
        low, high = (measured.value_rpm * end for end in measured.range_rel)
        text = f"the speed changes from {low:.0f} to {high:.0f} rpm: tones are followed by shaft order"
        return measured, [Message("speed_followed", text)] if measured.is_swept else []
    if not model.speed_rpm:
        found = _comb(spectra, LIMITS.min_free_hz, LIMITS.max_free_hz)
        if found is None:
            return None, []
        text = f"a comb of harmonics of {found[0]:.2f} Hz may be the shaft: if so, set speed_rpm = {60 * found[0]:.0f}"
        return None, [Message(SPEED_SUGGESTED, text)]
    given = model.speed_rpm / 60.0
    ends = given * (1 - LIMITS.nameplate_reach_rel), given * (1 + LIMITS.nameplate_reach_rel)
    near = _comb(spectra, *ends, free=False)
    if near is not None and min(abs(near[0] - end) for end in ends) > near[1]:  # at an end it may lie beyond
        hz, sd = near
        wander = _wander(spectra, hz)
        speed = ShaftSpeed(value_rpm=60 * hz, sd_rpm=60 * sd, source=RECORD_SOURCE, wander_rel=wander)
        return speed, _contradiction(hz, sd, given)
    speed = ShaftSpeed(value_rpm=60 * given, sd_rpm=60 * given * LIMITS.nameplate_sd_rel, source="rig file")
    other = _comb(spectra, LIMITS.min_free_hz, LIMITS.max_free_hz)
    if other is not None and not _is_simple_ratio(other[0] / given):
        text = (
            f"no line at the {60 * given:.0f} rpm of the rig file, but a comb of harmonics of {other[0]:.2f} Hz: "
            f"check speed_rpm ({60 * other[0]:.0f}?)"
        )
        return speed, [Message(SPEED_CONTRADICTED, text)]
    sd_rel = LIMITS.nameplate_sd_rel
    text = f"no comb of harmonics confirms the {60 * given:.0f} rpm of the rig file: orders hold to {sd_rel:.0%}"
    return speed, [Message(SPEED_NOT_SEEN, text)]


def _contradiction(hz: float, sd: float, given: float) -> list[Message]:
    """The remark on a speed found near the given one but not at it, Hz."""
    if abs(hz - given) <= max(LIMITS.contradiction_rel * given, 3.0 * sd):
        return []
    found = f"{60 * hz:.0f} +- {60 * sd:.1f} rpm"
    text = f"the record turns at {found}, the rig file says {60 * given:.0f}: check speed_rpm"
    return [Message(SPEED_CONTRADICTED, text)]


def tacho_angle(model: Model, y: Array, rate_hz: float) -> Array | None:
    """(n,) rad, angle of the shaft by the tacho; None without a tacho or without pulses. y : (n, channels)."""
    try:
        phase = measured_phase(model, y, rate_hz)
    except DataError:
        return None
    return phase if phase is not None and phase.size > 1 and phase[-1] > phase[0] else None


def rate_remarks(
    lines: Sequence[Line], speed: ShaftSpeed, given_rpm: float | None, remarks: list[Message]
) -> list[Message]:
    """Remarks on the speed, and on the rate by the lines of the mains: a wrong rate scales shaft and mains alike."""
    if speed.source != RECORD_SOURCE or not given_rpm:
        return remarks
    ratio = speed.value_rpm / given_rpm
    if abs(ratio - 1.0) < LIMITS.min_rate_error_rel:
        return remarks
    if (mains := mains_at(lines, ratio)) is not None:
        text = (
            f"shaft and mains stand alike at {ratio:.4f} x where they belong ({ratio * mains:.2f} for {mains:.0f} Hz): "
            f"the true rate is {1 / ratio:.4f} x the one given, or a converter feeds the motor"
        )
        return [Message(RATE_CONTRADICTED, text)]
    if not remarks or mains_at(lines, 1.0) is not None:
        return remarks
    text = (
        f"with {1 / ratio:.4f} x the given rate the shaft would turn as the rig file says: check the rate too; no line "
        "of the mains tells a wrong rate from a wrong speed here"
    )
    return [*remarks, Message(RATE_UNCONFIRMED, text)]


def tacho_speed(model: Model, y: Array, rate_hz: float) -> ShaftSpeed | None:
    """Mean speed by the tacho, with the standard deviation of the speed along the record; None without pulses."""
    phase = tacho_angle(model, y, rate_hz)
    if phase is None:
        return None
    seconds = max(4, int((phase.size - 1) / rate_hz))  # pieces of at least a second, of a short record four
    rows = np.linspace(0, phase.size - 1, min(seconds, phase.size - 1) + 1).astype(int)
    local = np.diff(phase[rows]) / np.diff(rows) * rate_hz / (2 * np.pi)
    hz = float(phase[-1] - phase[0]) / (2 * np.pi) * rate_hz / (phase.size - 1)
    sd = LIMITS.tacho_sd_turns * rate_hz / phase.size
    beyond = 0.5 * float(np.abs(np.diff(local)).max(initial=0.0))  # from the middle of the first and last second
    return ShaftSpeed(
        value_rpm=60 * hz, sd_rpm=60 * sd, source="tacho", wander_rel=float(local.std()) / hz,
        range_rel=(float(local.min() - beyond) / hz, float(local.max() + beyond) / hz),
    )  # fmt: skip


def _comb(
    spectra: Mapping[str, Sequence[LevelSpectrum]], low: float, high: float, free: bool = True
) -> tuple[float, float] | None:
    """The clearest fundamental (Hz) between two frequencies, with its standard deviation; None if none is certain.

    The finest resolution at which one is certain decides: at a coarse one neighbouring lines run together.

    free : nothing points to a shaft there, so that the first harmonic and others have to be clear.
    """
    resolutions = sorted({round(level.seconds, 6) for levels in spectra.values() for level in levels}, reverse=True)
    for seconds in resolutions:
        levels = [level for own in spectra.values() for level in own if round(level.seconds, 6) == seconds]
        found = _comb_at(levels, low, high, free)
        if found is not None and found[0] < np.log(LIMITS.max_false_speed_chance / len(resolutions)):
            return found[1:]
    return None


def _comb_at(levels: Sequence[LevelSpectrum], low: float, high: float, free: bool) -> tuple[float, float, float] | None:
    """Logarithm of p, Hz and sd (Hz) of the clearest fundamental at one resolution of several channels."""
    seconds = levels[0].seconds
    top = min(level.power.size for level in levels) / seconds
    high = min(high, top)
    peaks_hz, nats = _peaks(levels, MAX_HARMONICS * max(high, 1.1 * max(LIMITS.mains_hz)))
    grid = np.arange(max(low, 4.0 / seconds), high, LIMITS.grid_step_bins / (MAX_HARMONICS * seconds))
    tried_speeds = grid.size
    if not tried_speeds or not peaks_hz.size:
        return None
    k = np.arange(1, MAX_HARMONICS + 1)
    if free:  # without a clear first harmonic a speed is none: few are left
        grid = grid[_harmonic_nats(grid, peaks_hz, nats, seconds)[0] > LIMITS.clear_harmonic_nats]
    if not grid.size:
        return None
    wanted = np.outer(grid, k)
    own, nearest = _harmonic_nats(wanted, peaks_hz, nats, seconds)
    clear = own > LIMITS.clear_harmonic_nats
    first = clear[:, 0]
    if free:
        shaft = first & (clear.sum(axis=1) >= LIMITS.min_free_harmonics)
    else:  # multiples of a motor's supply lie near orders 2 and 3; high orders alone may be of anything
        shaft = first if first.any() else clear[:, 1] & clear[:, 2]
    tried = np.array(HARMONIC_COUNTS) - 1
    count, total = np.cumsum(wanted < top, axis=1)[:, tried], np.cumsum(own, axis=1)[:, tried]
    p = gammaincc(np.maximum(count, 1), np.where(shaft[:, None], total, 0.0)).min(axis=1)
    score = np.log(np.maximum(p, 1e-300)) + np.log(tried_speeds * len(HARMONIC_COUNTS))
    i = int(np.argmin(score - 1e-6 * total[:, -1]))
    if score[i] > 0:
        return None
    hz, sd = _refined(peaks_hz[nearest[i, clear[i]]], k[clear[i]], seconds)
    return float(score[i]), hz, sd


def _harmonic_nats(wanted_hz: Array, peaks_hz: Array, nats: Array, seconds: float) -> tuple[Array, NDArray[np.intp]]:
    """Nats of the peak nearest to each of some frequencies, less with the distance, and the number of that peak."""
    nearest = np.searchsorted(peaks_hz, wanted_hz)
    above, below = np.minimum(nearest, peaks_hz.size - 1), np.maximum(nearest - 1, 0)
    nearest = np.where(np.abs(wanted_hz - peaks_hz[below]) < np.abs(wanted_hz - peaks_hz[above]), below, above)
    off = np.abs(wanted_hz - peaks_hz[nearest]) * seconds / LIMITS.line_tolerance_bins
    return nats[nearest] * np.maximum(1.0 - off**2, 0.0), nearest


def _peaks(levels: Sequence[LevelSpectrum], top_hz: float) -> tuple[Array, Array]:
    """Frequencies (Hz, rising) of peaks in the channel that shows each best, and their nats, capped, channels paid for.

    Multiples of the mains, of the grid that shows more of them, are left out. top_hz : up to which they matter.
    """
    seconds = levels[0].seconds
    size = min(*(level.power.size for level in levels), int(top_hz * seconds) + 4)
    log_p = np.array([level.log_p(np.arange(size)) for level in levels])
    nats = np.clip(-log_p.min(axis=0) - np.log(len(levels)), 0.0, LIMITS.max_harmonic_nats)
    nats[:3] = 0.0
    grids = [_bins_at_mains(mains, seconds, size) for mains in LIMITS.mains_hz]
    nats[max(grids, key=lambda bins: float(nats[bins].sum()))] = 0.0
    bins = np.arange(2, size - 2)
    best = np.argmin(log_p[:, bins], axis=0)
    power, noise = (np.array([getattr(level, name)[:size] for level in levels]) for name in ("power", "noise"))
    lobe = bins[:, None] + np.arange(-2, 3)
    over = np.maximum(power[best[:, None], lobe] - noise[best, bins][:, None], 0.0)
    peak = (nats[bins] > 0.0) & (over[:, 2] >= over.max(axis=1))
    bins, over, lobe = bins[peak], over[peak], lobe[peak]
    return (over * lobe).sum(axis=1) / over.sum(axis=1) / seconds, nats[bins]


def _bins_at_mains(mains: float, seconds: float, size: int) -> NDArray[np.intp]:
    """Bins at multiples of a grid's frequency (Hz) in a spectrum of `size` bins of 1 / seconds Hz."""
    hz = mains * np.arange(1, MAX_HARMONICS + 1)
    reach = LIMITS.mains_tolerance_rel * hz * seconds + 1.0
    bins = np.concatenate([np.arange(np.ceil(k - r), k + r) for k, r in zip(hz * seconds, reach, strict=True)])
    return bins[(bins >= 0) & (bins < size)].astype(np.intp)


def _refined(lines_hz: Array, orders: NDArray[np.intp], seconds: float) -> tuple[float, float]:
    """The fundamental (Hz) by lines (Hz) at some orders, and its standard deviation."""
    k = orders.astype(np.float64)
    found = float(k @ lines_hz / (k @ k))
    misfit = float(np.sqrt(np.mean((lines_hz - k * found) ** 2)))
    return found, max(LIMITS.line_sd_bins / seconds, misfit) / float(np.sqrt(k @ k))


def _wander(spectra: Mapping[str, Sequence[LevelSpectrum]], hz: float) -> float:
    """Relative standard deviation of the speed along the record: the width of the first order where it is clearest.

    hz : mean speed. Lines of the supply lie near higher orders. 0 where the first order is not clear.
    """
    clearest, found = LIMITS.wander_power_ratio, 0.0
    for levels in spectra.values():
        fine = levels[0]
        reach = max(LIMITS.wander_reach_rel * hz * fine.seconds, 4.0)
        bins = np.arange(int(hz * fine.seconds - reach), int(hz * fine.seconds + reach) + 2)
        bins = bins[(bins > 0) & (bins < fine.power.size)]
        ratio = fine.power[bins] / fine.noise[bins]
        if ratio.max(initial=0.0) > clearest:
            over = np.where(ratio > LIMITS.wander_power_ratio, fine.power[bins], 0.0)
            off = bins - over @ bins / over.sum()
            variance = float(over @ off**2 / over.sum()) - LIMITS.hann_line_variance_bins
            clearest, found = float(ratio.max()), float(np.sqrt(max(variance, 0.0))) / (hz * fine.seconds)
    return found


def _is_simple_ratio(ratio: float) -> bool:
    """Whether a frequency is a whole multiple or a whole part of another: then it may be its harmonic."""
    r = max(ratio, 1.0 / ratio)
    return abs(r - round(r)) < LIMITS.nameplate_reach_rel * r
