"""A simulated twin of the fitted model beside the measurement: spectra, densities, orbits, and their distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ModelError
from .model import Model
from .motion_blocks import cut
from .simulate import simulate
from .working_point import WorkingPoint

Array = NDArray[np.float64]
SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class Twin:
    """psd_distance_db, pdf_distance : by channel. spectra, densities, orbits : for pictures, SI, as in the report."""

    psd_distance_db: dict[str, float]
    pdf_distance: dict[str, float]
    spectra: dict[str, dict[str, list[float]]]
    densities: dict[str, dict[str, list[float]]]
    orbits: dict[str, dict[str, list[list[float]]]]
    message: str = ""


def twin(model: Model, point: WorkingPoint) -> Twin:
    """Simulate the model (all values given) for some seconds and hold it against the record.

    psd distance: rms over the band of 10 lg (model / measured). pdf distance: largest difference of the two
    distribution functions of displacement (Kolmogorov), 0 to 1. A model that cannot be simulated gives no numbers.
    """
    data = point.data
    try:
        y = simulate(model, data.rate_hz, SECONDS, seed=11)
    except ModelError as problem:
        return Twin({}, {}, {}, {}, {}, f"no simulated twin: {problem}")
    if not np.isfinite(y).all():
        return Twin({}, {}, {}, {}, {}, "no simulated twin: the simulation of this model diverges")
    own = cut(model, y, data.rate_hz, data.block)
    psd: dict[str, float] = {}
    pdf: dict[str, float] = {}
    spectra: dict[str, Any] = {}
    densities: dict[str, Any] = {}
    orbits: dict[str, Any] = {}
    names = [next(c.name for c in model.channels if c.place == p and c.kind != "force") for p in data.places]
    for i, name in enumerate(names):
        f, measured = spectrum(data.a[i], data.block, data.rate_hz)
        _, model_psd = spectrum(own.a[i], own.block, own.rate_hz)
        if own.block != data.block:
            f_own, _ = spectrum(own.a[i], own.block, own.rate_hz)
            model_psd = np.interp(f, f_own, model_psd)
        inside = (f >= data.band[0]) & (f <= data.band[1])
        # noise of the sensor and its counts belongs to the measurement, not to the rotor
        noise = point.nu[i] * point.S[i]
        f, measured, model_psd = _smooth(f[inside], measured[inside], model_psd[inside] + noise)
        psd[name] = float(np.sqrt(np.mean((10 * np.log10(model_psd / measured)) ** 2)))
        a, b = np.sort(data.x[i][::7]), np.sort(own.x[i][::7])
        at = np.linspace(-4, 4, 81) * data.x[i].std()
        pdf[name] = float(np.max(np.abs(np.searchsorted(a, at) / a.size - np.searchsorted(b, at) / b.size)))
        spectra[name] = {"frequency_hz": f.tolist(), "measured": measured.tolist(), "model": model_psd.tolist()}
        centre = 0.5 * (at[1:] + at[:-1])
        densities[name] = {
            "at": centre.tolist(),
            "measured": np.histogram(data.x[i], at, density=True)[0].tolist(),
            "model": np.histogram(own.x[i], at, density=True)[0].tolist(),
        }
    for node in dict.fromkeys(p.split(".")[0] for p in data.places):
        pair = [data.places.index(f"{node}.{d}") for d in "xy" if f"{node}.{d}" in data.places]
        if len(pair) == 2:
            orbits[node] = {
                k: [z[j][:2000].tolist() for j in pair] for k, z in (("measured", data.x), ("model", own.x))
            }
    return Twin(psd, pdf, spectra, densities, orbits)


def spectrum(series: Array, block: int, rate_hz: float) -> tuple[Array, Array]:
    """One-sided PSD of blocks laid end to end, Hann window."""
    rows = series[: series.size // block * block].reshape(-1, block)
    window = np.hanning(block)
    Z = np.fft.rfft(rows * window, axis=1)
    f: Array = np.asarray(np.fft.rfftfreq(block, 1 / rate_hz), dtype=np.float64)
    return f, np.asarray(np.mean(np.abs(Z) ** 2, axis=0) * 2 / (rate_hz * np.sum(window**2)))


def _smooth(f: Array, *z: Array, count: int = 160) -> tuple[Array, ...]:
    """Means over cells of about equal width in log frequency."""
    edges = np.unique(np.searchsorted(f, np.geomspace(f[0], f[-1], count + 1)))
    edges = edges[edges < f.size]
    width = np.diff(np.append(edges, f.size))
    return tuple(np.add.reduceat(q, edges) / width for q in (f, *z))
