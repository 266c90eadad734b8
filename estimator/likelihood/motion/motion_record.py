"""A record as equal blocks of band-limited motion: what comparison and diagnosis work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes, Series
from estimator.model.disc import Disc
from estimator.signals.band_limit import noise_shape

from .harmonics import BelowBandForce, PeriodicForce
from .law_smoothing import HALF_SUPPORT_ROWS, MIN_SMOOTHING_SD, interpolated

TIME_FOLDS = 6  # of every record, for held-out errors and standard deviations
_OTHER_DIRECTION = {"x": "y", "y": "x"}
MAX_MOTION_ERROR_REL = 0.1  # of the motion of a cap; with a larger error the cap is not judged


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionRecord:
    """Valid blocks laid end to end, n = blocks * block rows. SI.

    v, x : (places, n) band-limited motion; known : (places, n) N, the part of the force that needs no estimate:
    m a + shaft and disc. t : (n,) s from the start of the record; phase : (n,) rad, of the shaft, by a tacho or at the
    model's speed. start : (blocks,) first row of each block in the record. fold : (blocks,) number of the time fold.
    v, x, known and slow are in single precision. It rounds a force by some millionths of k x; memory, which is most of
    what a record of minutes costs, is half.
    """

    places: tuple[str, ...]
    kinds: tuple[str, ...]  # of their sensors
    rate_hz: float
    band: tuple[float, float]
    block: int
    bins: NDArray[np.int64]  # of the block spectrum: those in the band, without the resonance of the disc
    start: NDArray[np.int64]
    fold: NDArray[np.int64]
    v: Series
    x: Series
    known: Series
    t: Array
    phase: Array
    mass: Array
    speed: float  # rad/s, 0 if unknown
    shaft: NDArray[np.complex128]  # (bins, places, places) N/m, shaft and disc as seen by the caps
    colour: Array  # (places, bins) shape of the force spectrum that the model has, mean about 1
    left_out: Array  # (places, 2) sd of the displacement and velocity outside of the band
    rms: Array  # (3, places) of x, of v and of a, over the whole record
    driven: Array  # (places,) N^2/Hz, PSD of the measured forces; 0 without
    sharpened: Array  # (places, bins) by what undoing a response has multiplied its noise, in power
    echoes: Array  # (images, places, bins) PSD of acceleration that sampling folds back, over S: recorder.py
    folded_beside: Array  # (places, bins) the same, not over S, beside a measured force: folded_force.py
    alike_beside: Complexes  # (places, bins) the force that goes with it
    passed: Complexes  # (2, places, bins) sensor_response.passed_of_images
    measured: Series | None = None  # (places, n) displacement below the band, where the sensor is one of displacement
    slow: Series | None = None  # (places, n) all of it that the laws see: below_band.py
    calm: Series | None = None  # (places, n) what laws see of x beside it, less the noise of sensors: denoise.py
    doubt: Array | float = 0.0  # (places, 2) sd of the displacement and velocity that this leaves
    shared: tuple[tuple[int, int], ...] = ()  # pairs of places whose unknown forces the model lets be correlated
    pushes: tuple[BelowBandForce, ...] = ()  # the model's periodic forces below the band, which laws feel
    waves: tuple[
        PeriodicForce, ...
    ] = ()  # amplitudes of the model's periodic forces; `known` has what is known of them
    level: Array | None = None  # (places, blocks) power of the unknown force over its mean: excitation_level.py
    disc: Disc | None = None  # on its shaft, where there is one: shaft_law.py
    shaken: Series | None = None  # (places, n) N, measured forces below the band: below_band.py
    drawn: Array | None = None  # (places,) rms by which motion drawn beyond a ceiling is off, over its own: declip.py

    @property
    def measured_force(self) -> bool:
        return bool(self.driven.any())

    @property
    def folded(self) -> Array:
        """(places, bins) PSD of acceleration that sampling folds back, over S."""
        return np.asarray(self.echoes.sum(axis=0))

    def unsure(self, i: int) -> float:
        """How far off the motion at a place is, over its own, where some was drawn; inf where nothing can be judged."""
        return 0.0 if self.drawn is None else float(self.drawn[i])

    def passed_on(self, off: Mapping[str, float]) -> Array:
        """(places,) how far off the motion is, over its own, where it is off by so much at some places (inf: nothing is
        known of it): at the other cap by as much as the force that the shaft brings there is of that in its bearing."""
        out = np.array([off.get(place, 0.0) for place in self.places])
        for i, own in enumerate(out.copy()):
            if own and (o := self.opposite(i)) is not None:
                near = int(np.argmin(np.abs(2 * np.pi * self.f_hz - self.rms[1, i] / self.rms[0, i])))
                shaft = float(np.abs(self.shaft[near, o, i]))
                bearing = self.mass[o] * self.rms[1, o] ** 2 / self.rms[0, o]  # m w^2 x, as k x at its resonance
                brought = min(own, 1.0) * shaft * self.rms[0, i] / bearing
                out[o] = max(out[o], brought if brought < MAX_MOTION_ERROR_REL else np.inf)
        return out

    @property
    def judged(self) -> tuple[int, ...]:
        """Indices of the places that can be judged."""
        return tuple(i for i in range(len(self.places)) if self.unsure(i) < np.inf)

    @property
    def lost(self) -> frozenset[str]:
        """The places that cannot."""
        return frozenset(self.places).difference(self.places[i] for i in self.judged)

    @property
    def blocks(self) -> int:
        return int(self.start.size)

    @property
    def fold_blocks(self) -> Array:
        """(folds,) blocks of each time fold."""
        return np.bincount(self.fold, minlength=TIME_FOLDS).astype(np.float64)

    @property
    def fold_rows(self) -> NDArray[np.int64]:
        """(folds,) rows of each time fold; of rows that are not whole blocks any more, its share of them."""
        last = np.cumsum(self.fold_blocks) * self.x.shape[1] // self.blocks
        return np.asarray(np.diff(last, prepend=0), dtype=np.int64)

    def over_folds(self, means: Array) -> Array:
        """The mean over the record of means over its time folds (folds, ...)."""
        return np.asarray(np.tensordot(self.fold_rows / self.fold_rows.sum(), means, 1))

    @property
    def stretches(self) -> list[slice]:
        """Rows that follow one another in the record."""
        cuts = np.flatnonzero(np.diff(self.t) * self.rate_hz > 1.5) + 1
        return [slice(a, b) for a, b in zip([0, *cuts.tolist()], [*cuts.tolist(), self.t.size], strict=True)]

    @property
    def f_hz(self) -> Array:
        """Frequencies of the bins, (bins,)."""
        return np.asarray(np.fft.rfftfreq(self.block, 1 / self.rate_hz)[self.bins], dtype=np.float64)

    def heard(self, A: NDArray[np.complex128]) -> Array:
        """(places, bins) PSD of force over that of white noise of the place's own sensor, through A (bins, places,
        places)."""
        return np.asarray(np.abs(np.einsum("kii->ik", A)) ** 2 * self.noise_shape)

    @property
    def noise_shape(self) -> Array:
        """(places, bins) PSD as acceleration of white noise of the sensors, over that noise."""
        return np.asarray(noise_shape(self.kinds, 2 * np.pi * self.f_hz) * self.sharpened)

    @property
    def seconds(self) -> float:
        return self.blocks * self.block / self.rate_hz

    def other(self, i: int) -> int | None:
        """Index of the other direction at the same node."""
        node, direction = self.places[i].split(".")
        name = f"{node}.{_OTHER_DIRECTION[direction]}"
        return self.places.index(name) if name in self.places else None

    def opposite(self, i: int) -> int | None:
        """Index of the same direction at the other bearing."""
        node, direction = self.places[i].split(".")
        name = f"{'bearing2' if node == 'bearing1' else 'bearing1'}.{direction}"
        return self.places.index(name) if name in self.places else None

    def seen(self, i: int) -> Series:
        """(n,) displacement at a place as its laws see it."""
        return np.asarray(self.x[i] if self.slow is None else self.x[i] + self.slow[i])

    def calmed(self, i: int) -> Series:
        """(n,) the same without the noise of sensors: denoise.py."""
        return self.seen(i) if self.calm is None else np.asarray(self.seen(i) + self.calm[i])

    def sizes(self, i: int) -> Array:
        """(4,) rms of x, v at a place and of x, v in the other direction, 0 without one."""
        o = self.other(i)
        return np.concatenate([self.rms[:2, i], np.zeros(2) if o is None else self.rms[:2, o]])

    def smoothing(self, i: int) -> Array:
        """(4,) sqrt(3) sd of what a law sees of x, v, xo, vo beside the motion in the band: law_smoothing.py."""
        o = self.other(i)
        both = np.hypot(self.left_out, self.doubt)
        lost = np.concatenate([both[i], np.zeros(2) if o is None else both[o]])
        return np.asarray(np.sqrt(3.0) * np.maximum(lost, MIN_SMOOTHING_SD * self.sizes(i)))

    def sign(self, i: int) -> float:
        return 1.0 if self.places[i].endswith("x") else -1.0

    def states(self, of: Callable[[Series], Series], **rest: Any) -> MotionRecord:
        """With v, x and the slow displacement, (places, n) each, as `of` makes them, and other fields as given."""
        measured, slow, calm = (None if z is None else of(z) for z in (self.measured, self.slow, self.calm))
        return replace(self, v=of(self.v), x=of(self.x), measured=measured, slow=slow, calm=calm, **rest)

    def in_one(self) -> MotionRecord:
        """With the displacement that laws see, less the noise of sensors, as one: all that their tangents need."""
        x = np.stack([self.calmed(i) for i in range(len(self.places))])
        return replace(self, x=x, measured=None, slow=None, calm=None, shaken=None)

    def of_blocks(self, some: NDArray[np.int64]) -> dict[str, Any]:
        """The fields that have a value for every block, of some of them."""
        level = None if self.level is None else self.level[:, some]
        return {"start": self.start[some], "fold": self.fold[some], "level": level}

    def at(self, rows: slice | list[slice] | NDArray[np.bool_], **rest: Any) -> MotionRecord:
        """Only these rows: views of them if they are a slice. rest : fields that change with them."""

        def taken(z: Series) -> Series:
            if isinstance(rows, list):
                return np.concatenate([z[..., run] for run in rows], axis=-1)
            return z[..., rows] if isinstance(rows, slice) else np.ascontiguousarray(z[..., rows])

        shaken = None if self.shaken is None else taken(self.shaken)
        same = {"known": taken(self.known), "t": taken(self.t), "phase": taken(self.phase), "shaken": shaken}
        return self.states(taken, **same, **rest)


def leading_blocks(data: MotionRecord, seconds: float) -> MotionRecord:
    """Some consecutive blocks of every time fold, about `seconds` in all; the data themselves if they are no longer."""
    per_fold = max(2, int(seconds * data.rate_hz / data.block / TIME_FOLDS))
    if data.blocks <= 1.25 * per_fold * TIME_FOLDS:
        return data
    pick = np.concatenate([np.flatnonzero(data.fold == f)[:per_fold] for f in range(TIME_FOLDS)])
    return data.at(joined_blocks(pick * data.block, data.block), **data.of_blocks(pick))


def without_bins(data: MotionRecord, low: float, high: float) -> MotionRecord:
    """The same without the bins between; the data themselves if there are none."""
    keep = (data.f_hz < low) | (data.f_hz > high)
    if keep.all():
        return data
    return replace(data, bins=data.bins[keep], shaft=data.shaft[keep], colour=data.colour[:, keep],
                   sharpened=data.sharpened[:, keep], echoes=data.echoes[..., keep],
                   folded_beside=data.folded_beside[:, keep], alike_beside=data.alike_beside[:, keep],
                   passed=data.passed[..., keep])  # fmt: skip


def fold_record(data: MotionRecord, f: int) -> MotionRecord:
    """The blocks of one time fold, as views of the record."""
    here = np.flatnonzero(data.fold == f)
    rows = slice(int(here[0]) * data.block, (int(here[-1]) + 1) * data.block)
    return data.at(rows, **data.of_blocks(here))


def oversampled(data: MotionRecord, by: int = 4) -> MotionRecord:
    """Displacement, velocity, time and phase of the blocks at `by` times the rate; the rest as it was.

    Blocks that follow one another are interpolated as one: a law that remembers takes a leap between them for motion.
    """
    stretches = data.stretches

    def joined(of: Callable[[Array], Array], z: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([of(z[rows]).astype(z.dtype, copy=False) for rows in stretches])

    def smooth(z: Array) -> Array:
        return interpolated(np.pad(z, HALF_SUPPORT_ROWS, mode="edge"), by)

    def straight(z: Array) -> Array:
        step = np.diff(z, append=2 * z[-1] - z[-2])
        return np.asarray((z[:, None] + step[:, None] * np.arange(by) / by).ravel())

    t, phase = joined(straight, data.t), joined(straight, data.phase)
    return data.states(lambda z: np.stack([joined(smooth, row) for row in z]), rate_hz=by * data.rate_hz,
                       block=by * data.block, t=t, phase=phase)  # fmt: skip


def decimated_record(data: MotionRecord, by: int) -> MotionRecord:
    """Every so manyth row of displacement, velocity, time and phase of finer blocks."""
    rows = slice(None, None, by)
    return data.states(lambda z: z[:, rows], rate_hz=data.rate_hz / by, block=data.block // by, t=data.t[rows],
                       phase=data.phase[rows])  # fmt: skip


def mean_psd(series: Array, block: int, rate_hz: float) -> tuple[Array, Array]:
    """One-sided PSD of blocks laid end to end, Hann window."""
    rows = series[: series.size // block * block].reshape(-1, block)
    window = np.hanning(block)
    Z = np.fft.rfft(rows * window, axis=1)
    f: Array = np.asarray(np.fft.rfftfreq(block, 1 / rate_hz), dtype=np.float64)
    return f, np.asarray(np.mean(np.abs(Z) ** 2, axis=0) * 2 / (rate_hz * np.sum(window**2)))


def joined_blocks(starts: NDArray[np.int64], block: int) -> list[slice]:
    """The rows of all blocks, neighbours joined."""
    cuts = np.flatnonzero(np.diff(starts) != block) + 1
    return [slice(int(s[0]), int(s[-1]) + block) for s in np.split(starts, cuts)]
