"""The linear start of a fit, without any start values: a scan over resonance and damping, then the linear fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.errors import DataError
from estimator.likelihood.motion.denoise import denoising_filter, noise_displacement_psd, noise_is_negligible
from estimator.likelihood.motion.force_balance import build_balance, motion_channels
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS, MIN_SMOOTHING_SD
from estimator.likelihood.motion.stream_record import Record, gather, notches
from estimator.likelihood.path.gram_likelihood import (
    Evidence,
    Likelihood,
    Local,
    Point,
    evidence_of,
    maximise,
    responses,
)
from estimator.model.rig import Model
from estimator.signals.band_limit import half_length, out_of_band_sd
from estimator.signals.blocks import FrequencyNodes, block_spectra, frequency_nodes, valid_blocks

LINEAR_START_S = 20.0  # of the record, for the start
MIN_DAMPING_RATIO = 0.002  # of critical: lower end of the scan
START_MASSES_REL = np.array([0.05, 0.15, 0.5, 1.5])  # of the disc: start values of unknown cap masses


@dataclass(frozen=True, slots=True)
class LinearStart:
    """A linear fit, from which a fit of all laws starts.

    m, c, kL : (places,) kg, N s/m, N/m, the part of the shaft included.
    S : (places,) one-sided PSD of the excitation, N^2/Hz. noise : (places,) one-sided PSD of the sensor noise.
    widths : (places, 2) standard deviation of displacement (m) and velocity (m/s) that the band leaves out.
    sizes : place -> natural sizes of its motion and force, by name.
    nodes : frequencies at which the Jacobian of these resonances is evaluated.
    """

    m: Array
    c: Array
    kL: Array
    S: Array
    noise: Array
    widths: Array
    sizes: dict[str, dict[str, float]]
    nodes: FrequencyNodes

    @property
    def linear(self) -> Array:
        """(places, 3) m, kL, c."""
        return np.stack([self.m, self.kL, self.c], axis=1)


def best_oscillator(evidence: Evidence, row: int, mass: float, band: tuple[float, float]) -> tuple[float, float, float]:
    """(c, kL, S) of the likeliest single oscillator of a mass, for resonances in the band and 0.2 to 80 % damping.

    row : index of the place. mass : kg. band : Hz.
    """
    P, grid = len(evidence.balance.places), evidence.grid
    G = evidence.gram.sum(axis=0)[np.ix_([row, P + row, 2 * P + row], [row, P + row, 2 * P + row])]
    w0 = 2 * np.pi * np.geomspace(band[0], band[1], 240)
    zeta = np.geomspace(MIN_DAMPING_RATIO, 0.8, 14)
    c, k = mass * 2 * zeta[None, :] * w0[:, None], np.broadcast_to((mass * w0**2)[:, None], (w0.size, zeta.size))
    Q = (
        mass * mass * G[0, 0] + c * c * G[1, 1] + k * k * G[2, 2]
        + 2 * (mass * c * G[0, 1] + mass * k * G[0, 2] + c * k * G[1, 2])
    )  # fmt: skip
    f = grid.f_hz[:: max(1, grid.bins.size // 1500)]
    logs = _mean_logs(w0.tobytes(), zeta.tobytes(), f.tobytes())
    value = np.log(np.maximum(Q, 1e-300)) - logs  # per bin; the mass is the same for all
    i, j = np.unravel_index(int(np.argmin(value)), value.shape)
    n = evidence.blocks * grid.bins.size
    return float(c[i, j]), float(k[i, j]), float(Q[i, j] / n)


@lru_cache(maxsize=4)
def _mean_logs(w0: bytes, zeta: bytes, f_hz: bytes) -> Array:
    """(resonances, dampings) mean over frequency of log |A|^2 for unit mass. Arguments : bytes of float64 arrays."""
    r = (np.frombuffer(w0)[:, None] / (2 * np.pi * np.frombuffer(f_hz))) ** 2
    return np.stack([np.log((1 - r) ** 2 + 4 * z * z * r).mean(axis=1) for z in np.frombuffer(zeta)], axis=1)


def linear_start(record: Record) -> LinearStart:
    """The linear fit of a record. Raises DataError if the band holds no resonance or the record is too short."""
    model = replace(record.model, effects=())
    balance = build_balance(model)
    P = len(balance.places)
    bank = gather(record, balance, np.zeros((P, 2)), seconds=LINEAR_START_S)
    evidence = evidence_of(bank)
    beta = np.array([f.start for f in balance.free])
    S = np.empty(P)
    for i, place in enumerate(balance.places):
        mass = model.cap_mass(place)
        scanned = best_oscillator(evidence, i, 1.0 if mass is None else mass, model.band)
        S[i] = scanned[2]
        for j, f in enumerate(balance.free):
            beta[j] = {f"{place}.m": 1.0, f"{place}.c": scanned[0], f"{place}.kL": scanned[1]}.get(f.name, beta[j])
    local = _highest_maximum(Likelihood(evidence), Point(beta, S, np.zeros(P)), model)
    B = balance.coefficients(local.point.beta)
    m, c, kL = _mean_oscillators(B)
    for i, place in enumerate(balance.places):
        if may_be_fed_energy(record.model, place):
            c[i] = B[i, P + i] = max(c[i], 2 * MIN_DAMPING_RATIO * np.sqrt(max(kL[i] * m[i], 0.0)))
    x, v, a = record.rms("x"), record.rms("v"), record.rms("a")
    for i, place in enumerate(balance.places):
        _refuse_bad_start(place, m[i], c[i], kL[i], record)
    sizes = {
        place: {
            "x": x[i], "v": v[i], "a": a[i], "m": m[i], "hz_peak": float(np.sqrt(kL[i] / m[i]) / (2 * np.pi)),
            "rate": record.rate_hz, "sample": 1 / record.rate_hz, "band": model.band[1], "seconds": record.seconds,
        }
        for i, place in enumerate(balance.places)
    }  # fmt: skip
    widths, at = _widths_and_nodes(record, evidence, B, local.point.S)
    return LinearStart(m=m, c=c, kL=kL, S=local.point.S, noise=local.point.noise, widths=widths, sizes=sizes, nodes=at)


def with_denoised_displacement(record: Record, start: LinearStart) -> tuple[Record, LinearStart]:
    """The record with denoised displacements for the laws, and the start with the widths that this leaves; both
    unchanged where a force is measured or the sensor noise is small."""
    grid, kinds = record.grid, [record.model.channels[c].kind for c in motion_channels(record.model)]
    noise = noise_displacement_psd(kinds, grid.f_hz, start.noise)
    if record.force or noise_is_negligible(grid.f_hz, noise, record.rms("x") ** 2):
        return record, start
    blocks = valid_blocks(record.motion.valid, grid)[::2]
    blocks = blocks[: max(1, int(LINEAR_START_S * record.rate_hz / grid.size))]
    seen = np.zeros_like(noise)
    for block in blocks.tolist():
        stretch = record.stretch(block * grid.hop, block * grid.hop + grid.size)
        seen += (
            np.abs(block_spectra(stretch.x[:, MARGIN_ROWS:-MARGIN_ROWS], np.zeros(1, np.intp), grid)[:, 0]) ** 2
            / blocks.size
        )
    calm = denoising_filter(grid.f_hz, seen, noise, half_length(record.rate_hz, record.model.band))
    return replace(record, calm=calm), replace(start, widths=np.hypot(start.widths, calm.doubt))


def restarted_about(start: LinearStart, record: Record, evidence: Evidence, point: Point) -> LinearStart:
    """The start with values and widths of a better point of the linear parameters."""
    B = evidence.balance.coefficients(point.beta)
    m, c, kL = _mean_oscillators(B)
    widths, at = _widths_and_nodes(record, evidence, B, point.S)
    return LinearStart(m=m, c=c, kL=kL, S=point.S, noise=point.noise, widths=widths, sizes=start.sizes, nodes=at)


def _widths_and_nodes(record: Record, evidence: Evidence, B: Array, S: Array) -> tuple[Array, FrequencyNodes]:
    """Widths (places, 2) and Jacobian nodes at coefficients B (places, columns). S : (places,) N^2/Hz."""
    m, c, kL = _mean_oscillators(B)
    coupled = resonances(evidence, B)  # on a stiff shaft far from the resonance of each place alone
    alone = np.sqrt(kL / m) / (2 * np.pi), c / m / (2 * np.pi)
    middle = [0.5 * (low + high) for low, high in notches(record.model)]  # the response of the shaft is steep near them
    left_out_there = np.array(middle), np.zeros(len(middle))
    at = frequency_nodes(record.grid, *(np.concatenate(z) for z in zip(coupled, alone, left_out_there, strict=True)))
    widths = out_of_band_sd(m, c, kL, S + record.driven, record.model.band, record.rate_hz, evidence.balance.kinds)
    doubt = 0.0 if record.calm is None else record.calm.doubt
    return np.maximum(np.hypot(widths, doubt), MIN_SMOOTHING_SD * record.scales), at


def _mean_oscillators(B: Array) -> tuple[Array, Array, Array]:
    """(places,) m, c, kL of coefficients B (places, columns), the part of the shaft included."""
    P = len(B)
    m, c, kL = (np.diag(B[:, i * P : (i + 1) * P]).copy() for i in range(3))
    return m, c, kL


def _highest_maximum(likelihood: Likelihood, first: Point, model: Model) -> Local:
    """The highest maximum of the likelihood, for unknown masses on a known shaft from several start masses."""
    balance = likelihood.evidence.balance
    unknown = {p for p in balance.places if model.cap_mass(p) is None}
    if balance.common is None or not unknown:
        return maximise(likelihood, first)[0]
    scaled = np.array([f.name.rsplit(".", 1)[0] in unknown for f in balance.free])
    power = np.array([p in unknown for p in balance.places])
    found = []
    for mass in START_MASSES_REL * model.mass["disc"]:
        beta, S = np.where(scaled, mass * first.beta, first.beta), np.where(power, mass**2 * first.S, first.S)
        local, _ = maximise(likelihood, Point(beta, S, first.noise))
        if np.isfinite(local.nll):
            found.append(local)
    return min(found, key=lambda z: z.nll)


def resonances(evidence: Evidence, B: Array) -> tuple[Array, Array]:
    """Peaks of the displacement response at coefficients B, all places together, and their half-power widths; Hz."""
    f = evidence.grid.f_hz
    A = B @ responses(evidence.balance, evidence.tangents, f)
    power = np.sum(np.abs(np.linalg.inv(A)) ** 2, axis=(1, 2)) / f**4  # of the displacement, which has a peak
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner >= power[2:])) + 1
    widths = []
    for k in peaks:
        below = power < 0.5 * power[k]
        right, left = np.argmax(below[k:]), np.argmax(below[k::-1])
        steps = [int(n) for n in (left, right) if n > 0]
        widths.append(2.0 * min(steps, default=f.size) * (f[1] - f[0]))
    return f[peaks], np.asarray(widths, dtype=np.float64)


def resonates(m: float, c: float, kL: float, band: tuple[float, float]) -> bool:
    """Whether an oscillator of m (kg), c (N s/m), kL (N/m) resonates inside the band (Hz)."""
    low, high = band
    f0 = np.sqrt(kL / m) / (2 * np.pi) if kL > 0 and m > 0 else 0.0
    return bool(1.02 * low < f0 < 0.98 * high and c <= 1.8 * np.sqrt(kL * m))


def refuse_without_resonance(place: str, m: float, c: float, kL: float, band: tuple[float, float]) -> None:
    """Raise DataError if a place of m (kg), c (N s/m), kL (N/m) does not resonate inside the band (Hz)."""
    if not resonates(m, c, kL, band):
        low, high = band
        raise DataError(
            f"no resonance of {place} inside the band {low:g}-{high:g} Hz: choose a band around the bearing resonance, "
            "and check that the channel is the bearing's"
        )


def _refuse_bad_start(place: str, m: float, c: float, kL: float, record: Record) -> None:
    """Raise DataError if a place has no resonance in the band or the record is under ten correlation times long."""
    refuse_without_resonance(place, m, c if c > 0 else np.inf, kL, record.model.band)
    correlation = 2 * m / c
    if correlation > record.seconds:
        raise DataError(
            f"{place} seems to lose nothing (c = {c:.2g} N s/m): something feeds it, as cross-coupling near whirl does "
            "(rotorscope diagnose), or the record is far too short"
        )
    if record.seconds < 10 * correlation:
        raise DataError(
            f"the record ({record.seconds:.2f} s valid) is shorter than ten correlation times of {place} "
            f"({correlation:.2g} s each): record at least {10 * correlation:.1f} s"
        )


def may_be_fed_energy(model: Model, place: str) -> bool:
    """Whether the model has an effect at a place that may do work on the rotor."""
    own = (place, place.split(".")[0])
    return any(p in own for u in model.effects if u.custom or effect_of(u).feeds_energy for p in u.parameters)
