"""Speed of the shaft: from a tacho, from the harmonics of the shaft in the spectra, or from the rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
from .tones import MAINS_HZ, MAINS_TOLERANCE_REL

SPEED_CONTRADICTED = "speed_contradicted"  # the record turns at another speed than the rig file says
SPEED_SUGGESTED = "speed_suggested"  # no speed is given; one comb of harmonics may be the shaft
SPEED_NOT_SEEN = "speed_not_seen"  # no harmonic of the shaft stands out
NAMEPLATE_REACH_REL = 0.03  # about the given speed: slip of an induction motor between no load and overload
NAMEPLATE_SD_REL = 0.01  # of a given speed that the record does not confirm: usual slip
CONTRADICTION_REL = 0.02  # between the record and the rig file, from which it is said: beyond the usual slip
MAX_HARMONICS = 6
MAX_HARMONIC_NATS = 20.0  # that one harmonic may contribute: one line is no comb
MAX_FALSE_SPEED_CHANCE = 1e-4
MIN_FREE_HZ, MAX_FREE_HZ = 5.0, 500.0  # of a shaft that nothing is known of: 300 to 30 000 rpm
MIN_FREE_HARMONICS = 3  # clear ones, the first among them
CLEAR_HARMONIC_NATS = 10.0
LINE_SD_BINS = 0.3  # of the frequency of a line


def shaft_speed(
    model: Model, y: Array, rate_hz: float, spectra: Mapping[str, Sequence[LevelSpectrum]]
) -> tuple[ShaftSpeed | None, list[Message]]:
    """Speed of the shaft and remarks on it. spectra : channel -> its spectra, finest first."""
    measured = _tacho_speed(model, y, rate_hz)
    if measured is not None:
        return measured, []
    if not model.speed_rpm:
        found = _comb(spectra, MIN_FREE_HZ, MAX_FREE_HZ)
        if found is None:
            return None, []
        text = f"a comb of harmonics of {found[0]:.2f} Hz may be the shaft: if so, set speed_rpm = {60 * found[0]:.0f}"
        return None, [Message(SPEED_SUGGESTED, text)]
    given = model.speed_rpm / 60.0
    near = _comb(spectra, given * (1 - NAMEPLATE_REACH_REL), given * (1 + NAMEPLATE_REACH_REL), free=False)
    if near is not None:
        hz, sd = near
        return ShaftSpeed(value_rpm=60 * hz, sd_rpm=60 * sd, source="record"), _contradiction(hz, sd, given)
    speed = ShaftSpeed(value_rpm=60 * given, sd_rpm=60 * given * NAMEPLATE_SD_REL, source="rig file")
    other = _comb(spectra, MIN_FREE_HZ, MAX_FREE_HZ)
    if other is not None and not _is_simple_ratio(other[0] / given):
        text = (
            f"no line at the {60 * given:.0f} rpm of the rig file, but a comb of harmonics of {other[0]:.2f} Hz: "
            f"check speed_rpm ({60 * other[0]:.0f}?)"
        )
        return speed, [Message(SPEED_CONTRADICTED, text)]
    text = f"no harmonic of the {60 * given:.0f} rpm of the rig file stands out: orders hold to {NAMEPLATE_SD_REL:.0%}"
    return speed, [Message(SPEED_NOT_SEEN, text)]


def _contradiction(hz: float, sd: float, given: float) -> list[Message]:
    """The remark on a speed found near the given one but not at it, Hz."""
    if abs(hz - given) <= max(CONTRADICTION_REL * given, 3.0 * sd):
        return []
    found = f"{60 * hz:.0f} +- {60 * sd:.1f} rpm"
    text = f"the record turns at {found}, the rig file says {60 * given:.0f}: check speed_rpm"
    return [Message(SPEED_CONTRADICTED, text)]


def _tacho_speed(model: Model, y: Array, rate_hz: float) -> ShaftSpeed | None:
    """Mean speed by the tacho, with the standard deviation of the speed along the record; None without pulses."""
    try:
        phase = measured_phase(model, y, rate_hz)
    except DataError:
        return None
    if phase is None or phase.size < 2:
        return None
    rows = max(1, min(int(rate_hz), (phase.size - 1) // 4))
    local = np.diff(phase[::rows]) * rate_hz / rows / (2 * np.pi)
    hz = float(phase[-1] - phase[0]) / (2 * np.pi) * rate_hz / (phase.size - 1)
    return ShaftSpeed(value_rpm=60 * hz, sd_rpm=60 * float(local.std()), source="tacho") if hz > 0 else None


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
        if found is not None and found[0] < np.log(MAX_FALSE_SPEED_CHANCE / len(resolutions)):
            return found[1:]
    return None


def _comb_at(levels: Sequence[LevelSpectrum], low: float, high: float, free: bool) -> tuple[float, float, float] | None:
    """log p, Hz and sd (Hz) of the clearest fundamental at one resolution of several channels."""
    seconds = levels[0].seconds
    nats = _nats(levels)
    top = (nats.size - 4) / seconds
    step = 0.5 / (MAX_HARMONICS * seconds)
    grid = np.arange(max(low, 4.0 / seconds), min(high, top), step)
    if not grid.size:
        return None
    k = np.arange(1, MAX_HARMONICS + 1)
    at = np.rint(np.outer(grid, k) * seconds).astype(np.intp)
    there = at < nats.size - 3
    own = np.where(there, nats[np.minimum(at, nats.size - 1)], 0.0)
    count = there.sum(axis=1)
    total = own.sum(axis=1)
    clear = own > CLEAR_HARMONIC_NATS
    several = clear[:, 0] & (clear.sum(axis=1) >= MIN_FREE_HARMONICS)
    shaft = several if free else clear[:, 0] | (clear[:, 1] & clear[:, 2])  # high orders alone may be of anything
    total = np.where(shaft, total, 0.0)
    score = np.log(np.maximum(gammaincc(count, total), 1e-300)) + np.log(grid.size)
    i = int(np.argmin(score - 1e-6 * total))
    if score[i] > 0:
        return None
    hz, sd = _refined(levels, grid[i], k[: count[i]][own[i, : count[i]] > CLEAR_HARMONIC_NATS])
    return float(score[i]), hz, sd


def _nats(levels: Sequence[LevelSpectrum]) -> Array:
    """(bins,) nats against noise at each bin in the channel that shows it best, capped, the channels paid for.

    Multiples of the mains, of the grid that shows more of them, are left out.
    """
    size = min(level.power.size for level in levels)
    log_p = np.min([level.log_p(np.arange(size)) for level in levels], axis=0) + np.log(len(levels))
    nats = np.clip(-log_p, 0.0, MAX_HARMONIC_NATS)
    nats[:3] = 0.0
    grids = [_bins_at_mains(mains, levels[0].seconds, nats.size) for mains in MAINS_HZ]
    nats[max(grids, key=lambda bins: float(nats[bins].sum()))] = 0.0
    return np.asarray(nats)


def _bins_at_mains(mains: float, seconds: float, size: int) -> NDArray[np.intp]:
    """Bins at multiples of a grid's frequency (Hz) in a spectrum of `size` bins of 1 / seconds Hz."""
    hz = mains * np.arange(1, MAX_HARMONICS + 1)
    reach = MAINS_TOLERANCE_REL * hz * seconds + 1.0
    bins = np.concatenate([np.arange(np.ceil(k - r), k + r) for k, r in zip(hz * seconds, reach, strict=True)])
    return bins[(bins >= 0) & (bins < size)].astype(np.intp)


def _refined(levels: Sequence[LevelSpectrum], hz: float, orders: NDArray[np.intp]) -> tuple[float, float]:
    """The fundamental (Hz) by the centroids of its clear harmonics, and its standard deviation."""
    seconds = levels[0].seconds
    if not len(orders):
        return hz, LINE_SD_BINS / seconds
    centres = []
    for k in orders:
        at = int(round(k * hz * seconds))
        level = max(levels, key=lambda level: level.power[at] / level.noise[at])
        lobe = np.arange(at - 2, at + 3)
        power = np.maximum(level.power[lobe] - level.noise[lobe], 0.0)
        centres.append(float(lobe @ power / power.sum()) / seconds if power.any() else k * hz)
    f, k = np.array(centres), np.asarray(orders, float)
    found = float(k @ f / (k @ k))
    misfit = float(np.sqrt(np.mean((f - k * found) ** 2)))
    return found, max(LINE_SD_BINS / seconds, misfit) / float(np.sqrt(k @ k))


def _is_simple_ratio(ratio: float) -> bool:
    """Whether a frequency is a whole multiple or a whole part of another: then it may be its harmonic."""
    r = max(ratio, 1.0 / ratio)
    return abs(r - round(r)) < NAMEPLATE_REACH_REL * r
