"""A simulated twin of the fitted model compared with the measurement: spectra, densities, orbits, distances."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimator.arrays import Array, Series
from estimator.errors import DataError, ModelError
from estimator.likelihood.motion.motion_record import MotionRecord, mean_psd
from estimator.likelihood.motion.prepare import motion_record
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.signals.band_limit import noise_shape
from estimator.simulation.simulator import simulate

from .free_run import free_run
from .thresholds import LIMITS


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
