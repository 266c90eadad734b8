"""Spectrum of a whole record for the detection of lines, against time or against the measured shaft angle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes, return_freed_memory
from estimator.model.rig import MOTION_UNITS, Model
from estimator.parallel import map_threads

from .band_limit import to_acceleration
from .channel_response import anti_alias_response
from .shaft_angle import measured_phase
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSpectrum:
    """Spectrum of a whole record under a Hann window, in single precision (error 1e-3 of the local noise).

    f_hz : (bins,) Hz. Y : (places, bins) amplitude of a line at the bin, in the unit of the sensor.
    noise : (places, bins) local mean of |Y|^2. seconds : length of the record.
    windowed : (places, n) samples under the window. kinds : (places,) kinds of the sensors. rate_hz : rows per second.
    model : of the rig. phase : (n,) rad, shaft angle measured by a tacho; None without one.
    """

    f_hz: Array
    Y: NDArray[np.complex64]
    noise: Array
    seconds: float
    windowed: NDArray[np.float32]
    kinds: tuple[str, ...]
    rate_hz: float
    model: Model
    phase: Array | None

    @property
    def wander(self) -> float:
        """Relative variation of the measured speed to either side; 0 without a tacho."""
        if self.phase is None:
            return 0.0
        second = np.diff(self.phase[:: int(self.rate_hz)])
        return float(0.5 * np.ptp(second) / second.mean())

    def width(self, hz: float) -> float:
        """Half-width of a line, Hz."""
        return 3.0 / self.seconds + self.wander * hz

    def at_order(self, order: int, hz: float) -> tuple[Complexes, Array]:
        """(places,) complex amplitudes of acceleration at a shaft order, and their noise. hz : mean speed."""
        if self.phase is None:
            return self.at(order * hz)
        turn = np.exp(-1j * order * self.phase).astype(np.complex64)
        total = self.windowed @ turn.real + 1j * (self.windowed @ turn.imag)
        return self._acceleration(total, order * hz)

    def at(self, hz: float) -> tuple[Complexes, Array]:
        """(places,) complex amplitudes of acceleration at a frequency (phase at t = 0), and their noise."""
        P, n = self.windowed.shape
        w = -2j * np.pi * hz / self.rate_hz
        step = 2048
        whole = n // step * step
        turn = np.exp(w * np.arange(step)).astype(np.complex64)
        inner = self.windowed[:, :whole].reshape(P, -1, step) @ np.stack([turn.real, turn.imag], axis=1)
        total = (inner[..., 0] + 1j * inner[..., 1]) @ np.exp(w * step * np.arange(whole // step))
        total = total + self.windowed[:, whole:] @ np.exp(w * np.arange(whole, n))
        return self._acceleration(total, hz)

    def _acceleration(self, total: Complexes, hz: float) -> tuple[Complexes, Array]:
        """(places,) amplitudes of acceleration and their noise from demodulated sums of the samples."""
        k = int(np.clip(round(hz * self.seconds), 1, self.f_hz.size - 1))
        derived = to_acceleration(self.kinds, 2 * np.pi * hz) / self._recorded(np.array([hz]))[0]
        amplitude = 2 * total / (0.5 * (self.windowed.shape[1] - 1))
        return derived * amplitude, np.abs(derived) ** 2 * self.noise[:, k]

    def _recorded(self, f_hz: Array) -> Complexes:
        """(f,) response of the recorder's filter, measured over true; 1 where none is given."""
        response = anti_alias_response(self.model, self.rate_hz)
        return np.ones(f_hz.shape, complex) if response is None else response(f_hz)

    def accelerations(self, bins: slice | NDArray[np.intp]) -> Complexes:
        """(places, bins) amplitudes of acceleration of some bins."""
        f = self.f_hz[bins]
        return np.asarray(to_acceleration(self.kinds, 2 * np.pi * f).T * self.Y[:, bins] / self._recorded(f))

    def about(self, hz: float) -> slice:
        """Bins that give the noise at a frequency."""
        k = round(hz * self.seconds)
        first = max(k - LIMITS.noise_reach_bins, int(LIMITS.min_force_hz * self.seconds), 1)
        return slice(
            first, max(k + LIMITS.noise_reach_bins, first + LIMITS.noise_reach_bins) + 1, LIMITS.noise_stride_bins
        )

    def steady(self, hz: float) -> bool:
        """Whether the peak at a frequency has the shape of a line in phase and power, at the place where it is largest.

        A sharp resonance under random forces has not.
        """
        k = int(np.clip(round(hz * self.seconds), LIMITS.line_reach_bins, self.f_hz.size - 1 - LIMITS.line_reach_bins))
        Y = self.Y[:, k - LIMITS.line_reach_bins : k + LIMITS.line_reach_bins + 1]
        i = int(np.argmax(np.abs(Y[:, LIMITS.line_reach_bins]) ** 2 / self.noise[:, k]))
        Y, noise = Y[i], Y.shape[1] * self.noise[i, k]
        x = hz * self.seconds - np.arange(k - LIMITS.line_reach_bins, k + LIMITS.line_reach_bins + 1) + 1e-9
        line = np.exp(1j * np.pi * x) * np.sinc(x) / (1 - x * x)  # of a tone under the window
        tone = np.abs(np.vdot(line, Y)) ** 2 / np.vdot(line, line).real
        return bool(tone > LIMITS.min_line_power_share * max(np.vdot(Y, Y).real - noise, tone))

    def over_neighbours(self, hz: float) -> float:
        """Power at a frequency over that of the nearest bins, at the place where it is largest.

        Near a narrow resonance the local noise of `noise` is no measure of chance.
        """
        k = int(np.clip(round(hz * self.seconds), LIMITS.line_reach_bins, self.f_hz.size - 1 - LIMITS.line_reach_bins))
        near = np.abs(self.Y[:, k - LIMITS.line_reach_bins : k + LIMITS.line_reach_bins + 1]) ** 2
        line = slice(LIMITS.line_reach_bins - 2, LIMITS.line_reach_bins + 3)
        beside = np.delete(near, line, axis=1).mean(axis=1)
        return float((near[:, line].max(axis=1) / np.maximum(beside, 1e-300)).max())


def line_spectrum(model: Model, y: Array, rate_hz: float) -> LineSpectrum:
    """Spectrum of the motion channels, one per place; missing samples count as zero."""
    from scipy.fft import prev_fast_len

    moving = [(k, c.place) for k, c in enumerate(model.channels) if c.kind in MOTION_UNITS]
    columns = [next(k for k, place in moving if place == p) for p in model.places]
    keep = int(prev_fast_len(len(y), real=True))
    windowed, window = np.empty((len(columns), keep), np.float32), np.hanning(keep)
    for row, k in zip(windowed, columns, strict=True):
        np.multiply(y[:keep, k], window, out=row)
        row[~np.isfinite(row)] = 0.0
    del window
    return_freed_memory(y)
    kinds = tuple(model.channels[k].kind for k in columns)
    return _spectrum(windowed, kinds, model, rate_hz, measured_phase(model, y[:keep], rate_hz))


def residual_spectrum(
    s: LineSpectrum, y: Array, forces: Mapping[int, int], stiffness: Callable[[Array], Complexes]
) -> LineSpectrum:
    """Spectrum of the force, N, that the motion of `s` needs beyond the measured forces, at every place.

    forces : place -> column of its force in y; stiffness : (f,) Hz -> (f, places, places) force per acceleration.
    What is in proportion to the measured force, about each frequency, is taken out: an error of the model there makes
    no line of a line that the measured force itself has.
    """
    from scipy.fft import irfft, rfft

    P, n = s.windowed.shape
    Y = np.stack(map_threads(lambda z: rfft(z.astype(np.float64)), s.windowed))
    R = np.zeros_like(Y)
    for a in range(max(1, int(LIMITS.min_force_hz * s.seconds)), Y.shape[1], LIMITS.bins_per_chunk):
        here = slice(a, a + LIMITS.bins_per_chunk)
        w = 2 * np.pi * s.f_hz[here]
        derived = to_acceleration(s.kinds, w).T
        R[:, here] = np.einsum("fij,jf->if", stiffness(s.f_hz[here]), derived * Y[:, here])
    uneasy = np.ones(R.shape)
    window = np.hanning(n)
    for i, column in forces.items():
        F = np.asarray(rfft(np.nan_to_num(y[:n, column]) * window))
        R[i] -= F
        R[i, F.size - 1] = 0.0
        PR, PF = (np.maximum(local_noise(z.real**2 + z.imag**2, LIMITS.noise_reach_bins), 1e-300) for z in (R[i], F))
        weight = 1.0 / np.maximum(
            np.maximum(np.abs(R[i]) ** 2 / PR, np.abs(F) ** 2 / PF) / LIMITS.outlier_power_ratio, 1.0
        )
        power = _smooth(weight * np.abs(F) ** 2)
        proportion = _smooth(weight * R[i] * F.conj()) / np.maximum(power, LIMITS.min_force_power_rel * power.max())
        R[i] -= np.where(s.f_hz > LIMITS.min_force_hz, proportion * F, 0.0)
        uneasy[i] += np.abs(F) ** 2 / PF / (2 * LIMITS.noise_reach_bins)
    out = _spectrum(np.asarray(irfft(R, n, axis=1), dtype=np.float32), ("force",) * P, s.model, s.rate_hz, s.phase)
    return replace(out, noise=out.noise * uneasy)


def _smooth(z: NDArray[Any]) -> NDArray[Any]:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(z, 2 * LIMITS.noise_reach_bins + 1, mode="reflect"))


def order_spectrum(s: LineSpectrum) -> LineSpectrum:
    """The spectrum against the shaft angle, in Hz at the mean speed: shaft orders are lines at any speed."""
    if s.phase is None:
        return s
    row = np.arange(s.phase.size)
    at = np.interp(np.linspace(s.phase[0], s.phase[-1], s.phase.size), s.phase, row)
    windowed = np.stack([np.interp(at, row, z).astype(np.float32) for z in s.windowed])
    return _spectrum(windowed, s.kinds, s.model, s.rate_hz, None)


def _spectrum(
    windowed: NDArray[np.float32], kinds: tuple[str, ...], model: Model, rate_hz: float, phase: Array | None
) -> LineSpectrum:  # fmt: skip
    from scipy.fft import rfft

    n = windowed.shape[1]
    f: Array = np.asarray(np.fft.rfftfreq(n, 1 / rate_hz), dtype=np.float64)
    Y, noise = np.empty((len(windowed), f.size), np.complex64), np.empty((len(windowed), f.size))

    def transform(i: int) -> None:
        Y[i] = rfft(windowed[i])

    map_threads(transform, range(len(Y)))  # scipy's own workers would stay: map_processes then has no second process
    Y *= 2 / (0.5 * (n - 1))
    for own, z in zip(noise, Y, strict=True):
        own[:] = local_noise(z.real**2 + z.imag**2, LIMITS.noise_reach_bins)
    return LineSpectrum(
        f_hz=f,
        Y=Y,
        noise=noise,
        seconds=n / rate_hz,
        windowed=windowed,
        kinds=kinds,
        rate_hz=rate_hz,
        model=model,
        phase=phase,
    )


def hann_peak_offset_bins(three: Array) -> float:
    """Offset of a line from the middle of three bins about its peak, bins. three : amplitudes, under a Hann window."""
    a, b, c = three
    return float(np.clip((2 * c - b) / (b + c) if c >= a else -(2 * a - b) / (a + b), -0.7, 0.7))


def hann_spectrum(x: NDArray[np.floating[Any]]) -> NDArray[np.complexfloating[Any, Any]]:
    """(pieces, bins) amplitudes of tones in pieces (pieces, n) less their means, under a Hann window; precise as x."""
    from scipy.fft import rfft

    z = x - x.mean(axis=1, keepdims=True)
    z *= (4.0 / x.shape[1] * np.hanning(x.shape[1] + 1)[:-1]).astype(x.dtype)
    return np.asarray(rfft(z, axis=1, overwrite_x=True))


def local_noise(power: NDArray[np.floating], reach: int) -> Array:
    """(bins,) local noise: mean of the bins up to `reach` away, by the median of every fourth, so without lines.

    The reach is halved towards 0 Hz, as sensor noise referred to force rises as f^-4 down to min_force_hz.
    """
    from scipy.ndimage import median_filter

    def local(power: NDArray[np.floating], reach: int, thin: int) -> Array:
        median = median_filter(power[::thin], 2 * reach // thin + 1, mode="reflect") / np.log(2)
        return np.asarray(np.repeat(median, thin)[: power.size], dtype=np.float64)

    out = local(power, reach, LIMITS.noise_stride_bins)
    while (reach := reach // 2) >= LIMITS.min_noise_reach_bins:
        out[: 4 * reach] = local(power[: 6 * reach], reach, 1)[: 4 * reach]
    return np.maximum(out, 1e-300)
