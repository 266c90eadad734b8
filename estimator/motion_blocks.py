"""A record as equal blocks of band-limited motion: what comparison and diagnosis work on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .balance import shaft_notch, shaft_reaction
from .bandlimit import noise_shape
from .disc import Disc, disc_of
from .effects.custom import effect_of
from .effects.places import at
from .errors import DataError
from .features import NEAREST, Series
from .filtered import Filtered
from .model import MOTION, Model
from .periodic import Push, Wave, pushes, series, waves
from .plausible import check_moves
from .rotor import shaft_at_caps
from .sensor_response import echoes, forced, of_place, passed_of_images
from .shaft_angle import measured_phase
from .side_by_side import each

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
FOLDS = 6
OF_FORCE = ("coloured_excitation",)  # effects that are a shape of the spectrum of the force itself
COLOURS = (*OF_FORCE, "sensor_resonance")  # and those that look like one where they are not undone in the record
_OTHER = {"x": "y", "y": "x"}


@dataclass(frozen=True, slots=True)
class MotionBlocks:
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
    echoes: Array  # (images, places, bins) PSD of acceleration that sampling folds back, over S: roll_off.py
    folded_beside: Array  # (places, bins) the same, not over S, beside a measured force: folded_force.py
    alike_beside: Complexes  # (places, bins) the force that goes with it
    passed: Complexes  # (2, places, bins) sensor_response.passed_of_images
    measured: Series | None = None  # (places, n) displacement below the band, where the sensor is one of displacement
    slow: Series | None = None  # (places, n) all of it that the laws see: slow_motion.py
    calm: Series | None = None  # (places, n) what laws see of x beside it, less the noise of sensors: calm.py
    doubt: Array | float = 0.0  # (places, 2) sd of the displacement and velocity that this leaves
    shared: tuple[tuple[int, int], ...] = ()  # pairs of places whose unknown forces the model lets be correlated
    pushes: tuple[Push, ...] = ()  # the model's periodic forces below the band, which laws feel
    waves: tuple[Wave, ...] = ()  # amplitudes of the model's periodic forces; `known` has what is known of them
    level: Array | None = None  # (places, blocks) power of the unknown force over its mean: force_level.py
    disc: Disc | None = None  # on its shaft, where there is one: shaft_law.py
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

    @property
    def judged(self) -> tuple[int, ...]:
        """Indices of the places that can be judged."""
        return tuple(i for i in range(len(self.places)) if self.unsure(i) < np.inf)

    @property
    def blocks(self) -> int:
        return int(self.start.size)

    @property
    def fold_blocks(self) -> Array:
        """(folds,) blocks of each time fold."""
        return np.bincount(self.fold, minlength=FOLDS).astype(np.float64)

    @property
    def fold_rows(self) -> NDArray[np.int64]:
        """(folds,) rows of each time fold; of rows that are not whole blocks any more, its share of them."""
        last = np.cumsum(self.fold_blocks) * self.x.shape[1] // self.blocks
        return np.asarray(np.diff(last, prepend=0), dtype=np.int64)

    def over_folds(self, means: Array) -> Array:
        """The mean over the record of means over its time folds (folds, ...)."""
        return np.asarray(np.tensordot(self.fold_rows / self.fold_rows.sum(), means, 1))

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
        name = f"{node}.{_OTHER[direction]}"
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
        """(n,) the same without the noise of sensors: calm.py."""
        return self.seen(i) if self.calm is None else np.asarray(self.seen(i) + self.calm[i])

    def sizes(self, i: int) -> Array:
        """(4,) rms of x, v at a place and of x, v in the other direction, 0 without one."""
        o = self.other(i)
        return np.concatenate([self.rms[:2, i], np.zeros(2) if o is None else self.rms[:2, o]])

    def smoothing(self, i: int) -> Array:
        """(4,) sqrt(3) sd of what a law sees of x, v, xo, vo beside the motion in the band: features.py."""
        o = self.other(i)
        both = np.hypot(self.left_out, self.doubt)
        lost = np.concatenate([both[i], np.zeros(2) if o is None else both[o]])
        return np.asarray(np.sqrt(3.0) * np.maximum(lost, NEAREST * self.sizes(i)))

    def sign(self, i: int) -> float:
        return 1.0 if self.places[i].endswith("x") else -1.0

    def states(self, of: Callable[[Series], Series], **rest: Any) -> MotionBlocks:
        """With v, x and the slow displacement, (places, n) each, as `of` makes them, and other fields as given."""
        measured, slow, calm = (None if z is None else of(z) for z in (self.measured, self.slow, self.calm))
        return replace(self, v=of(self.v), x=of(self.x), measured=measured, slow=slow, calm=calm, **rest)

    def of_blocks(self, some: NDArray[np.int64]) -> dict[str, Any]:
        """The fields that have a value for every block, of some of them."""
        level = None if self.level is None else self.level[:, some]
        return {"start": self.start[some], "fold": self.fold[some], "level": level}

    def at(self, rows: slice | list[slice] | NDArray[np.bool_], **rest: Any) -> MotionBlocks:
        """Only these rows: views of them if they are a slice. rest : fields that change with them."""

        def taken(z: Series) -> Series:
            if isinstance(rows, list):
                return np.concatenate([z[..., run] for run in rows], axis=-1)
            return z[..., rows] if isinstance(rows, slice) else np.ascontiguousarray(z[..., rows])

        return self.states(taken, known=taken(self.known), t=taken(self.t), phase=taken(self.phase), **rest)


def part_of(data: MotionBlocks, seconds: float) -> MotionBlocks:
    """Some consecutive blocks of every time fold, about `seconds` in all; the data themselves if they are no longer."""
    per_fold = max(2, int(seconds * data.rate_hz / data.block / FOLDS))
    if data.blocks <= 1.25 * per_fold * FOLDS:
        return data
    pick = np.concatenate([np.flatnonzero(data.fold == f)[:per_fold] for f in range(FOLDS)])
    return data.at(_runs(pick * data.block, data.block), **data.of_blocks(pick))


def without_hz(data: MotionBlocks, low: float, high: float) -> MotionBlocks:
    """The same without the bins between; the data themselves if there are none."""
    keep = (data.f_hz < low) | (data.f_hz > high)
    if keep.all():
        return data
    return replace(data, bins=data.bins[keep], shaft=data.shaft[keep], colour=data.colour[:, keep],
                   sharpened=data.sharpened[:, keep], echoes=data.echoes[..., keep],
                   folded_beside=data.folded_beside[:, keep], alike_beside=data.alike_beside[:, keep],
                   passed=data.passed[..., keep])  # fmt: skip


def fold_of(data: MotionBlocks, f: int) -> MotionBlocks:
    """The blocks of one time fold, as views of the record."""
    here = np.flatnonzero(data.fold == f)
    rows = slice(int(here[0]) * data.block, (int(here[-1]) + 1) * data.block)
    return data.at(rows, **data.of_blocks(here))


def finer(data: MotionBlocks, by: int = 4) -> MotionBlocks:
    """Displacement, velocity, time and phase of the blocks at `by` times the rate; the rest as it was."""
    from scipy.fft import irfft, rfft

    def fine(z: Series) -> Series:
        Z = rfft(z.reshape(len(z), data.blocks, -1), axis=2)
        Z[..., -1] *= 0.5  # the Nyquist frequency is two lines there
        return np.asarray(by * irfft(Z, by * data.block, axis=2)).reshape(len(z), -1)

    def straight(z: Array) -> Array:
        step = np.diff(z, append=2 * z[-1] - z[-2])
        return np.asarray((z[:, None] + step[:, None] * np.arange(by) / by).ravel())

    return data.states(fine, rate_hz=by * data.rate_hz, block=by * data.block, t=straight(data.t),
                       phase=straight(data.phase))  # fmt: skip


def coarser(data: MotionBlocks, by: int) -> MotionBlocks:
    """Every so manyth row of displacement, velocity, time and phase of finer blocks."""
    rows = slice(None, None, by)
    return data.states(lambda z: z[:, rows], rate_hz=data.rate_hz / by, block=data.block // by, t=data.t[rows],
                       phase=data.phase[rows])  # fmt: skip


def spectrum(series: Array, block: int, rate_hz: float) -> tuple[Array, Array]:
    """One-sided PSD of blocks laid end to end, Hann window."""
    rows = series[: series.size // block * block].reshape(-1, block)
    window = np.hanning(block)
    Z = np.fft.rfft(rows * window, axis=1)
    f: Array = np.asarray(np.fft.rfftfreq(block, 1 / rate_hz), dtype=np.float64)
    return f, np.asarray(np.mean(np.abs(Z) ** 2, axis=0) * 2 / (rate_hz * np.sum(window**2)))


def shaft_response(model: Model, places: tuple[str, ...], f_hz: Array) -> NDArray[np.complex128]:
    """(f, places, places) N/m: what shaft and disc add to the dynamic stiffness at the measured caps."""
    D = np.zeros((f_hz.size, len(places), len(places)), complex)
    disc = model.mass.get("disc", 0.0)
    if model.shaft == "none" or disc <= 0.0:
        return D
    caps, _ = shaft_at_caps(model.shaft, model.shaft_stiffness, model.shaft_damping, disc, 2 * np.pi * f_hz)
    for i, p in enumerate(places):
        for j, q in enumerate(places):
            if p.split(".")[1] == q.split(".")[1]:
                D[:, i, j] = caps[:, int(p[7]) - 1, int(q[7]) - 1]
    return D


def cut(model: Model, y: Array, rate_hz: float, block: int = 8192) -> MotionBlocks:
    """Band-limit a record (n, channels of the model) and cut it into valid blocks.

    Raises DataError if no ten blocks are valid, or a channel does not move.
    """
    y = np.asarray(y, dtype=np.float64)
    if y.ndim != 2 or y.shape[1] != len(model.channels):
        raise DataError(
            f"the record has {y.shape[-1]} channels, the rig {len(model.channels)}: use the rig of the record"
        )
    places = model.places
    if not places:
        raise DataError("the rig has no motion channel at a bearing: nothing to compare")
    moving = [next(k for k, c in enumerate(model.channels) if c.place == p and c.kind in MOTION) for p in places]
    shaken = {c.place: k for k, c in enumerate(model.channels) if c.kind == "force"}
    columns = moving + [shaken[p] for p in places if p in shaken]
    for k in columns:
        check_moves(model.channels[k].name, y[np.isfinite(y[:, k]), k])
    while block > 1024 and y.shape[0] < 24 * block:
        block //= 2
    used = y if columns == [*range(y.shape[1])] else y[:, columns]
    motion = Filtered(
        used, [model.channels[k].kind for k in columns], rate_hz, model.band, shaft_reaction(model), slow=True
    ).whole(np.float32)
    starts = _valid_starts(motion.valid, block)
    if starts.size < 2 * FOLDS:
        needed = f"at least {2 * FOLDS * block / rate_hz:.2g} s are needed"
        if np.isfinite(used).all():
            left = f"{len(y) / rate_hz:.2g} s, {starts.size * block / rate_hz:.2g} s of it behind the analysis filter"
            raise DataError(f"the record has {left}; {needed}: record half a minute or more")
        raise DataError(
            f"only {starts.size * block / rate_hz:.2f} s in stretches of {block / rate_hz:.2g} s without a missing or "
            f"clipped sample; {needed}: see what the gaps come from, or record longer"
        )
    P = len(places)
    runs = _runs(starts, block)

    def valid(z: Series) -> Series:
        return z[:, runs[0]] if len(runs) == 1 else np.concatenate([z[:, run] for run in runs], axis=1)

    t = np.arange(len(y)) / rate_hz
    speed = 2 * np.pi * (model.speed_rpm or 0.0) / 60
    angle = measured_phase(model, y, rate_hz)
    turning = np.stack([t, speed * t if angle is None else angle])
    a, v, x, u, (t, phase) = map(valid, (motion.a, motion.v[:P], motion.x[:P], motion.u, turning))
    below = None if motion.slow is None else valid(motion.slow[:P])
    mass = np.array([model.cap_mass(p) or 1.0 for p in places])
    measured = {places.index(p): a[P + k] for k, p in enumerate(p for p in places if p in shaken)}
    for i, force in measured.items():
        if model.cap_mass(places[i]) is None:  # the scale that the force gives
            Z = np.stack([a[i], v[i], x[i]]).astype(np.float64)
            mass[i] = np.linalg.solve(Z @ Z.T, Z @ force)[0]
    known = u[:P] if len(u) else np.zeros_like(x)
    for direction in "xy":
        same = [i for i, p in enumerate(places) if p.endswith(direction)]
        reaction = known[same].sum(axis=0)
        for i in same:
            np.multiply(mass[i], a[i], out=known[i])
            known[i] += reaction
            if len(u) and model.shaft == "chain":
                known[i] += model.shaft_stiffness * x[i]
                known[i] += model.shaft_damping * v[i]
    driven = np.zeros(P)
    for i, force in measured.items():
        known[i] -= force
        driven[i] = np.mean(force**2) / (model.band[1] - model.band[0])
    rms = np.array([each(np.std, z) for z in (x, v, a[:P])])
    periodic = series(model, places, t, phase, rate_hz)
    if periodic is not None:
        known -= periodic
    fold = np.minimum(np.arange(starts.size) * FOLDS // starts.size, FOLDS - 1)
    bins = bins_of(model, rate_hz, block)
    f = np.asarray(bins * (rate_hz / block), dtype=np.float64)
    kinds = tuple(model.channels[k].kind for k in moving)
    return MotionBlocks(
        places, kinds, rate_hz, model.band, block, bins, starts, fold, v, x, known, t, phase, mass, speed,
        shaft_response(model, places, f), colours(model, places, f, OF_FORCE), np.zeros((P, 2)), rms, driven,
        sharpened(model, places, f), _echoes(model, places, kinds, mass, f), np.zeros((P, f.size)),
        np.zeros((P, f.size), complex), np.stack([passed_of_images(model, p, rate_hz, f) for p in places], axis=1),
        below, below, None, 0.0, _shared(model, places), pushes(model, places), waves(model, places, rate_hz),
        disc=disc_of(model),
    )  # fmt: skip


def bins_of(model: Model, rate_hz: float, block: int) -> NDArray[np.int64]:
    """Bins of a block spectrum that a fit looks at."""
    f = np.fft.rfftfreq(block, 1 / rate_hz)
    inside = (f >= model.band[0]) & (f <= model.band[1])
    if notch := shaft_notch(model):
        inside &= (f < notch[0]) | (f > notch[1])
    return np.flatnonzero(inside)


def _shared(model: Model, places: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    found = [at(effect_of(u), u, model) for u in model.effects if u.name == "correlated_force"]
    firsts = [p for keys in found for p in keys]
    return tuple((places.index(p), places.index(f"bearing2.{p[-1]}")) for p in firsts)


def sharpened(model: Model, places: tuple[str, ...], f_hz: Array) -> Array:
    """(places, f) |true over measured|^2 of the responses that are undone, of sensors and of recorders."""
    return np.array([1.0 / np.abs(of_place(model, p, 2 * np.pi * f_hz)) ** 2 for p in places])


def _echoes(model: Model, places: tuple[str, ...], kinds: tuple[str, ...], mass: Array, f_hz: Array) -> Array:
    """What the recorder's filter lets through above half the rate, as MotionBlocks.echoes."""
    own = [echoes(model, place, kind, f_hz) / m**2 for place, kind, m in zip(places, kinds, mass, strict=True)]
    out = np.zeros((max(map(len, own)), len(places), f_hz.size))
    for i, z in enumerate(own):
        out[: len(z), i] = z
    return out


def colours(model: Model, places: tuple[str, ...], f_hz: Array, names: tuple[str, ...] = COLOURS) -> Array:
    """(places, f) what the model's own effects make of a white force: coloured excitation and, where that is not undone
    in the record, a resonant sensor. names : of the effects."""
    from .effects import CATALOGUE

    known = forced(model)
    out = np.ones((len(places), f_hz.size))
    for use in model.effects:
        if use.name not in names:
            continue
        for i, place in enumerate(places):
            if place in known:  # a measured force has the colour that it has, and its sensor is undone
                continue
            own = [s for k, s in use.parameters.items() if k in (place, place.split(".")[0])]
            if not own:
                continue
            values = [s.value for q in CATALOGUE[use.name].parameters if (s := own[0].get(q.name)) is not None]
            a, b = (*(z for z in values if z is not None), None, None)[:2]
            if a is None or b is None:
                continue
            if use.name == "coloured_excitation":
                out[i] *= 1 + a / (1 + (f_hz / b) ** 2)
            else:
                r = f_hz / a
                out[i] /= (1 - r**2) ** 2 + (r / b) ** 2
    return out


def _runs(starts: NDArray[np.int64], block: int) -> list[slice]:
    """The rows of all blocks, neighbours joined."""
    cuts = np.flatnonzero(np.diff(starts) != block) + 1
    return [slice(int(s[0]), int(s[-1]) + block) for s in np.split(starts, cuts)]


def _valid_starts(valid: NDArray[np.bool_], block: int) -> NDArray[np.int64]:
    """First rows of as many non-overlapping all-valid blocks as there are."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(np.int8), [0]])))
    out = [np.arange(a, b - block + 1, block) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return np.concatenate(out) if out else np.zeros(0, np.int64)
