"""The motion record of a model: checked, channel responses undone, band limited, aligned in blocks."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Series, real_samples, return_freed_memory, true_runs
from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at
from estimator.errors import DataError
from estimator.likelihood.thresholds import LIMITS
from estimator.model.background import Background
from estimator.model.disc import disc_of
from estimator.model.rig import LineBand, Model
from estimator.model.rotor import rotor_of
from estimator.model.rotor_matrices import Rotor
from estimator.parallel import map_threads
from estimator.results import Message
from estimator.signals.band_limit import below_band_force, passband
from estimator.signals.band_limited_record import BandLimitedRecord
from estimator.signals.channel_response import anti_alias_response, corrected_record
from estimator.signals.shaft_angle import measured_phase

from .force_balance import force_channels, motion_channels, shaft_terms
from .harmonics import periodic_amplitudes, periodic_series
from .known_spectra import excitation_shapes, fitted_bins, shaft_response, undone_noise_gain
from .linear_memory import filtered_series
from .motion_record import TIME_FOLDS, MotionRecord, joined_blocks, leading_of_sixths, time_folds, without_lines

RECORD_LONG_CODE = "record_long"  # of the message that a part of a record is used
# of all places, that are kept in TIME_FOLDS stretches spread over the whole record: one minute of four channels at
# 25.6 kHz; a working point and its making take about 90 bytes a sample
MAX_SAMPLES = 6e6


def prepare(
    model: Model, y: Array, rate_hz: float, free_masses: Collection[str] = (), part: int = 0
) -> MotionRecord:  # fmt: skip
    """Motion record of y (n, channels), SI, at most MAX_SAMPLES of it.

    free_masses : places whose mass is fitted, beside those of unknown mass under a measured force. part : number of the
    part of a longer record. Raises DataError as `motion_record` does.
    """
    return_freed_memory(y)
    y = corrected_record(model, y, rate_hz)
    return motion_record(model, y, rate_hz, most_samples=MAX_SAMPLES, free_masses=free_masses, part=part)


def shortening_messages(data: MotionRecord, y: Array) -> tuple[Message, ...]:
    """Messages on a record that is longer than the part that is kept, or so short that it shows little."""
    used, whole = data.seconds, len(y) / data.rate_hz
    if data.blocks * data.block < LIMITS.min_samples:
        asked_s = max(30.0, 2.0 * LIMITS.min_samples / data.rate_hz)
        text = f"an effect may be present and not visible; record {asked_s:.0f} s or more"
        return (Message("record_short", f"only {used:.2g} s of the record are usable: {text}"),)
    kept = MAX_SAMPLES / len(data.places) / data.rate_hz
    if whole <= 1.25 * kept or used < 0.9 * kept:
        return ()
    text = f"{used:.0f} s of the record's {whole:.0f} s are used, in six stretches spread over the record"
    return (Message(RECORD_LONG_CODE, text),)


def motion_record(
    model: Model, y: Array, rate_hz: float, block: int = 8192, most_samples: float = np.inf,
    free_masses: Collection[str] = (), part: int = 0,
) -> MotionRecord:  # fmt: skip
    """Motion record of y (n, channels of the model), SI, in valid blocks of `block` rows (less for a short record).

    most_samples : of all places; of a longer record the first blocks of every sixth are kept, or those of a later
    part. Raises DataError if fewer than 2 TIME_FOLDS blocks are valid, or a channel does not move.
    """
    y, places = check_shape(model, y), model.places
    moving, forces = _columns(model, y)
    columns = [*moving, *forces.values()]
    while block > 1024 and y.shape[0] < 24 * block:
        block //= 2
    filtered = _band_limited(model, y, columns, rate_hz)
    starts = valid_starts(filtered.valid, block)
    pick = leading_of_sixths(starts.size, most_samples / len(places) / block, part)
    starts = starts if pick is None else starts[pick]
    if starts.size < 2 * TIME_FOLDS:
        raise DataError(_too_short(y[:, columns], model.band[0], rate_hz, block, filtered.half))
    stretches = joined_blocks(starts, block)
    motion = filtered.of_stretches(stretches, np.float32)
    P = len(places)
    rows = np.concatenate([np.arange(part.start, part.stop) for part in stretches])
    t = rows / rate_hz
    speed = 2 * np.pi * (model.speed_rpm or 0.0) / 60
    angle = measured_phase(model, y, rate_hz)
    phase = speed * t if angle is None else angle[rows]
    a, v, x, u = motion.a, motion.v[:P], motion.x[:P], motion.u
    below = None if motion.slow is None else motion.slow[:P]
    measured = {i: a[P + k] for k, i in enumerate(forces)}
    slow = _below(model, y[rows], forces, rate_hz) if forces else None
    mass = _masses(model, a, v, x, measured)
    loose = {p for p in (*(places[i] for i in forces), *free_masses) if model.cap_mass(p) is None}
    known = inertia_and_shaft(rotor := rotor_of(model), mass, (a[:P], v, x), u)
    driven = np.zeros(P)
    for i, force in measured.items():
        known[i] -= force
        driven[i] = np.mean(force**2) / (model.band[1] - model.band[0])
    rms = np.array([map_threads(np.std, z) for z in (x, v, a[:P])])
    if (periodic := periodic_series(model, places, t, phase, rate_hz)) is not None:
        known -= periodic
    bins = fitted_bins(model, rate_hz, block)
    _refuse_only_lines(model, bins.size * rate_hz / block)
    f = np.asarray(bins * (rate_hz / block), dtype=np.float64)
    kinds = tuple(model.channels[k].kind for k in moving)
    record = MotionRecord(
        places=places, kinds=kinds, rate_hz=rate_hz, band=model.band, block=block, bins=bins, start=starts,
        fold=time_folds(starts.size),
        v=v, x=x, known=known, t=t, phase=phase, mass=mass, speed=speed, out_of_band_sd=np.zeros((P, 2)), rms=rms,
        measured_force_psd=driven, measured=below, slow=below, shared=_shared(model), disc=disc_of(model), rotor=rotor,
        below_band_force=slow,
        periodic_amplitudes=periodic_amplitudes(model, places, rate_hz),
        lines=_lines_passed(model, rate_hz),
        held=_held_linear(model), free_inertia={i: a[i].copy() for i, p in enumerate(places) if p in loose},
        background=model.background, **_spectra_of_model(model, f),
    )  # fmt: skip
    if model.background is not None:
        bring_in_background(model.background, places, (x, v, known), record.stretches, rate_hz)
    return record if model.deflects_at_lines or not record.lines else without_lines(record)


def _lines_passed(model: Model, rate_hz: float) -> tuple[LineBand, ...]:
    """The narrow lines that pass the band limit, also those beside the band, with the power that passes."""
    gain = passband(np.array([b.centre_hz for b in model.line_bands]), rate_hz, model.band)
    return tuple(
        replace(b, power_over_psd_hz=b.power_over_psd_hz * g**2)
        for b, g in zip(model.line_bands, gain.tolist(), strict=True) if g > LIMITS.min_line_gain
    )  # fmt: skip


def _held_linear(model: Model) -> dict[str, float]:
    """kL and c that the rig file fixes, by full name."""
    settings = {f"{p}.{key}": model.linear.get(p, {}).get(key) for p in model.places for key in ("kL", "c")}
    return {name: s.value for name, s in settings.items() if s is not None and s.fixed and s.value is not None}


def _refuse_only_lines(model: Model, fitted_hz: float) -> None:
    """Raise DataError where narrow lines fill most of the band. fitted_hz : width of what they leave, Hz."""
    low, high = model.band
    if model.line_bands and fitted_hz < LIMITS.min_fitted_share * (high - low):
        swept = any(band.swept for band in model.line_bands)
        lines, cure = (
            ("orders of a changing speed", "take a part at constant speed (--from, --to)") if swept
            else ("narrow lines", "widen the band")
        )  # fmt: skip
        raise DataError(
            f"{lines} fill {1 - fitted_hz / (high - low):.0%} of the band {low:.0f}-{high:.0f} Hz: the bearings are "
            f"judged by random vibration between the lines; {cure}"
        )


def _band_limited(model: Model, y: Array, columns: list[int], rate_hz: float) -> BandLimitedRecord:
    """Band-limited motion and force of some columns of a record y (n, channels), SI, made as it is asked for."""
    kinds = [model.channels[k].kind for k in columns]
    found = BandLimitedRecord(
        y=y, kinds=kinds, rate_hz=rate_hz, band=model.band, extra=shaft_terms(model), slow=True,
        undone=anti_alias_response(model, rate_hz), columns=columns,
    )  # fmt: skip
    return_freed_memory(y)  # all of it has been read
    return found


def _spectra_of_model(model: Model, f_hz: Array) -> dict[str, Any]:
    """The fields of a record that the model gives by frequency."""
    places = model.places
    shaft, shapes = shaft_response(model, places, f_hz), excitation_shapes(model, places, f_hz)
    if model.background is not None:
        np.einsum("fii->fi", shaft)[...] += model.background.attached_stiffness(places, 2j * np.pi * f_hz)
        shapes = shapes * model.background.force_shapes(places, f_hz)
    return {"shaft": shaft, "excitation_shape": shapes, "undone_noise_gain": undone_noise_gain(model, places, f_hz)}


def _columns(model: Model, y: Array) -> tuple[list[int], dict[int, int]]:
    """Column of the motion channel of each place, and columns of the force channels by index of the place.

    Raises DataError if a channel does not move.
    """
    moving, forces = motion_channels(model), force_channels(model)
    for k in (*moving, *forces.values()):
        finite = np.isfinite(y[:, k])
        check_moves(model.channels[k].name, y[:, k] if finite.all() else y[finite, k])
    return moving, forces


def _too_short(used: Array, low_hz: float, rate_hz: float, block: int, half: int) -> str:
    """Why a record with too few valid blocks is refused.

    used : (n, columns). low_hz : lower edge of the band. half : rows that the filter loses at either end of a stretch.
    """
    at_once, whole = (2 * half + block) / rate_hz, (2 * half + 2 * TIME_FOLDS * block) / rate_hz
    band = f"for band.low {low_hz:g} Hz"
    if np.isfinite(used).all():
        has = f"the record has {len(used) / rate_hz:.2g} s"
        return f"{has}, at least {whole:.2g} s are needed {band}: record longer, or raise band.low"
    return (
        f"too few stretches of {at_once:.2g} s without a missing sample: {2 * TIME_FOLDS} are needed {band}, or one of "
        f"{whole:.2g} s; see what the gaps come from, record longer, or raise band.low"
    )


def _masses(model: Model, a: Series, v: Series, x: Series, measured: dict[int, Series]) -> Array:
    """(places,) kg, mass of the rig file, else the least-squares mass from a measured force, else 1."""
    mass = np.array([model.cap_mass(p) or 1.0 for p in model.places])
    for i, force in measured.items():
        if model.cap_mass(model.places[i]) is None:
            Z = np.stack([a[i], v[i], x[i]]).astype(np.float64)
            mass[i] = np.linalg.solve(Z @ Z.T, Z @ force)[0]
            if not mass[i] > 0.0:
                raise DataError(
                    f"the force measured at {model.places[i]} does not follow the acceleration there (mass "
                    f"{mass[i]:.3g} kg): check unit and polarity of both channels, or give [rig.mass]"
                )
    return mass


def inertia_and_shaft(
    rotor: Rotor | None, mass: Array, motion: tuple[Series, Series, Series], through: Series
) -> Series:  # fmt: skip
    """(places, n) N, inertia and the force of shaft and discs.

    motion : acceleration, velocity and displacement, each (places, n). through : force that the modes of the shaft make
    of the displacements, overwritten; of no rows without a shaft.
    """
    P = len(mass)
    known = through[:P] if len(through) else np.zeros_like(motion[2])
    if rotor is not None:
        for A, z in zip(rotor.direct, motion, strict=True):
            for i, j in np.argwhere(A):
                known[i] += A[i, j] * z[j]
    for i in range(P):
        known[i] += mass[i] * motion[0][i]
    return known


def bring_in_background(
    background: Background, places: tuple[str, ...], series: tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
    rows_of_stretches: list[slice], rate_hz: float,
) -> None:  # fmt: skip
    """Turn the motion of the caps into the deflection of the bearings, and add the force of parts on the caps.

    series : displacement and velocity of the caps, and known force, (places, n), changed in place. rows_of_stretches :
    rows that follow one another.
    """
    x, v, known = series
    for i, place in enumerate(places):
        if (own := background.at.get(place)) is None:
            continue
        for rows in rows_of_stretches:
            if any(m.form == "attached" for m in own.modes):
                known[i, rows] += filtered_series(lambda w: own.attached_stiffness(1j * w), x[i, rows], rate_hz)
            if any(m.form == "support" for m in own.modes):
                for z in (x, v):
                    z[i, rows] = filtered_series(lambda w: own.deflection(1j * w), z[i, rows], rate_hz)


def _below(model: Model, y: Array, forces: Mapping[int, int], rate_hz: float) -> Series:
    """(places, n) N, measured forces below the band, 0 without one. forces : their columns of y (n, channels)."""
    out = np.zeros((len(model.places), len(y)), np.float32)
    for i, column in forces.items():
        out[i] = below_band_force(y[:, column], rate_hz, model.band)
    return out


def _shared(model: Model) -> tuple[tuple[int, int], ...]:
    """Pairs of places whose unmeasured forces may be correlated in the model."""
    found = [at(effect_of(u), u, model) for u in model.effects if effect_of(u).scope == "bearings"]
    return tuple(
        (model.places.index(p), model.places.index(f"{model.bearings[1]}.{p[-1]}")) for keys in found for p in keys
    )


def valid_starts(valid: NDArray[np.bool_], block: int) -> NDArray[np.int64]:
    """First rows of the non-overlapping blocks without an invalid row."""
    out = [np.arange(a, b - block + 1, block) for a, b in true_runs(valid)]
    return np.concatenate(out) if out else np.zeros(0, np.int64)


def check_moves(name: str, z: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest of a channel's finite samples, SI. Raises DataError if they cannot be motion or force."""
    if z.size < 2:
        raise DataError(f"channel {name} has no valid samples: check its cable and its signal in the rig file")
    low, high = float(z.min()), float(z.max())
    if low == high:
        what = "is zero throughout" if low == 0 else f"is constant at {low:g}"
        raise DataError(f"channel {name} {what}: check the sensor and its cable")
    largest = max(high, -low)
    if not LIMITS.min_peak_si < largest < LIMITS.max_peak_si:
        raise DataError(f"channel {name} reaches {largest:.3g} in SI units: check its unit and its scale")
    return low, high


def check_shape(model: Model, y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The record as (n, channels) float64 or float32. Raises DataError if it is none of this model."""
    try:
        y = real_samples(y)
    except ValueError as e:
        raise DataError("the channels are of unequal length: export them with a common start and end") from e
    if y.ndim != 2 or y.shape[1] != len(model.channels):
        raise DataError(
            f"the record has shape {y.shape}, the model {len(model.channels)} channels: (n, channels) needed"
        )
    if not model.places:
        raise DataError("the model has no motion channel on a bearing: nothing can be estimated")
    return y


def check_record(model: Model, y: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """The record as (n, channels) float64 or float32. Raises DataError naming the channel and the remedy."""
    y = check_shape(model, y)
    if not np.isfinite(rate_hz) or rate_hz <= 0:
        raise DataError(f"sampling rate {rate_hz} Hz: it must be positive")
    for i, channel in enumerate(model.channels):
        if channel.kind != "tacho":
            there = np.isfinite(y[:, i])
            check_moves(channel.name, y[:, i] if there.all() else y[there, i])
    for place in model.places:
        for key in ("kL", "c"):
            setting = model.linear.get(place, {}).get(key)
            if setting is not None and setting.value is not None and setting.value < 0:
                raise DataError(
                    f"the model is unstable: {place}.{key} = {setting.value:g}; give a positive value or none"
                )
    return y
