"""A record as equal blocks of band-limited motion, the data of comparison and diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from estimator.arrays import Array, Series
from estimator.likelihood.thresholds import LIMITS
from estimator.model.background import Background
from estimator.model.disc import Disc
from estimator.model.rig import LineBand
from estimator.model.rotor_matrices import Rotor
from estimator.signals.band_limit import noise_shape

from .harmonics import PeriodicForce
from .law_smoothing import HALF_SUPPORT_ROWS, interpolated

TIME_FOLDS = 6  # of every record, for held-out errors
FOLD_PIECES = 4  # of every time fold, spread over the record: what changes along it is seen from every fold
_OTHER_DIRECTION = {"x": "y", "y": "x"}


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionRecord:
    """Band-limited motion of a record in valid blocks laid end to end, with what the model gives before a fit. SI.

    n = blocks * block rows; places are the measured directions of the bearing caps; bins are those of `bins`. v, x,
    known and slow are in single precision, which rounds a force by some 1e-6 of k x and halves the memory.

    places : names of the places, "bearing1.x" ...
    kinds : (places,) kind of the motion sensor at each place.
    rate_hz : rows per second.
    band : lower and upper edge of the analysis band, Hz.
    block : rows of a block.
    bins : (bins,) indices into the block spectrum: the band without the resonance of the disc on its shaft.
    start : (blocks,) first row of each block in the record.
    fold : (blocks,) number of the time fold.
    v, x : (places, n) band-limited velocity and displacement.
    known : (places, n) N, the force that needs no estimate: m a, shaft and disc, less measured and periodic forces.
    t : (n,) s from the start of the record.
    phase : (n,) rad, shaft angle, measured by a tacho or at the model's speed.
    mass : (places,) kg of the bearing caps.
    speed : rad/s of the shaft, 0 if unknown.
    shaft : (bins, places, places) N/m, dynamic stiffness of shaft and disc at the bearing caps.
    excitation_shape : (places, bins) spectral shape of the excitation that the model has, mean about 1.
    out_of_band_sd : (places, 2) sd of the displacement and velocity outside of the band.
    rms : (3, places) of x, v and a, over the whole record.
    measured_force_psd : (places,) N^2/Hz of the measured forces; 0 without one.
    undone_noise_gain : (places, bins) power gain of the noise where a channel response was undone.
    measured : (places, n) displacement below the band, 0 where it is not measured; None without displacement sensors.
    slow : (places, n) displacement below the band as the laws see it; None if it is neglected.
    denoise_correction : (places, n) denoised displacement less the displacement; None if the noise is negligible.
    denoise_sd : (places, 2) sd of displacement and velocity that remains after denoising; 0.0 without.
    shared : pairs of places whose unmeasured forces may be correlated.
    periodic_amplitudes : the model's periodic forces in the band by free amplitude; `known` has their known part.
    level : (places, blocks) power of the excitation over its mean; None if it is constant.
    disc : the disc on a massless shaft; None without one. rotor : shaft and discs as the caps move them, or None.
    below_band_force : (places, n) N, measured forces below the band; None without measured forces.
    lines : narrow lines of the record in the band, whose bins are left out.
    leaking_edges_hz : by place, the edge of the band from which noise leaks, 0 for none; empty before it is known.
    deflects_at_lines : whether x, v and known have these lines.
    held : kL and c that the rig file fixes, by name such as "bearing1.x.kL", N/m and N s/m.
    free_inertia : by index of a place whose mass is fitted, (n,) m/s^2 band-limited acceleration.
    background : structural modes at the bearing caps; x and v are the deflection of the bearing where a support moves.
    """

    places: tuple[str, ...]
    kinds: tuple[str, ...]
    rate_hz: float
    band: tuple[float, float]
    block: int
    bins: NDArray[np.int64]
    start: NDArray[np.int64]
    fold: NDArray[np.int64]
    v: Series
    x: Series
    known: Series
    t: Array
    phase: Array
    mass: Array
    speed: float
    shaft: NDArray[np.complex128]
    excitation_shape: Array
    out_of_band_sd: Array
    rms: Array
    measured_force_psd: Array
    undone_noise_gain: Array
    measured: Series | None = None
    slow: Series | None = None
    denoise_correction: Series | None = None
    denoise_sd: Array | float = 0.0
    shared: tuple[tuple[int, int], ...] = ()
    periodic_amplitudes: tuple[PeriodicForce, ...] = ()
    level: Array | None = None
    disc: Disc | None = None
    rotor: Rotor | None = None
    below_band_force: Series | None = None
    lines: tuple[LineBand, ...] = ()
    leaking_edges_hz: tuple[float, ...] = ()
    deflects_at_lines: bool = True
    held: Mapping[str, float] = field(default_factory=dict)
    free_inertia: Mapping[int, Series] = field(default_factory=dict)
    background: Background | None = None

    def is_judged_like(self, other: MotionRecord) -> bool:
        """Whether the likelihood is of the same bins, with the same leaking edges, as that of another record."""
        return self.leaking_edges_hz == other.leaking_edges_hz and np.array_equal(self.bins, other.bins)

    @property
    def measured_force(self) -> bool:
        """Whether a force is measured at any place."""
        return bool(self.measured_force_psd.any())

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.start.size)

    @property
    def fold_blocks(self) -> Array:
        """(folds,) blocks of each time fold."""
        return np.bincount(self.fold, minlength=TIME_FOLDS).astype(np.float64)

    @property
    def stretches(self) -> list[slice]:
        """Rows that follow one another in the record."""
        cuts = np.flatnonzero(np.diff(self.t) * self.rate_hz > 1.5) + 1
        return [slice(a, b) for a, b in zip([0, *cuts.tolist()], [*cuts.tolist(), self.t.size], strict=True)]

    @property
    def f_hz(self) -> Array:
        """Frequencies of the bins, (bins,)."""
        return np.asarray(np.fft.rfftfreq(self.block, 1 / self.rate_hz)[self.bins], dtype=np.float64)

    def noise_referred_to_force(self, A: NDArray[np.complex128]) -> Array:
        """(places, bins) PSD of sensor noise referred to force, over the PSD of the white noise of the place's sensor.

        A : (bins, places, places) force per acceleration, kg.
        """
        return np.asarray(np.abs(np.einsum("kii->ik", A)) ** 2 * self.noise_shape)

    @property
    def noise_shape(self) -> Array:
        """(places, bins) PSD of white sensor noise as acceleration, over its PSD in the unit of the sensor."""
        return np.asarray(noise_shape(self.kinds, 2 * np.pi * self.f_hz) * self.undone_noise_gain)

    @property
    def seconds(self) -> float:
        """Length of all blocks, s."""
        return self.blocks * self.block / self.rate_hz

    def other(self, i: int) -> int | None:
        """Index of the other direction at the same node."""
        node, direction = self.places[i].split(".")
        name = f"{node}.{_OTHER_DIRECTION[direction]}"
        return self.places.index(name) if name in self.places else None

    def opposite(self, i: int) -> int | None:
        """Index of the same direction at the first of the other bearings."""
        return next((k for k, p in enumerate(self.places) if k != i and p[-1] == self.places[i][-1]), None)

    def displacement(self, i: int) -> Series:
        """(n,) m, displacement at a place: in the band, and below it where that is known."""
        return np.asarray(self.x[i] if self.slow is None else self.x[i] + self.slow[i])

    def denoised_displacement(self, i: int) -> Series:
        """(n,) m, displacement at a place without the noise of its sensor."""
        x, correction = self.displacement(i), self.denoise_correction
        return x if correction is None else np.asarray(x + correction[i])

    def sizes(self, i: int) -> Array:
        """(4,) rms of x, v at a place and of x, v in the other direction (0 if that is not measured)."""
        o = self.other(i)
        return np.concatenate([self.rms[:2, i], np.zeros(2) if o is None else self.rms[:2, o]])

    def smoothing(self, i: int) -> Array:
        """(4,) half-widths for the smoothing of laws: sqrt(3) sd of the unmeasured part of x, v, xo, vo."""
        o = self.other(i)
        both = np.hypot(self.out_of_band_sd, self.denoise_sd)
        lost = np.concatenate([both[i], np.zeros(2) if o is None else both[o]])
        return np.asarray(np.sqrt(3.0) * np.maximum(lost, LIMITS.min_smoothing_sd * self.sizes(i)))

    def sign(self, i: int) -> float:
        """+1 in direction x, -1 in direction y."""
        return 1.0 if self.places[i].endswith("x") else -1.0

    def states(self, of: Callable[[Series], Series], **rest: Any) -> MotionRecord:
        """Record with the function `of` applied to every series of motion (places, n), and other fields as given."""
        series = (self.measured, self.slow, self.denoise_correction)
        measured, slow, correction = (None if z is None else of(z) for z in series)
        return replace(
            self, v=of(self.v), x=of(self.x), measured=measured, slow=slow, denoise_correction=correction, **rest
        )

    def in_one(self) -> MotionRecord:
        """Record whose x is the denoised displacement: all that the tangents of laws need."""
        x = np.stack([self.denoised_displacement(i) for i in range(len(self.places))])
        return replace(self, x=x, measured=None, slow=None, denoise_correction=None, below_band_force=None)

    def of_blocks(self, some: NDArray[np.int64]) -> dict[str, Any]:
        """Fields with one value per block, at some blocks."""
        level = None if self.level is None else self.level[:, some]
        return {"start": self.start[some], "fold": self.fold[some], "level": level}

    def at(self, rows: slice | list[slice] | NDArray[np.bool_], **rest: Any) -> MotionRecord:
        """Record of some rows; views if they are a slice. rest : other fields that change."""

        def taken(z: Series) -> Series:
            if isinstance(rows, list):
                return np.concatenate([z[..., run] for run in rows], axis=-1)
            return z[..., rows] if isinstance(rows, slice) else np.ascontiguousarray(z[..., rows])

        force = None if self.below_band_force is None else taken(self.below_band_force)
        inertia = {i: taken(a) for i, a in self.free_inertia.items()}
        same = {"known": taken(self.known), "t": taken(self.t), "phase": taken(self.phase), "below_band_force": force}
        return self.states(taken, free_inertia=inertia, **same, **rest)

    def with_mass(self, mass: Array) -> MotionRecord:
        """Record with other masses (places,), kg, at the places where the mass is fitted."""
        known, new = self.known.copy(), self.mass.copy()
        for i, a in self.free_inertia.items():
            known[i] += np.float32(mass[i] - self.mass[i]) * a
            new[i] = mass[i]
        return replace(self, known=known, mass=new)


def leading_blocks(data: MotionRecord, seconds: float) -> MotionRecord:
    """Record of the first blocks of every sixth of it, about `seconds` in all; the record itself if it is no longer."""
    pick = leading_of_sixths(data.blocks, seconds * data.rate_hz / data.block)
    if pick is None:
        return data
    of_blocks = data.of_blocks(pick) | {"fold": time_folds(pick.size)}
    return data.at(joined_blocks(pick * data.block, data.block), **of_blocks)


def time_folds(blocks: int) -> NDArray[np.int64]:
    """(blocks,) number of the time fold of each block; the pieces of the folds take turns along the record."""
    pieces = TIME_FOLDS * max(1, min(FOLD_PIECES, blocks // (2 * TIME_FOLDS)))
    return np.arange(blocks) * pieces // max(blocks, 1) % TIME_FOLDS


def leading_of_sixths(total: int, blocks: float, part: int = 0) -> NDArray[np.int64] | None:
    """Indices of the first blocks of every sixth of `total` blocks, about `blocks` in all; None for hardly more.

    part : 1 for the blocks that follow on the first ones, and so on; empty behind the last.
    """
    if total <= 1.25 * max(12.0, blocks):
        return None
    per_sixth = max(2, int(blocks) // 6)
    leading = slice(part * per_sixth, (part + 1) * per_sixth)
    return np.concatenate([sixth[leading] for sixth in np.array_split(np.arange(total), 6)])


def without_bins(data: MotionRecord, low: float, high: float) -> MotionRecord:
    """Record without the bins between two frequencies, Hz; the record itself if there are none."""
    keep = (data.f_hz < low) | (data.f_hz > high)
    if keep.all():
        return data
    return replace(data, bins=data.bins[keep], shaft=data.shaft[keep], excitation_shape=data.excitation_shape[:, keep],
                   undone_noise_gain=data.undone_noise_gain[:, keep])  # fmt: skip


def without_lines(data: MotionRecord) -> MotionRecord:
    """Record without the motion at its narrow lines, and without the force that balances it.

    Each stretch is as long as its bins are narrow: a line takes its own bins and one more to either side.
    """

    def bare(z: Series) -> Series:
        out = np.array(z)
        for rows in data.stretches:
            spectrum = rfft(out[..., rows])
            step_hz = data.rate_hz / (rows.stop - rows.start)
            for line in data.lines:
                first = max(int(line.low_hz / step_hz), 0)
                spectrum[..., first : int(np.ceil(line.high_hz / step_hz)) + 1] = 0.0
            out[..., rows] = irfft(spectrum, rows.stop - rows.start)
        return out

    x, v = bare(data.x), bare(data.v)
    rms = np.array([*np.std([x, v], axis=2), data.rms[2]])
    inertia = {i: bare(a) for i, a in data.free_inertia.items()}
    return replace(data, x=x, v=v, known=bare(data.known), rms=rms, free_inertia=inertia, deflects_at_lines=False)


def fold_record(data: MotionRecord, f: int) -> MotionRecord:
    """Record of one time fold."""
    here = np.flatnonzero(data.fold == f)
    return data.at(joined_blocks(here * data.block, data.block), **data.of_blocks(here))


def oversampled(data: MotionRecord) -> MotionRecord:
    """Record with displacement, velocity, time and phase at `law_grid_factor` times the rate, all else unchanged.

    Neighbouring blocks are interpolated as one, as a law with memory takes a jump between blocks for motion.
    """
    stretches, by = data.stretches, LIMITS.law_grid_factor

    def joined(of: Callable[[Array], Array], z: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([of(z[rows]).astype(z.dtype, copy=False) for rows in stretches])

    def smooth(z: Array) -> Array:
        return interpolated(np.pad(z, HALF_SUPPORT_ROWS, mode="edge"))

    def straight(z: Array) -> Array:
        step = np.diff(z, append=2 * z[-1] - z[-2])
        return np.asarray((z[:, None] + step[:, None] * np.arange(by) / by).ravel())

    t, phase = joined(straight, data.t), joined(straight, data.phase)
    return data.states(lambda z: np.stack([joined(smooth, row) for row in z]), rate_hz=by * data.rate_hz,
                       block=by * data.block, t=t, phase=phase)  # fmt: skip


def decimated_record(data: MotionRecord, by: int) -> MotionRecord:
    """Record with every `by`-th row of displacement, velocity, time and phase."""
    rows = slice(None, None, by)
    return data.states(lambda z: z[:, rows], rate_hz=data.rate_hz / by, block=data.block // by, t=data.t[rows],
                       phase=data.phase[rows])  # fmt: skip


def mean_psd(series: Array, block: int, rate_hz: float) -> tuple[Array, Array]:
    """Frequencies, Hz, and one-sided PSD of a series (n,) of blocks laid end to end, under a Hann window."""
    rows = series[: series.size // block * block].reshape(-1, block)
    window = np.hanning(block)
    Z = np.fft.rfft(rows * window, axis=1)
    f: Array = np.asarray(np.fft.rfftfreq(block, 1 / rate_hz), dtype=np.float64)
    return f, np.asarray(np.mean(np.abs(Z) ** 2, axis=0) * 2 / (rate_hz * np.sum(window**2)))


def joined_blocks(starts: NDArray[np.int64], block: int) -> list[slice]:
    """Rows of all blocks as slices, neighbouring blocks joined. starts : first row of each."""
    cuts = np.flatnonzero(np.diff(starts) != block) + 1
    return [slice(int(s[0]), int(s[-1]) + block) for s in np.split(starts, cuts)]
