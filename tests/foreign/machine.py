"""A scene put together: matrices of the rotor with its structure, hidden laws with numbers, forces in time, motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from . import hidden
from .motion import Law, Rotor, motion
from .scene import BOTH_DIRECTIONS, LAWS_OF_CAP, MIN_NATS, Scene

Array = NDArray[np.float64]
Force = Callable[[Array, Array], Array]
SHAFTS = {"chain": [[1.0, 0, -1], [0, 1, -1], [-1, -1, 2]], "beam": [[1.0, 1, -2], [1, 1, -2], [-2, -2, 4]]}
PILOTS, PILOT_STEPS = 5, 400_000  # tries; steps of each
SICK_M_S = 7.1e-3  # rms at 1 or 2 x of an imbalance or misalignment: zone D of ISO 20816-3 begins (group 1, rigid)
SICK_DOMINANCE = 2.0  # of the velocity of a tone that is a fault over all the rest of the velocity
GIVEN_CUBIC_SHARE = 0.02  # of the bearing force, of a cubic that the rig file has


@dataclass(slots=True)
class Machine:
    """A scene in matrices.

    at : name of a degree of freedom -> index. bearing : place -> (n,) weights of what its spring feels. velocity : of
    bearing 1 x without tones, m/s rms. sway : order -> m/s rms of the machine as a whole. size : place -> magnitudes of
    the linear rotor. tones : (degree of freedom, whether of the shaft, its order or Hz, complex N). numbers :
    "PLACE.EFFECT" -> numbers of what is hidden.
    """

    scene: Scene
    at: dict[str, int] = field(default_factory=dict)
    bearing: dict[str, Array] = field(default_factory=dict)
    rotor: Rotor = field(init=False)
    velocity: float = field(init=False)
    sway: dict[float, float] = field(default_factory=dict)
    size: dict[str, hidden.Size] = field(default_factory=dict)
    tones: list[tuple[int, bool, float, complex]] = field(default_factory=list)
    numbers: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._put_together()
        self._measure()
        self._add_surrounding_tones()
        if self.scene.cubic:
            self._add("cubic", "both", GIVEN_CUBIC_SHARE, self.scene.rng(6))
        for name, where in self.scene.hidden.items():
            self._add(name, where, self.scene.share, self.scene.rng(7))

    def _put_together(self) -> None:
        s, names = self.scene, []
        shafted = s.shaft != "none"
        for d in sorted({p[-1] for p in s.places}):
            names += [p for p in s.places if p[-1] == d] + ([f"disc.{d}"] if shafted else [])
            names += [f"{m.place}.{i}" for i, m in enumerate(s.around.modes) if m.place[-1] == d]
        self.at = {name: i for i, name in enumerate(names)}
        n = len(names)
        M, C, K, S = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
        for place in s.places:
            i, felt = self.at[place], np.eye(n)[self.at[place]]
            for k, mode in enumerate(s.around.modes):
                if mode.place != place:
                    continue
                j, w = self.at[f"{place}.{k}"], 2 * np.pi * mode.hz
                M[j, j] = mode.mass
                way = np.eye(n)[j] - (np.eye(n)[i] if mode.form == "attached" else 0.0)
                K += mode.mass * w**2 * np.outer(way, way)
                C += 2 * mode.damping * w * mode.mass * np.outer(way, way)
                felt[j] = -1.0 if mode.form == "support" else 0.0
            M[i, i], S[i] = s.m[place[:8]], s.S[place]
            K += s.kL[place] * np.outer(felt, felt)
            C += s.c[place] * np.outer(felt, felt)
            self.bearing[place] = felt
        for d in {p[-1] for p in s.places} if shafted else ():
            three = [self.at[f"bearing1.{d}"], self.at[f"bearing2.{d}"], self.at[f"disc.{d}"]]
            M[three[2], three[2]] = s.disc
            K[np.ix_(three, three)] += s.ks * np.array(SHAFTS[s.shaft])
            C[np.ix_(three, three)] += s.cs * np.array(SHAFTS[s.shaft])
        self.rotor = Rotor(M, C, K, S, self.turn)

    @property
    def turn(self) -> float:
        """rad/s of the shaft, mean."""
        return float(2 * np.pi * self.scene.rpm / 60)

    def _measure(self) -> None:
        s, r, n = self.scene, self.rotor, len(self.at)
        P = r.covariance()
        R = np.linalg.solve(r.M, np.hstack([r.K, r.C]))
        self.velocity = float(np.sqrt(P[n + self.at["bearing1.x"], n + self.at["bearing1.x"]]))
        a = np.sqrt(np.maximum(np.diag(R @ P @ R.T), 0.0) + r.S / np.diag(r.M) ** 2 * s.rate_hz / 2)
        for place in s.places:
            g, i = self.bearing[place], self.at[place]
            x, v = np.sqrt(g @ P[:n, :n] @ g), np.sqrt(g @ P[n:, n:] @ g)
            channel = np.sqrt(P[n + i, n + i]) if s.sensor == "velocity" else a[i]
            self.size[place] = hidden.Size(
                s.m[place[:8]], s.kL[place], x, v, channel, s.seconds, self.turn, s.orders["BPFO"], s.ks,
                s.balls,
            )  # fmt: skip

    def receptance(self, rad_s: float) -> NDArray[np.complex128]:
        """(n, n) m/N of the linear rotor."""
        r = self.rotor
        return np.asarray(np.linalg.inv(r.K + 1j * rad_s * r.C - rad_s**2 * r.M))

    def floor(self, hz: float) -> float:
        """One-sided PSD of acceleration at bearing 1 x without tones, (m/s^2)^2/Hz: motion and noise of the sensor."""
        s, r, i = self.scene, self.rotor, self.at["bearing1.x"]
        w, rms = 2 * np.pi * hz, self.size["bearing1.x"].a
        G = self.receptance(w)[i]
        white = (s.around.white * rms) ** 2 / (s.rate_hz / 2)
        pink = (s.around.pink * rms) ** 2 / (hz * np.log(s.rate_hz * s.seconds / 2))
        noise = (white + pink) * (w**2 if s.sensor == "velocity" else 1.0)
        return float(r.S @ np.abs(w**2 * G) ** 2 + noise)

    def _add_surrounding_tones(self) -> None:
        around, rng = self.scene.around, self.scene.rng(5)
        for order, share in ((1.0, around.once), (2.0, around.twice)):
            if share:
                self._add_order(order, share, "disc" if order == 1.0 else "bearing1", rng)
            self.sway[order] = self._sway(order, around.sway / order**2, rng)

    def _sway(self, order: float, velocity: float, rng: np.random.Generator) -> float:
        """m/s rms with which the whole machine goes round at an order."""
        s, hz = self.scene, order * self.turn / (2 * np.pi)
        if ("imbalance", "misalignment")[int(order) - 1] in s.hidden:
            return max(SICK_DOMINANCE * self.velocity, SICK_M_S * rng.uniform(1.0, 2.5))
        if s.mistake not in ("speed", "rate"):
            return velocity
        bins = 1.0 + 2 * s.around.wander * hz * s.seconds  # that a wandering speed spreads it over
        return max(velocity, float(np.sqrt(MIN_NATS * bins * self.floor(hz) / s.seconds)) / (2 * np.pi * hz))

    def _add_order(self, order: float, share: float, where: str, rng: np.random.Generator) -> None:
        """A force at an order that goes round, of a share of the rms bearing force at bearing 1."""
        where = where if f"{where}.x" in self.at else "bearing1"
        G = self.receptance(order * self.turn)[:, self.at[f"{where}.x"]]
        size = self.size["bearing1.x"]
        force = np.sqrt(2) * share * size.x / abs(self.bearing["bearing1.x"] @ G) * np.exp(2j * np.pi * rng.uniform())
        for d, turned in (("x", 1.0), ("y", -1j)):
            if f"{where}.{d}" in self.at:
                self.tones.append((self.at[f"{where}.{d}"], True, order, force * turned))

    def _add(self, name: str, where: str, share: float, rng: np.random.Generator) -> None:
        """An effect of a share of the bearing force."""
        if name in ("imbalance", "misalignment"):
            order, dof = (1.0, "disc") if name == "imbalance" else (2.0, "bearing1")
            self._add_order(order, share, dof, rng)
            return
        own = hidden.numbers(name, share, self.size["bearing1.x"], rng) if name != "local_defect" else ()
        if name == "line":
            low, high = self.scene.band
            hz = float(rng.uniform(low, min(high, 4 * low)))
            own = (hz, *own[1:])
            self.tones.append((self.at["bearing1.x"], False, hz, complex(own[1], -own[2])))
        self.numbers[f"bearing1.{name}"] = own
        if name in BOTH_DIRECTIONS:
            self._add_both_directions(name, own)
        elif name == "crack":
            for d in "xy":
                if f"disc.{d}" in self.at:
                    bend = np.zeros(len(self.at))
                    bend[[self.at[f"{q}.{d}"] for q in ("bearing1", "bearing2", "disc")]] = -0.5, -0.5, 1.0
                    self.rotor.laws.append(Law(name=name, along=bend, across=bend, numbers=own))
        elif name in LAWS_OF_CAP:
            for place in self.scene.places:
                if where == "both" or place.startswith("bearing1"):
                    g = self.bearing[place]
                    self.rotor.laws.append(Law(name=name, along=g, across=g, numbers=own))

    def _add_both_directions(self, name: str, own: tuple[float, ...]) -> None:
        x, y, r = self.bearing["bearing1.x"], self.bearing["bearing1.y"], self.rotor
        if name in ("cross_coupling", "anisotropy"):
            r.K[:] += own[0] * (np.outer(x, y) + (1 if name == "anisotropy" else -1) * np.outer(y, x))
        elif name == "gyroscopic":
            r.C[:] += own[0] * (np.outer(x, y) - np.outer(y, x))
        else:
            ways = ((x, y, 0.0), (y, x, 1.0))
            r.laws.extend(Law(name=name, along=g, across=o, numbers=(*own, k)) for g, o, k in ways)

    def moved(self) -> Moved:
        """The whole record at the inner rate."""
        s = self.scene
        rate, rng = s.rate_hz * s.keep, s.rng(8)
        rotation = Rotation(s, rng)
        caps = [self.at[p] for p in s.measured]
        rows = np.vstack([np.eye(len(self.at))[caps], *(self.bearing[p] for p in s.measured)])
        driven = sorted({*(self.at[p] for p in s.places), *(t[0] for t in self.tones)})
        force = Forces(self, driven, rate, rotation)
        kept: list[NDArray[np.float32]] = []
        coarse: list[Array] = []
        for _, x, v, a, laws in motion(self.rotor, force, rate, s.seconds, rng, rotation, rows, driven):
            kept.append((v if s.sensor == "velocity" else a)[:, : len(caps)].astype(np.float32))
            series = np.hstack([x[:, len(caps) :], v[:, len(caps) :], laws])
            whole = len(series) // s.keep * s.keep
            coarse.append(series[:whole].reshape(-1, s.keep, series.shape[1]).mean(axis=1))
        return Moved(np.concatenate(kept), np.concatenate(coarse), rotation, len(caps))


@dataclass(frozen=True, slots=True)
class Moved:
    """caps : (n, channels) of the sensors' kind, at the inner rate, SI. coarse : displacement and velocity of the
    bearings of the channels, then laws, means of `keep` steps. rotation : the shaft."""

    caps: NDArray[np.float32]
    coarse: Array
    rotation: Rotation
    channels: int

    def share(self, machine: Machine) -> float | None:
        """rms of a hidden law, of the rms spring force, at the cap where it is largest; of a stiffness what no line in
        displacement explains of it. None where no law of a measured cap is hidden."""
        s, out = machine.scene, []
        for k, law in enumerate(machine.rotor.laws):
            for c, place in enumerate(s.measured):
                if law.name not in s.hidden or law.along is not machine.bearing[place]:
                    continue
                f, x = self.coarse[:, 2 * self.channels + k], self.coarse[:, c]
                if not np.all(np.isfinite(self.coarse)):
                    return np.inf  # the law drives the rotor out of its bearings
                X = np.stack([np.ones_like(x), x], axis=1)
                rest = f if law.name in hidden.WHOLE else f - X @ np.linalg.lstsq(X, f, rcond=None)[0]
                out.append(float(np.sqrt(np.mean(rest**2)) / (s.kL[place] * np.std(x))))
        return max(out, default=None)


def sized(scene: Scene) -> Scene:
    """The scene with hidden laws of the share that it says in the motion that they leave: some seconds tried for it."""
    wanted = scene.share
    tried = replace(scene, seconds=min(scene.seconds, PILOT_STEPS / scene.rate_hz / scene.keep))
    for _ in range(PILOTS):
        machine = Machine(tried)
        got = None if "stiffness_drift" in scene.hidden else machine.moved().share(machine)
        if got is None or 0.9 * wanted < got < 1.5 * wanted:
            break
        tried = replace(tried, share=tried.share * float(np.clip(wanted / got, 0.3, 3.0)))
    return replace(scene, share=tried.share)


class Rotation:
    """Shaft angle, rad, of time, s: a speed that wanders."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        around, step = scene.around, 1e-3
        self.t = np.arange(0.0, scene.seconds + 2 * step, step)
        keep = np.exp(-step / around.wander_s)
        white = rng.standard_normal(len(self.t)) * np.sqrt(1 - keep**2)
        wander = around.wander * signal.lfilter([1.0], [1.0, -keep], white)
        speed = 2 * np.pi * scene.rpm / 60 * (1.0 + wander - wander.mean())
        self.angle = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2) * step])

    def __call__(self, t: Array) -> Array:
        return np.interp(t, self.t, self.angle)


class Forces:
    """The forces that act, chunk by chunk: coloured, of changing level, with tones and strikes."""

    def __init__(self, machine: Machine, driven: list[int], rate: float, rotation: Rotation) -> None:
        s = machine.scene
        self.machine, self.driven, self.rotation, self.rate = machine, driven, rotation, rate
        rng = s.rng(9)
        self.knots = np.linspace(0.0, s.seconds, 7)
        self.level = np.exp(s.around.level * rng.standard_normal((7, len(driven))))
        self.colour: dict[int, list[Array]] = {}
        for place, (zero, pole) in s.around.colour.items():
            b, a = signal.bilinear(*([1 / (2 * np.pi * f), 1.0] for f in (zero, pole)), rate)
            self.colour[driven.index(machine.at[place])] = [b, a, np.zeros(1)]
        self.strikes, self.ring = self._strikes(rng), np.zeros(1)
        self.rho = machine.numbers.get("bearing1.correlated_force", (0.0,))[0]

    def _strikes(self, rng: np.random.Generator) -> Array:
        """(n, 2) s and relative height of every strike."""
        how, rotation = self.machine.scene.strikes, self.rotation
        if not how:
            return np.empty((0, 2))
        n = int(how["order"] * rotation.angle[-1] / (2 * np.pi))
        angles = 2 * np.pi * (np.arange(n) + rng.uniform() + how["jitter"] * rng.standard_normal(n)) / how["order"]
        turns = 1.0 if how["name"] == "BPFI" else self.machine.scene.orders["FTF"]
        heights = 1.0 + how["modulated"] * np.cos(turns * angles) + 0.1 * rng.standard_normal(n)
        return np.stack([np.interp(angles, rotation.angle, rotation.t), heights], axis=1)

    def __call__(self, t: Array, out: Array) -> Array:
        angle = self.rotation(t)
        if self.rho:
            first, second = (self.driven.index(self.machine.at[f"bearing{b}.x"]) for b in "12")
            S1, S2 = (self.machine.scene.S[f"bearing{b}.x"] for b in "12")
            out[:, second] *= np.sqrt(1 - self.rho**2)
            out[:, second] += self.rho * out[:, first] * np.sqrt(S2 / S1)
        for k in range(out.shape[1]):
            if k in self.colour:
                b, a, state = self.colour[k]
                out[:, k], self.colour[k][2] = signal.lfilter(b, a, out[:, k], zi=state)
            out[:, k] *= np.interp(t, self.knots, self.level[:, k])
        for dof, by_turn, order, amplitude in self.machine.tones:
            phase = order * angle if by_turn else 2 * np.pi * order * t
            out[:, self.driven.index(dof)] += np.real(amplitude * np.exp(1j * phase))
        if len(self.strikes):
            self._strike(t, out)
        return out

    def _strike(self, t: Array, out: Array) -> None:
        """Strikes that fade within a few steps, of the share of the bearing force in their rms."""
        machine, dt = self.machine, 1.0 / self.rate
        s, now = machine.scene, self.strikes[(self.strikes[:, 0] >= t[0]) & (self.strikes[:, 0] < t[-1] + dt)]
        pulses = np.zeros(len(t))
        np.add.at(pulses, np.minimum(((now[:, 0] - t[0]) / dt).astype(int), len(t) - 1), now[:, 1])
        pulses, self.ring = signal.lfilter([1.0], [1.0, -np.exp(-dt / s.fade_s)], pulses, zi=self.ring)
        per_s = s.strikes["order"] * s.rpm / 60
        size = machine.size["bearing1.x"]
        height = s.strikes["share"] * size.kL * size.x / np.sqrt(per_s * s.fade_s / 2)
        for d, part in (("x", 1.0), ("y", 0.6)):
            if f"bearing1.{d}" in machine.at:
                out[:, self.driven.index(machine.at[f"bearing1.{d}"])] += height * part * pulses
