"""The start of a rolling fit: the first seconds fitted as a record, and what the rolling likelihood takes from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.identification.batch.full_fit import refuse_without_resonance
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.batch.unknown_mass import with_masses_of_shaft
from estimator.identification.machine.line_bands import with_lines_left_out
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.motion.checks import check_record
from estimator.likelihood.motion.denoise import denoising_filter, noise_displacement_psd, noise_is_negligible
from estimator.likelihood.motion.force_balance import Balance, build_balance, motion_channels
from estimator.likelihood.motion.law_smoothing import MARGIN_ROWS, MIN_SMOOTHING_SD
from estimator.likelihood.motion.prepare import motion_record
from estimator.likelihood.motion.stream_record import CELLS_WITH_FORCE, Record, notches
from estimator.likelihood.path.gram_likelihood import Point, responses
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.band_limit import half_length, out_of_band_sd
from estimator.signals.blocks import FREQUENCY_CELLS, FrequencyNodes, block_layout, block_spectra, frequency_nodes
from estimator.signals.blocks import valid_blocks as whole_blocks
from estimator.signals.channel_response import corrected_record
from estimator.signals.shaft_angle import with_measured_speed

MIN_CORRELATION_TIMES = 10.0  # that the first seconds have to hold
LINE_REACH_BINS = ((300.0, 3.5), (1e5, 4.5), (np.inf, 10.5))  # to either side of a line of at most this power over S
HELD_REASON = "held at what the first seconds gave"


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingStart:
    """The fit of the first seconds, as the rolling likelihood needs it.

    values : fitted parameters by full name, SI. held : nonlinear parameters, which stay at these values, by full name.
    m, c, kL : (places,) kg, N s/m, N/m of the mean response, the part of the shaft included.
    S : (places,) one-sided PSD of the excitation, N^2/Hz. noise : (places,) one-sided PSD of the sensor noise.
    widths : (places, 2) standard deviation of displacement (m) and velocity (m/s) that the band leaves out.
    sizes : place -> natural sizes of its motion and force, by name.
    nodes : frequencies at which the Jacobian of these resonances is evaluated.
    """

    values: Mapping[str, float]
    held: Mapping[str, Parameter]
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

    def point(self, balance: Balance) -> Point:
        """The point of a balance at these values; parameters that were not fitted are 0, or as the model gives them."""
        beta = [0.0 if f.searched else self.values.get(f.name, f.start) for f in balance.free]
        return Point(np.array(beta, float), self.S.copy(), self.noise.copy())

    def renewed(self, record: Record, balance: Balance, tangents: Array, point: Point) -> RollingStart:
        """The start at another point of the linear parameters. tangents : (columns, 4) mean tangents of the balance."""
        B = balance.coefficients(point.beta)
        m, c, kL = _mean_oscillators(B)
        widths, at = _widths_and_nodes(record, balance, tangents, B, point.S)
        return replace(self, m=m, c=c, kL=kL, S=point.S, noise=point.noise, widths=widths, nodes=at)


def first_fit(model: Model, y: Array, rate_hz: float, block: int) -> tuple[Model, WorkingPoint]:
    """The model and the working point of the first rows y (n, channels), SI, in blocks of `block` rows.

    The lines of the record are those of the returned model. Raises DataError.
    """
    y = check_record(model, y, rate_hz)
    model = with_lines_left_out(with_measured_speed(model, y, rate_hz), y, rate_hz)
    model, _ = with_masses_of_shaft(model, y, rate_hz)
    point = fit_record(model, motion_record(model, corrected_record(model, y, rate_hz), rate_hz, block))
    seconds = point.data.seconds
    for place, (m, c, kL, band) in _effective(point).items():
        if not point.data.measured_force:
            refuse_without_resonance(place, m, c if c > 0.0 else 0.0, kL, band)
        if c > 0.0 and seconds < MIN_CORRELATION_TIMES * 2 * m / c:
            raise DataError(
                f"the record ({seconds:.2f} s valid) is shorter than ten correlation times of {place} "
                f"({2 * m / c:.2g} s each): record at least {MIN_CORRELATION_TIMES * 2 * m / c:.1f} s"
            )
    return model, point


def start_without_lines(
    record: Record, model: Model, point: WorkingPoint, known: tuple[tuple[float, float], ...] = ()
) -> tuple[Record, RollingStart]:
    """The record without the lines of a model, and the start at the working point of its fit.

    known : stretches in Hz to leave out anyhow.
    """
    lines = (*known, *_line_stretches(model, record))
    cells = CELLS_WITH_FORCE if record.force else FREQUENCY_CELLS
    if lines:
        grid = block_layout(record.rate_hz, model.band, (*notches(record.model), *lines), cells)
        record = replace(record, grid=grid, lines=tuple(lines))
    return _with_denoised_displacement(record, rolling_start(record, point))


def rolling_start(record: Record, point: WorkingPoint) -> RollingStart:
    """The start of a rolling fit at a working point of the first seconds."""
    balance, P = build_balance(replace(record.model, effects=())), len(point.data.places)
    places = balance.places
    effective = _effective(point)
    m, c, kL = (np.array([effective[p][k] for p in places]) for k in range(3))
    B = balance.fixed.copy()
    for k, z in enumerate((m, c, kL)):
        B[np.arange(P), k * P + np.arange(P)] = z
    x, v, a = record.rms("x"), record.rms("v"), record.rms("a")
    sizes = {
        place: {
            "x": x[i], "v": v[i], "a": a[i], "m": m[i], "hz_peak": float(np.sqrt(abs(kL[i]) / m[i]) / (2 * np.pi)),
            "rate": record.rate_hz, "sample": 1 / record.rate_hz, "band": record.model.band[1],
            "seconds": record.seconds,
        }
        for i, place in enumerate(places)
    }  # fmt: skip
    found = fitted_parameters(point)
    values = {f"{p}.m": float(z) for p, z in zip(places, point.data.mass, strict=True)}
    values |= {f"{p}.{key}": float(z[i]) for i, p in enumerate(places) for key, z in (("kL", point.kL), ("c", point.c))}
    values |= {use.name(k): float(p) for use in point.placed for k, p in enumerate(use.p)}
    searched = [use.name(k) for use in point.placed for k, q in enumerate(use.effect.parameters) if not q.linear]
    held = {name: replace(found[name], reason=HELD_REASON) for name in searched if found[name].sd}
    widths, at = _widths_and_nodes(record, balance, np.zeros((len(balance.columns), 4)), B, point.S)
    return RollingStart(
        values=values, held=held, m=m, c=c, kL=kL, S=point.S, noise=point.nu * point.S, widths=widths, sizes=sizes,
        nodes=at,
    )  # fmt: skip


def _effective(point: WorkingPoint) -> dict[str, tuple[float, float, float, tuple[float, float]]]:
    """Place -> m (kg), c (N s/m), kL (N/m) of its mean response, the disc held, and the band (Hz)."""
    data = point.data
    k, c = np.einsum("iik->ki", point.mean_tangent) + np.reshape(
        (0.0, 0.0) if data.disc is None else data.disc.held, (2, 1)
    )
    return {p: (float(data.mass[i]), float(c[i]), float(k[i]), data.band) for i, p in enumerate(data.places)}


def _line_stretches(model: Model, record: Record) -> list[tuple[float, float]]:
    """Stretches (f1, f2) in Hz about the lines of a model, out to where a block leaks 3 % of S or less."""
    spacing = record.rate_hz / record.grid.size
    out: list[tuple[float, float]] = []
    for line in model.line_bands:
        reach = next(bins for power, bins in LINE_REACH_BINS if line.power_over_psd_hz / spacing <= power) * spacing
        low, high = line.low_hz - reach, line.high_hz + reach
        if high < model.band[0] or low > model.band[1]:
            continue
        if out and low <= out[-1][1]:
            low, high = out[-1][0], max(high, out.pop()[1])
        out.append((low, high))
    return out


def _with_denoised_displacement(record: Record, start: RollingStart) -> tuple[Record, RollingStart]:
    """The record with denoised displacements for the laws, and the start with the widths that this leaves; both
    unchanged where a force is measured or the sensor noise is small."""
    grid, kinds = record.grid, [record.model.channels[c].kind for c in motion_channels(record.model)]
    noise = noise_displacement_psd(kinds, grid.f_hz, start.noise)
    if record.force or noise_is_negligible(grid.f_hz, noise, record.rms("x") ** 2):
        return record, start
    blocks = whole_blocks(record.motion.valid, grid)[::2]
    seen = np.zeros_like(noise)
    for block in blocks.tolist():
        stretch = record.stretch(block * grid.hop, block * grid.hop + grid.size)
        seen += (
            np.abs(block_spectra(stretch.x[:, MARGIN_ROWS:-MARGIN_ROWS], np.zeros(1, np.intp), grid)[:, 0]) ** 2
            / blocks.size
        )
    calm = denoising_filter(grid.f_hz, seen, noise, half_length(record.rate_hz, record.model.band))
    return replace(record, calm=calm), replace(start, widths=np.hypot(start.widths, calm.doubt))


def _widths_and_nodes(
    record: Record, balance: Balance, tangents: Array, B: Array, S: Array
) -> tuple[Array, FrequencyNodes]:
    """Widths (places, 2) and Jacobian nodes at coefficients B (places, columns). S : (places,) N^2/Hz."""
    m, c, kL = _mean_oscillators(B)
    coupled = resonances(record, balance, tangents, B)  # on a stiff shaft far from the resonance of each place alone
    alone = np.sqrt(np.abs(kL) / m) / (2 * np.pi), np.abs(c) / m / (2 * np.pi)
    middle = [0.5 * (low + high) for low, high in notches(record.model)]  # the response of the shaft is steep near them
    left_out_there = np.array(middle), np.zeros(len(middle))
    at = frequency_nodes(record.grid, *(np.concatenate(z) for z in zip(coupled, alone, left_out_there, strict=True)))
    widths = out_of_band_sd(m, np.abs(c), kL, S + record.driven, record.model.band, record.rate_hz, balance.kinds)
    doubt = 0.0 if record.calm is None else record.calm.doubt
    return np.maximum(np.hypot(widths, doubt), MIN_SMOOTHING_SD * record.scales), at


def _mean_oscillators(B: Array) -> tuple[Array, Array, Array]:
    """(places,) m, c, kL of coefficients B (places, columns), the part of the shaft included."""
    P = len(B)
    m, c, kL = (np.diag(B[:, i * P : (i + 1) * P]).copy() for i in range(3))
    return m, c, kL


def resonances(record: Record, balance: Balance, tangents: Array, B: Array) -> tuple[Array, Array]:
    """Peaks of the displacement response at coefficients B, all places together, and their half-power widths; Hz."""
    f = record.grid.f_hz
    A = B @ responses(balance, tangents, f)
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
