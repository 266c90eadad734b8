"""The most likely path of the caps under a measured force, along which the laws are evaluated after a first fit.

In the band the acceleration is measured as y with noise N, and through the rotor by the force with noise S. Both
together say y - N A^H S_r^-1 r, S_r = A N A^H + S, r what the fit leaves of the force. It is independent of r, so a law
along it has no bias by noise: integrated twice, noise is strong at the lower end of the band. Below
the band, where no accelerometer counts, the force alone gives the displacement, less what the laws take of it: the slow
displacement is smaller while the cap vibrates more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.checks import check_record
from estimator.likelihood.motion.force_balance import force_channels, motion_channels
from estimator.likelihood.motion.law_columns import Columns
from estimator.likelihood.motion.stream_record import Record, prepare
from estimator.likelihood.path.gram_likelihood import responses
from estimator.likelihood.path.measured_force import is_force_measured
from estimator.model.rig import Model
from estimator.parallel import map_threads
from estimator.signals.band_limit import FORCE_DRIFT_OVER_LOW_EDGE, noise_shape, passband, to_acceleration
from estimator.signals.blocks import taper

from .line_notches import start_without_lines, start_without_moving_lines
from .linear_start import LinearStart
from .maximum import MAX_SETTLED_STEP_SD
from .report import SpectralFit, fit_from_start

FRAME_S = 4.0  # at least
MIN_SMOOTHING_SD = 1e-4  # least smoothing, in standard deviations of the displacement
PATH_ROUNDS = 3  # each leaves a tangent over the stiffness of the error
PIECE_ROWS = 1 << 16  # rows
MAX_PATHS = 4  # that a law is fitted along, each from the last fit


def analyse(
    model: Model, y: Array, rate_hz: float, phase: Array | None = None, values: Mapping[str, float] | None = None
) -> SpectralFit:
    """Fit a model to (n, channels) rows in SI, with a force measured at every place again along the most likely path.

    values : to begin from, by name. Raises DataError.
    """
    y = check_record(model, y, rate_hz)
    record, start = start_without_moving_lines(*start_without_lines(prepare(model, y, rate_hz, phase)))
    solution = fit_from_start(record, start, model, values)
    if not (is_force_measured(solution.balance) and solution.balance.laws):
        return solution
    for _ in range(MAX_PATHS):
        before, sd = solution.point.beta, np.sqrt(np.diag(solution.covariance))
        solution = fit_from_start(*along_likely_path(solution, y), model, solution.values)
        if np.nanmax(np.abs(solution.point.beta - before) / sd[: before.size]) < MAX_SETTLED_STEP_SD:
            break
    return solution


def along_likely_path(solution: SpectralFit, y: Array) -> tuple[Record, LinearStart]:
    """The record, and the start, with the displacement that the laws see beside the measured one.

    y : (n, channels) rows in SI, as measured. The force must be measured at every place.
    """
    record, start, balance = solution.record, solution.start, solution.balance
    places = range(len(balance.places))
    own, forces = motion_channels(record.model), force_channels(record.model)
    motion, force = (np.nan_to_num(y[:, c]).T for c in (own, [forces[i] for i in places]))
    size = 1 << int(np.ceil(np.log2(FRAME_S * record.rate_hz)))
    path, sd = _filters(solution, size)
    widths = start.widths.copy()
    widths[:, 0] = np.maximum(sd, MIN_SMOOTHING_SD * record.scales[:, 0])
    start = replace(start, widths=widths)
    columns = record.columns(balance, start.widths, start.linear)
    B = balance.coefficients(solution.point.beta)
    for _ in range(PATH_ROUNDS):
        signals = np.concatenate([motion, force, -_laws(record, columns, B)])
        record = replace(record, slow=_filtered(signals, path, size))
    return record, start


def _filters(solution: SpectralFit, size: int) -> tuple[Complexes, Array]:
    """(f, P, 3 P) from what is measured of the motion, the force, and minus that of the laws, to the displacement that
    is to be added; (P,) m, sd of what is not known of it."""
    record, balance, point = solution.record, solution.balance, solution.point
    rate, (low, high), P = record.rate_hz, record.model.band, len(balance.places)
    f: Array = np.asarray(np.fft.rfftfreq(size, 1.0 / rate), dtype=np.float64)
    path, known = np.zeros((f.size, P, 3 * P), complex), (f >= FORCE_DRIFT_OVER_LOW_EDGE * low) & (f <= high)
    f = f[known]
    w: Array = np.asarray(2 * np.pi * f, dtype=np.float64)
    B = balance.coefficients(point.beta)
    R, laws = responses(balance, solution.bank.tangents, f), [c.kind == "law" for c in balance.columns]
    A = B @ R
    alone = A - B[:, laws] @ R[:, laws]
    N = (noise_shape(balance.kinds, w).T * point.noise)[:, :, None] * np.eye(P)
    H, S = A.conj().transpose(0, 2, 1), np.diag(point.S)
    gain = N @ H @ np.linalg.inv(A @ N @ H + S)
    below, s2 = (f < low)[:, None, None], -(w**2)[:, None, None]
    passed = passband(f, rate, (low, high))[:, None, None] * np.eye(P)
    measured = to_acceleration(balance.kinds, w)[:, None, :]
    path[known, :, :P] = np.where(below, -passed, -gain @ alone) * measured / s2
    path[known, :, P : 2 * P] = path[known, :, 2 * P :] = np.where(below, np.linalg.inv(alone), gain) / s2
    slowest = int(np.argmax(known))
    path[:slowest, :, 2 * P :] = path[slowest, :, 2 * P :].real  # laws push a cap off its centre for good
    through = np.linalg.inv(A)
    left = np.where(below, through @ S @ through.conj().transpose(0, 2, 1), N - gain @ A @ N) / s2**2
    variance = np.einsum("fii->i", left).real * rate / size
    drift = through[0] / s2[0]
    variance += FORCE_DRIFT_OVER_LOW_EDGE * low * np.einsum("ij,j,ij->i", drift, record.driven, drift.conj()).real
    return path, np.sqrt(variance)


def _laws(record: Record, columns: Columns, B: Array) -> Array:
    """(places, n) N, force of the laws along the path as it stands; none where samples lack, or before the first.

    There the filter of an offset is a stroke: of 200 m/s^2, before the band at 170 Hz, ninety times the motion.
    """
    balance, out = columns.balance, np.zeros((len(B), record.motion.rows))

    def part(first: int) -> None:
        last = min(first + PIECE_ROWS, out.shape[1])
        stretch, states = record.stretch(first, last), {}  # type: ignore[var-annotated]
        for k, column in enumerate(balance.columns):
            if column.kind == "law":
                out[column.row, first:last] += B[column.row, k] * columns.law(k, stretch, states)[0]

    map_threads(part, range(0, out.shape[1], PIECE_ROWS))
    return np.where(record.motion.valid, out, 0.0)


def _filtered(z: Array, into: Complexes, size: int) -> Array:
    """(P, n) from z (k, n) through `into` (size / 2 + 1, P, k): frames under a window whose squares add up to 1."""
    n, hop, w = z.shape[1], size // 2, taper(size)
    out = np.zeros((into.shape[1], n + 2 * size))
    for at in range(-hop, n, hop):
        lo, hi = max(at, 0), min(at + size, n)
        frame = np.zeros((z.shape[0], size))
        frame[:, lo - at : hi - at] = z[:, lo:hi]
        spectrum = np.einsum("fpk,kf->pf", into, np.fft.rfft(frame * w))
        out[:, at + size : at + 2 * size] += np.fft.irfft(spectrum, size) * w
    return out[:, size : size + n]
