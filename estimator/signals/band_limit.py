"""Band-limited acceleration, velocity and displacement of the measured channels, by one linear-phase FIR each.

Every output is the input through H(f) times a power of i w: H is 1 in the analysis band and falls smoothly to 0 over
[low / 2, low] and above `high`. The filters are symmetric or antisymmetric about their middle tap (no phase error) and
the middle is taken out, so row k of every output belongs to row k of the input. The same block convolution (overlap-
save at fixed absolute positions) runs live and offline: results do not depend, to the last bit, on how the input was
cut into chunks. A row is valid if no missing (NaN) sample lies within the support of its filter.

A law acts on the whole displacement. Below the band an accelerometer measures none of it. A displacement sensor does,
down to where its offset and drift begin (`below_band_gain`); that is one more output.

Because integration is done before any windowing, m a + c v + k x = F holds sample by sample for the band-limited
force, and a window applied later commutes with it: no leakage error in the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from estimator.arrays import Array, Complexes
from estimator.errors import DataError

from .thresholds import LIMITS

Terms = Sequence[tuple[Array, Callable[[Array], Complexes]]]
# powers of (i w) that turn what is measured into (a, v, x)
_POWERS_OF_IW = {"acceleration": (0, -1, -2), "velocity": (1, 0, -1), "displacement": (2, 1, 0), "force": (0,)}


def to_acceleration(kinds: Sequence[str], w: float | Array) -> NDArray[np.complex128]:
    """(..., channels) acceleration at w (...) rad/s per unit of what sensors of these kinds measure there."""
    return np.stack([(1j * np.asarray(w)) ** _POWERS_OF_IW[kind][0] for kind in kinds], axis=-1)


def noise_shape(kinds: Sequence[str], w: Array) -> Array:
    """(channels, f) PSD of acceleration over that of noise that is white in the unit of a sensor; w (f,) rad/s."""
    return np.array([w ** (2.0 * _POWERS_OF_IW[kind][0]) for kind in kinds])


@dataclass(frozen=True, slots=True, kw_only=True)
class BandLimitedMotion:
    """Band-limited rows start ... start + n - 1 of each channel, SI.

    a, v, x : (channels, n); for a channel of kind force, `a` holds the force and v, x are zero.
    u : (channels, n), the extra outputs (see BandLimit) or an array of no channels.
    valid : (n,) bool, no missing sample in the support of the filters, in any channel.
    slow : (channels, n) displacement below the band as sensors of displacement measure it, zero for others; None where
        there are none, or it was not asked for.
    """

    start: int
    a: Array
    v: Array
    x: Array
    u: Array
    valid: NDArray[np.bool_]
    slow: Array | None = None

    @property
    def rows(self) -> int:
        return int(self.valid.size)


def filter_edges_hz(rate_hz: float, band: tuple[float, float]) -> tuple[float, float, float, float]:
    """Stop, pass, pass, stop frequencies in Hz of H.

    Raises DataError if the band is empty or too close to the Nyquist frequency.
    """
    low, high = band
    if not 0.0 < low < high:
        raise DataError(f"band {low:g}-{high:g} Hz is empty: low must be above 0 and under high")
    if high > 0.47 * rate_hz:
        raise DataError(
            f"band.high {high:g} Hz is too close to or above the Nyquist frequency {rate_hz / 2:g} Hz of this "
            f"record: lower band.high to {0.45 * rate_hz:g} Hz or less"
        )
    return low / 2, low, high, min(1.25 * high, 0.5 * rate_hz)


def _step(u: Array) -> Array:
    """Smooth step from 0 (1e-5) at u = 0 to 1 at u = 1; its transform decays like a Gaussian, so few taps suffice."""
    from scipy.special import erf

    return np.asarray(0.5 + 0.5 * erf(6.0 * (u - 0.5)), dtype=np.float64)


def passband(f_hz: Array, rate_hz: float, band: tuple[float, float]) -> Array:
    """H(f), the real gain common to all outputs."""
    stop1, pass1, pass2, stop2 = filter_edges_hz(rate_hz, band)
    f = np.abs(f_hz)
    return _step((f - stop1) / (pass1 - stop1)) * _step((stop2 - f) / (stop2 - pass2))


def below_band_gain(f_hz: Array, rate_hz: float, band: tuple[float, float]) -> Array:
    """(f,) real gain of the displacement below the band that a displacement sensor gives."""
    steady = np.exp(-0.5 * (f_hz / (LIMITS.drift_over_low_edge * band[0])) ** 2)
    return np.where(np.abs(f_hz) < band[0], (1.0 - passband(f_hz, rate_hz, band)) * (1.0 - steady), 0.0)


def unmeasured_gain(f_hz: Array, rate_hz: float, band: tuple[float, float], kind: str) -> Array:
    """(f,) real gain from the displacement to the part that a sensor of this kind does not measure."""
    beside = below_band_gain(f_hz, rate_hz, band) if kind == "displacement" else 0.0
    return np.asarray(1.0 - passband(f_hz, rate_hz, band) - beside)


def half_length(rate_hz: float, band: tuple[float, float]) -> int:
    """Half the support of the filters, rows: the loss at each end of a record and beside each gap.

    With the extra outputs of BandLimit all filters are resonant_filter_lengths times as long.
    """
    stop1, pass1, pass2, stop2 = filter_edges_hz(rate_hz, band)
    return int(np.ceil(6.0 * rate_hz / min(pass1 - stop1, stop2 - pass2)))


def _taps(
    response: Callable[[Array], Complexes], rate_hz: float, band: tuple[float, float], half: int,
    undone: Callable[[Array], Complexes] | None = None,
) -> Array:  # fmt: skip
    """(2 half + 1,) taps of H(f) response(f) / undone(f), middle tap at index half; within 3e-5 of it in the band."""
    f = _frequencies(half, rate_hz)
    gain = passband(f, rate_hz, band)
    wanted = np.zeros(f.size, complex)
    inside = gain > 1e-14
    wanted[inside] = gain[inside] * response(f[inside])
    if undone is not None:
        wanted[inside] /= undone(f[inside])
    return _nearest(wanted, half)


def _slow_taps(rate_hz: float, band: tuple[float, float], half: int) -> Array:
    """(2 half + 1,) taps of `below_band_gain`, zero at 0 Hz: an offset may be a thousand times the vibration."""
    h = _nearest(below_band_gain(_frequencies(half, rate_hz), rate_hz, band).astype(complex), half)
    window = np.kaiser(h.size, 3.0)
    return np.asarray(h - h.sum() * window / window.sum())


def _frequencies(half: int, rate_hz: float) -> Array:
    size = 1 << int(np.ceil(np.log2(16 * half)))
    return np.asarray(np.fft.rfftfreq(size, 1.0 / rate_hz), dtype=np.float64)


def _nearest(wanted: Complexes, half: int) -> Array:
    """(2 half + 1,) taps whose response is close to `wanted`, given at the frequencies of an rfft."""
    size = 2 * (wanted.size - 1)
    target = wanted.copy()
    window = np.kaiser(2 * half + 1, 3.0)
    for _ in range(2):  # the window smooths the spectrum: put back once what that took away
        h = np.fft.irfft(target, size)
        h = np.concatenate([h[-half:], h[: half + 1]]) * window
        achieved = np.fft.rfft(np.concatenate([h[half:], np.zeros(size - h.size), h[:half]]))
        target += wanted - achieved
    return np.asarray(h, dtype=np.float64)


def _power(exponent: int) -> Callable[[Array], Complexes]:
    return lambda f: np.asarray((2j * np.pi * f) ** float(exponent), dtype=np.complex128)


def _held(
    response: Callable[[Array], Complexes], rate_hz: float, band: tuple[float, float], half: int
) -> Callable[[Array], Complexes]:
    """The response, changed so that filters of `half` rows to either side can realise it.

    A sharp resonance, that of a disc on its shaft, rings longer than the filter. Cutting it off would spread an error
    over the whole band. The response is therefore continued linearly beyond the band, and a resonance inside the band
    decays under a window that is flat at first. The error is below 0.1 % in the bins that a fit uses. At a
    resonance near the lower edge the linear part begins beyond these bins.
    """
    low, high = band
    width = 2 * LIMITS.resonant_filter_lengths * rate_hz / half  # left out on either side of it: balance.shaft_notches
    about = np.linspace(low - width, low + width, LIMITS.edge_search_points)
    peak = int(np.argmax(np.abs(response(about))))
    if 0 < peak < LIMITS.edge_search_points - 1:
        low = float(about[peak]) + width
    step = 1e-3 * low

    def continued(f: Array) -> Complexes:
        out = np.array(response(np.clip(f, low, high)), dtype=np.complex128)
        for edge, inward in ((low, step), (high, -step)):
            at, near = response(np.array([edge, edge + inward]))
            beyond = (f < low) if inward > 0 else (f > high)
            out[beyond] = at + (f[beyond] - edge) * (near - at) / inward
        return out

    size = 1 << int(np.ceil(np.log2(rate_hz / LIMITS.resonance_grid_hz)))
    f: Array = np.asarray(np.fft.rfftfreq(size, 1.0 / rate_hz), dtype=np.float64)
    fine = continued(f)
    inside = np.abs(fine[(f > low) & (f < high)])
    if np.argmax(inside) in (0, inside.size - 1):
        return continued
    lag = np.minimum(np.arange(size), size - np.arange(size))
    rung = np.fft.rfft(np.fft.irfft(fine, size) * np.exp(-0.5 * (2.0 * lag / half) ** 4))
    return lambda g: np.asarray(np.interp(g, f, rung.real) + 1j * np.interp(g, f, rung.imag))


def _block_size(half: int, rate_hz: float) -> int:
    """Size of the transform: four times `half`, with at most 0.4 s of new rows, and a fast one."""
    size = min(1 << int(np.ceil(np.log2(4 * half + 1))), 2 * half + max(1, int(0.4 * rate_hz)))
    return int(next_fast_len(size, real=True))


class BandLimit:
    """Band limit of a stream: (n, channels) rows in, `BandLimitedMotion` out.

    Row k comes out once rows to k + half (and a full block) are in.

    kinds : of each channel: acceleration, velocity, displacement or force.
    extra : terms of one more output `Motion.u` of the first channels (the forces through a shaft, for instance): real
        matrices (outputs, displacements of the first channels), each times a response(f_hz).
    slow : whether `Motion.slow` is asked for.
    undone : response(f_hz) of the recorder, measured over true, that is undone in every output. None: 1.
    dtype : of the outputs of `push`.
    """

    def __init__(
        self,
        kinds: Sequence[str],
        rate_hz: float,
        band: tuple[float, float],
        extra: Terms = (),
        slow: bool = False,
        undone: Callable[[Array], Complexes] | None = None,
        dtype: type[np.floating[Any]] = np.float64,
    ) -> None:
        self.kinds, self.rate_hz, self.band, self._dtype = tuple(kinds), rate_hz, band, dtype
        self.half = half_length(rate_hz, band) * (LIMITS.resonant_filter_lengths if extra else 1)
        self._size = _block_size(self.half, rate_hz)
        self._hop = self._size - 2 * self.half  # fixed, so that block positions never depend on the chunks
        slow = slow and "displacement" in self.kinds
        self.outputs = ("a", "v", "x", *(["u"] if extra else []), *(["slow"] if slow else []))
        self._filters: dict[str, Complexes] = {}
        self._joining = [np.asarray(matrix, dtype=np.float64) for matrix, _ in extra]
        held = [_held(response, rate_hz, band, self.half) for _, response in extra]
        for kind in set(self.kinds):
            responses = [_power(e) for e in _POWERS_OF_IW[kind]]
            if kind != "force":
                p = _POWERS_OF_IW[kind][2]
                responses += [lambda f, p=p, h=h: (2j * np.pi * f) ** float(p) * h(f) for h in held]  # type: ignore[misc]
            taps = np.array([_taps(r, rate_hz, band, self.half, undone) for r in responses])
            if slow and kind == "displacement":
                taps = np.vstack([taps, _slow_taps(rate_hz, band, self.half)])
            self._filters[kind] = np.fft.rfft(taps, self._size, axis=1)
        # as if the record were preceded by missing samples
        self._held = np.full((len(self.kinds), self.half), np.nan)
        self._fresh: list[Array] = []  # (n, channels) rows behind those held, too few for a block yet
        self._count = self.half  # of both
        self._next = 0

    def push(self, y: Array) -> BandLimitedMotion:
        """The rows that became available by these (n, channels) rows, perhaps none; NaN where a sample is missing."""
        if y.ndim != 2 or y.shape[1] != len(self.kinds):
            raise ValueError(f"expected rows of {len(self.kinds)} channels, got an array of shape {y.shape}")
        self._fresh.append(np.where(np.abs(y) <= LIMITS.max_sample_si, y, np.nan))
        self._count += len(y)
        if self._count < self._size:
            return self._join([])
        self._held = np.concatenate([self._held, *(z.T for z in self._fresh)], axis=1)
        self._fresh = []
        parts = []
        used = 0
        while self._held.shape[1] - used >= self._size:
            parts.append(self._block(self._held[:, used : used + self._size], self._dtype))
            used += self._hop
        self._held = self._held[:, used:].copy()
        self._count = self._held.shape[1]
        return self._join(parts)

    def _block(self, y: Array, dtype: type[np.floating[Any]]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """(outputs, channels, hop) and (hop,) validity from (channels, size) samples. dtype : of the outputs, and
        the precision that they are transformed in."""
        finite = np.isfinite(y)
        whole = bool(finite.all())
        spectra = rfft(y if whole else np.where(finite, y, 0.0), axis=1)
        out = np.zeros((len(self.outputs), len(self.kinds), self._hop), dtype)
        single, through = np.result_type(dtype, np.complex64), [3 + k for k in range(len(self._joining))]
        passed, products, rows = [], [], []
        for k, kind in enumerate(self.kinds):
            product = np.multiply(self._filters[kind], spectra[k], dtype=single, casting="same_kind")
            own = [i for i in range(len(product)) if i not in through]
            products.append(product[own] if through else product)
            rows += [(i if i < 3 else len(self.outputs) - 1, k) for i in own]
            passed.append(product[3 : 3 + len(through)])
        series = irfft(np.concatenate(products), self._size, axis=1)[:, 2 * self.half :]  # four rows at a time
        for row, own_series in zip(rows, series, strict=True):
            out[row] = own_series
        if through:
            each = np.stack(passed[: len(self._joining[0])], axis=1)
            joined = np.matmul(np.asarray(self._joining, dtype), each.view(dtype)).sum(axis=0).view(single)  # as reals
            out[3, : len(self._joining[0])] = irfft(joined, self._size, axis=1)[:, 2 * self.half :]
        if whole:
            return out, np.ones(self._hop, bool)
        missing = np.concatenate([[0], np.cumsum(~finite.all(axis=0))])
        valid = missing[2 * self.half + 1 :] == missing[: -2 * self.half - 1]
        return out, valid

    def _join(self, parts: list[tuple[Array, NDArray[np.bool_]]]) -> BandLimitedMotion:
        start = self._next
        if not parts:
            parts = [(np.empty((len(self.outputs), len(self.kinds), 0), self._dtype), np.empty(0, bool))]
        out = parts[0][0] if len(parts) == 1 else np.concatenate([p[0] for p in parts], axis=2)
        valid = parts[0][1] if len(parts) == 1 else np.concatenate([p[1] for p in parts])
        self._next += valid.size
        return self.motion(start, [*out], valid)

    def motion(self, start: int, out: list[NDArray[Any]], valid: NDArray[np.bool_]) -> BandLimitedMotion:
        """Outputs (channels, n) in their order, as motion."""
        found = dict(zip(self.outputs, out, strict=True))
        u = found.get("u", np.empty((0, valid.size), out[0].dtype))
        return BandLimitedMotion(
            start=start, a=found["a"], v=found["v"], x=found["x"], u=u, valid=valid, slow=found.get("slow")
        )


def out_of_band_sd(
    m: Array,
    c: Array,
    kL: Array,
    S: Array,
    band: tuple[float, float],
    rate_hz: float,
    kinds: Sequence[str],
    driven: Array | float = 0.0,
) -> Array:
    """(places, 2) sd of the displacement and velocity outside the band, from the linear response to S.

    kinds : of the sensor at each place. driven : PSD of the measured force there, by which laws see what is slow.
    """
    f = np.concatenate([np.linspace(0.0, band[0], 200), np.geomspace(band[0], 1e3 * rate_hz, 4000)[1:]])
    lost = np.array([unmeasured_gain(f, rate_hz, band, kind) for kind in kinds]) ** 2
    w = 2 * np.pi * f
    S = S[:, None] + np.multiply.outer(driven, (f < LIMITS.force_drift_over_low_edge * band[0]) | (f >= band[0]))
    response = S / np.abs(kL[:, None] + 1j * w * c[:, None] - m[:, None] * w**2) ** 2
    both = np.stack([np.trapezoid(response * lost, f), np.trapezoid(response * lost * w**2, f)], axis=1)
    return np.asarray(np.sqrt(both))


def below_band_force(force: Array, rate_hz: float, band: tuple[float, float]) -> Array:
    """(n,) N, part of a measured force below the band, without the offset and the drift of its sensor."""
    size = next_fast_len(force.size, real=True)
    F, f = rfft(force - force.mean(), size), np.fft.rfftfreq(size, 1 / rate_hz)
    return np.asarray(
        irfft(np.where((f >= LIMITS.force_drift_over_low_edge * band[0]) & (f < band[0]), F, 0.0), size)[: force.size]
    )
