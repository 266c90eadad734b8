"""Held-out likelihood of a working point and of a flexible black box, in nats per sample.

A simulated twin of the fitted model compared with the measurement: spectra, densities, orbits, distances.

Free-run simulation: the fitted model driven by the measured force alone, compared with the measurement.

The force is known as band-limited samples. It is interpolated to the steps of the integration (a zero-order hold of
the samples would cost more than most missing terms), and both sides are compared in the analysis band.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estimator.arrays import Array, Series
from estimator.errors import DataError, ModelError
from estimator.identification.residual.group_fit import ridge_information
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.fitting.fitted_values import fitted_model
from estimator.likelihood.motion.known_spectra import fitted_bins, force_channels, motion_channels
from estimator.likelihood.motion.motion_record import TIME_FOLDS, MotionRecord, mean_psd
from estimator.likelihood.motion.prepare import motion_record, valid_starts
from estimator.likelihood.path.subproblem import coupled_places, heldout_gain, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.signals.band_limit import band_limit, noise_shape
from estimator.signals.channel_response import anti_alias_response, corrected_record
from estimator.simulation.simulator import simulate

from .thresholds import LIMITS


def resampled(z: Array, size: int, shift: float) -> Array:
    """(..., size) band-limited rows of z (..., n), each taken `shift` of an output step later."""
    Z = np.fft.rfft(z, axis=-1)
    n = min(z.shape[-1], size) // 2 + 1
    out = np.zeros((*z.shape[:-1], size // 2 + 1), complex)
    out[..., :n] = Z[..., :n] * np.exp(2j * np.pi * np.arange(n) * shift / size)
    return np.asarray(np.fft.irfft(out, size, axis=-1) * (size / z.shape[-1]))


def free_run(model: Model, force: Array, rate_hz: float, first: int = 0) -> Array:
    """(places, n) motion in the kind that each place's channel measures, from rest, under (places, n) N.

    model : every value given. first : rows of the record before these, for what turns with the time.
    Raises ModelError for an incomplete or unstable model.
    """
    from estimator.simulation.plan import simulation_plan
    from estimator.simulation.stepper import ShaftSpeed, Stepper

    channels = tuple(model.channels[c] for c in motion_channels(model))
    plan = simulation_plan(replace(model, channels=channels))
    speed = ShaftSpeed(model.speed_rpm) if model.speed_rpm is not None else None
    stepper = Stepper(plan, 1.0 / (rate_hz * LIMITS.oversample_factor), speed)
    stepper.count = first * LIMITS.oversample_factor
    slots = stepper.slots.of_dof[[plan.rig.index(p) for p in model.places]]
    out = np.empty_like(force)
    pad, chunk = int(0.25 * rate_hz), int(LIMITS.chunk_s * rate_hz)
    n = force.shape[1]
    whole = np.empty((len(channels), n * LIMITS.oversample_factor))
    for a in range(0, n, chunk):
        lo, hi, end = max(a - pad, 0), min(a + chunk + pad, n), min(a + chunk, n)
        fine = resampled(force[:, lo:hi], (hi - lo) * LIMITS.oversample_factor, 0.5)
        part = fine[:, (a - lo) * LIMITS.oversample_factor : (end - lo) * LIMITS.oversample_factor]
        F = np.zeros((part.shape[1], stepper.slots.count))
        F[:, slots] = part.T
        steps = np.empty((len(channels), part.shape[1]))
        stepper.step(F, steps)
        whole[:, a * LIMITS.oversample_factor : end * LIMITS.oversample_factor] = steps
    for a in range(0, n, chunk):
        lo, hi, end = max(a - pad, 0), min(a + chunk + pad, n), min(a + chunk, n)
        part = resampled(
            whole[:, lo * LIMITS.oversample_factor : hi * LIMITS.oversample_factor],
            hi - lo,
            -0.5 / LIMITS.oversample_factor,
        )
        out[:, a:end] = part[:, a - lo : end - lo]
    return out


def simulation_rmse(model: Model, y: Array, rate_hz: float, decay_s: float, first: float = 0.0) -> dict[str, float]:
    """Channel name -> rms in SI of measured minus simulated motion in the band, from the fraction `first` on.

    model : every value given. y : (n, channels), SI, the sensors' responses taken back. decay_s : until free motion is
    down to 1 / e. The bins of the fit count: below the band the disc on its shaft rings on for minutes from where it
    happened to be. Fit on the rows before, and simulate those after, for a held-out figure. Raises DataError without a
    measured force at every place.
    """
    motions, forces = motion_channels(model), force_channels(model)
    P = len(motions)
    if len(forces) < P:
        raise DataError("a free run needs a measured force at every place: add channels of kind force")
    lead = int(LIMITS.settle_decay_times * decay_s * rate_hz)
    start = max(int(first * len(y)) - lead, 0)
    used = [*motions, *(forces[i] for i in range(P))]
    kinds = [model.channels[c].kind for c in used]
    measured = band_limit(y[start:, used], kinds, rate_hz, model.band, undone=anti_alias_response(model, rate_hz))
    force = np.where(measured.valid, measured.a[P:], 0.0)
    simulated = band_limit(free_run(model, force, rate_hz, start).T, kinds[:P], rate_hz, model.band)
    good = measured.valid & simulated.valid
    good[:lead] = False
    block = 1 << int(np.ceil(np.log2(LIMITS.block_cycles * rate_hz / model.band[0])))
    half = block // 2  # blocks overlap by half
    starts = np.concatenate([valid_starts(good, block), half + valid_starts(good[half:], block)])
    rows = (starts[:, None] + np.arange(block)).ravel()
    if not rows.size:
        raise DataError(f"the record is too short for a free run of {lead / rate_hz:.1f} s and what is compared after")
    out = {}
    for i, c in enumerate(motions):
        name = {"acceleration": "a", "velocity": "v", "displacement": "x"}[kinds[i]]
        error = getattr(simulated, name)[i] - getattr(measured, name)[i]
        psd = mean_psd(error[rows], block, rate_hz)[1][fitted_bins(model, rate_hz, block)]
        out[model.channels[c].name] = float(np.sqrt(psd.sum() * rate_hz / block))
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Twin:
    """psd_distance_db, pdf_distance : by channel. spectra, densities, orbits : for pictures, SI, as in the report."""

    psd_distance_db: dict[str, float] = field(default_factory=dict)
    pdf_distance: dict[str, float] = field(default_factory=dict)
    spectra: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    densities: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    orbits: dict[str, dict[str, list[list[float]]]] = field(default_factory=dict)
    message: str = ""


def twin(model: Model, point: WorkingPoint, record: Array) -> Twin:
    """Simulate the model (all values given) for some seconds and hold it against the record (n, channels).

    The twin is driven by random forces of the model's S, or by the measured force where every place has one.

    psd distance: rms over the band of 10 lg (model / measured). pdf distance: largest difference of the two
    distribution functions of displacement (Kolmogorov), 0 to 1. A model that cannot be simulated gives no numbers.
    """
    data = point.data
    if data.background is not None:
        return Twin(message="no simulated twin: the record has structural modes that no simulation has")
    try:
        if data.measured_force:
            y = _driven(model, record, data.rate_hz)
        else:
            y = simulate(model, data.rate_hz, LIMITS.twin_seconds, seed=11)
    except ModelError as problem:
        return Twin(message=f"no simulated twin: {problem}")
    if not np.isfinite(y).all():
        return Twin(message="no simulated twin: the simulation of this model diverges")
    try:
        own = motion_record(model, y, data.rate_hz, data.block)
    except DataError as problem:
        return Twin(message=f"no simulated twin: {problem}")
    psd: dict[str, float] = {}
    pdf: dict[str, float] = {}
    spectra: dict[str, Any] = {}
    densities: dict[str, Any] = {}
    orbits: dict[str, Any] = {}
    names = [next(c.name for c in model.channels if c.place == p and c.kind != "force") for p in data.places]
    for i, name in enumerate(names):
        f, measured = of_acceleration(data, i)
        model_psd = np.interp(f, *of_acceleration(own, i))
        inside = (f >= data.band[0]) & (f <= data.band[1])
        # noise of the sensor and its counts belongs to the measurement, not to the rotor
        noise = point.nu[i] * point.S[i] * noise_shape(data.kinds[i : i + 1], 2 * np.pi * f[inside])[0]
        f, measured, model_psd = _smooth(f[inside], measured[inside], model_psd[inside] + noise)
        psd[name] = float(np.sqrt(np.mean((10 * np.log10(model_psd / measured)) ** 2)))
        a, b = np.sort(data.x[i][::7]), np.sort(own.x[i][::7])
        at = np.linspace(-4, 4, 81) * data.x[i].std()
        pdf[name] = float(np.max(np.abs(np.searchsorted(a, at) / a.size - np.searchsorted(b, at) / b.size)))
        spectra[name] = {"frequency_hz": f.tolist(), "measured": measured.tolist(), "model": model_psd.tolist()}
        centre = 0.5 * (at[1:] + at[:-1])
        densities[name] = {
            "at": centre.tolist(),
            "measured": _density(data.x[i], at).tolist(),
            "model": _density(own.x[i], at).tolist(),
        }
    for node in dict.fromkeys(p.split(".")[0] for p in data.places):
        pair = [data.places.index(f"{node}.{d}") for d in "xy" if f"{node}.{d}" in data.places]
        if len(pair) == 2:
            orbits[node] = {
                k: [z[j][:2000].tolist() for j in pair] for k, z in (("measured", data.x), ("model", own.x))
            }
    return Twin(psd_distance_db=psd, pdf_distance=pdf, spectra=spectra, densities=densities, orbits=orbits)


def _driven(model: Model, record: Array, rate_hz: float) -> Array:
    """(n, channels) of the rig from rest under the measured force, the first seconds of it left out."""
    force = {c.place: k for k, c in enumerate(model.channels) if c.kind == "force"}
    if not force.keys() >= set(model.places):
        raise ModelError("a force is measured at some places only")
    whole = np.isfinite(record).all(axis=1)
    rows = int((LIMITS.settle_seconds + LIMITS.twin_seconds) * rate_hz)
    longest = max(np.split(np.arange(len(record)), np.flatnonzero(~whole)), key=len)[-rows:]
    y = record[longest[np.isfinite(record[longest]).all(axis=1)]].copy()
    moving = [next(k for k, c in enumerate(model.channels) if c.place == p and c.kind != "force") for p in model.places]
    y[:, moving] = free_run(model, np.ascontiguousarray(y[:, [force[p] for p in model.places]].T), rate_hz).T
    return y[int(LIMITS.settle_seconds * rate_hz) :]


def _density(x: Series, at: Array) -> Array:
    """(cells,) per m, of x (n,) between evenly spaced points. numpy counts without sorting if the range is given."""
    return np.asarray(np.histogram(x, at.size - 1, (at[0], at[-1]), density=True)[0])


def of_acceleration(data: MotionRecord, i: int) -> tuple[Array, Array]:
    """One-sided PSD of the acceleration at a place, from the velocity in the band."""
    f, power = mean_psd(data.v[i], data.block, data.rate_hz)
    return f, (2 * np.pi * f) ** 2 * power


def _smooth(f: Array, *z: Array, count: int = 160) -> tuple[Array, ...]:
    """Means over cells of about equal width in log frequency."""
    edges = np.unique(np.searchsorted(f, np.geomspace(f[0], f[-1], count + 1)))
    edges = edges[edges < f.size]
    width = np.diff(np.append(edges, f.size))
    return tuple(np.add.reduceat(q, edges) / width for q in (f, *z))


FITTED_SHARE = 0.7  # of a record with a measured force; the rest is simulated


def heldout_rmse(model: Model, y: Array, rate_hz: float) -> dict[str, float]:
    """Channel -> rms in SI of measured minus free-run motion on the last part of the record; fitted to the first.

    Empty unless a force is measured at every place.
    """
    forced = {c.place for c in model.channels if c.kind == "force"}
    if not model.places or not forced.issuperset(model.places):
        return {}
    from estimator.identification.batch.full_fit import fit_all_effects

    from .heldout import simulation_rmse

    try:
        found = fit_all_effects(model, y[: int(FITTED_SHARE * len(y))], rate_hz)
        filled = _known(fitted_model(found.model, found.point))
        damping = np.einsum("iik->ik", found.point.mean_tangent)[:, 1]
        decay_s = float(np.max(2 * found.point.data.mass / damping))
        del found, damping  # the record cut into blocks is large
        return simulation_rmse(filled, corrected_record(filled, y, rate_hz), rate_hz, decay_s, FITTED_SHARE)
    except (ModelError, DataError):
        return {}


def _known(model: Model) -> Model:
    """The model without what no value was found for."""
    uses = (
        replace(
            u, parameters={p: own for p, own in u.parameters.items() if all(s.value is not None for s in own.values())}
        )
        for u in model.effects
    )
    return replace(model, effects=tuple(u for u in uses if u.parameters))


def heldout_nll(point: WorkingPoint) -> float:
    """Nats per sample: every time fold judged by the parameters of the others. Lower is better.

    Of the one-sided PSD of the accelerations in the band, over all places; one sample is one row of the record.

    Parameters
    ----------
    point : WorkingPoint
        The model fitted to the record.
    """
    total = 0.0
    left = set(range(len(point.data.places)))
    while left:
        part = coupled_places(point, (min(left),))
        left -= set(part)
        problem = subproblem(point, part)
        for f in range(TIME_FOLDS):
            rest = np.array([k for k in range(TIME_FOLDS) if k != f])
            total -= problem.likelihood(problem.fit(rest), np.array([f]))
    total -= (
        point.data.blocks * np.log(point.data.undone_noise_gain).sum()
    )  # of what was measured, not of what was undone
    for i, _ in point.data.shared:  # each of the two was given the other: what they share has counted twice
        total -= point.gram.n[i].sum() * np.log(point.fit.S[i] / point.S[i])
    return float(total) / (point.data.blocks * point.data.block)


def reference_nll(point: WorkingPoint, found: MissingForce, nll: float) -> float:
    """Held-out nats per sample of a black box: smooth regressors (ridge), and a force spectrum free in 40 cells.

    Its parts count only where they help on held-out data, so it is never above `nll`.
    """
    samples = point.data.blocks * point.data.block
    gained = 0.0
    for r in found.residuals:
        if r.found:
            gained += max(0.0, float(heldout_gain(r.problem, ridge_information(r.problem)).sum()))
    for i in range(len(point.data.places)):
        gained += max(0.0, _free_spectrum_gain(point, i))
    return nll - gained / samples


def _free_spectrum_gain(point: WorkingPoint, i: int) -> float:
    """Nats on held-out folds of a force spectrum that is free in cells of about equal width in log frequency."""
    data = point.data
    Z = point.spectra[i].reshape(data.blocks, -1, 2)
    power = np.einsum("bkc,bkc->bk", Z, Z).astype(np.float64) / point.S[i]
    bins = power.shape[1]
    edges = np.unique(np.round(np.geomspace(8, bins, LIMITS.spectrum_cells + 1)).astype(np.int64))
    first = np.concatenate([[0], edges[:-1]])
    sums = np.add.reduceat(power, first, axis=1)
    by_fold = np.stack([sums[data.fold == f].sum(axis=0) for f in range(TIME_FOLDS)])
    n = np.outer(data.fold_blocks, np.diff(np.append(first, bins)))
    total = 0.0
    for here, count, rest, others in zip(by_fold, n, by_fold.sum(axis=0) - by_fold, n.sum(axis=0) - n, strict=True):
        trained, flat = rest / others, rest.sum() / others.sum()
        total += float(np.sum(here / flat + count * np.log(flat) - here / trained - count * np.log(trained)))
    return total
