"""Foreign records: a rig drawn at random, an effect that its rig file lacks, sensors and a recorder of another make."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from . import hidden
from .motion import Law, Rotor, motion

Array = NDArray[np.float64]
RATE_HZ = 25600.0
# Of the recorder, before it keeps one step of several: name -> second-order sections, or taps of a linear phase.
RECORDERS = ("linear phase", "linear phase", "linear phase", "butterworth", "bessel", "mean")
ORDER = 2.1  # ball passes a turn
DOFS = ("bearing1.x", "bearing2.x", "disc.x", "bearing1.y", "bearing2.y", "disc.y")
SHAFTS = {
    "chain": [[1.0, 0, -1], [0, 1, -1], [-1, -1, 2]],
    "beam": [[1.0, 1, -2], [1, 1, -2], [-2, -2, 4]],
    "none": [[0.0, 0, 0], [0, 0, 0], [0, 0, 1]],  # a disc that nothing sees
}
AT = {name: i for i, name in enumerate(DOFS)}


@dataclass(slots=True)
class Case:
    """What is hidden (name -> bearing1 | both) and how strongly; everything else of a record follows from the seed."""

    hidden: dict[str, str]
    strength: str
    seed: int
    seconds: float = 60.0
    growth: float = 1.0  # of the rms of the unknown force along the record
    varied: bool = False  # another shaft, rate, set of channels, sensors of other kinds: see `_varied`

    @property
    def key(self) -> str:
        what = "+".join(f"{name}@{at}" for name, at in self.hidden.items()) or "complete"
        return f"{what}/{self.strength}/{self.seed}{'/varied' * self.varied}"

    def rng(self, use: int) -> np.random.Generator:
        """Random numbers of this case alone."""
        return np.random.default_rng([self.seed, use, zlib.crc32(self.key.encode())])


def _draw(case: Case) -> dict[str, Any]:
    """The rig of a case, SI."""
    rng = case.rng(1)

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    stiff = bool(rng.uniform() < 0.4)
    masses = [log(0.12, 0.5)] * 2
    masses[1] *= log(0.8, 1.25)
    kL = {p: masses[int(p[7]) - 1] * (2 * np.pi * log(700.0, 1700.0)) ** 2 for p in ("bearing1.x", "bearing2.x")}
    kL |= {f"{p[:-1]}y": k * log(0.85, 1.2) for p, k in list(kL.items())}
    c = {p: 2 * log(0.008, 0.03) * np.sqrt(k * masses[int(p[7]) - 1]) for p, k in kL.items()}
    S = {p: log(4e-5, 2e-4) for p in kL}
    mean = float(np.mean([*kL.values()]))
    return {
        "m": masses, "disc": log(0.4, 1.5), "kL": kL, "c": c, "S": S, "ks": mean * (log(0.3, 1.2) if stiff else
        log(0.005, 0.03)), "cs": log(0.2, 2.0), "rpm": log(1500.0, 9000.0) * (4.0 if "crack" in case.hidden else 1.0),
        "low": rng.uniform(110.0, 250.0), "high": rng.uniform(6000.0, 9000.0), "noise": log(3e-4, 5e-3),
        "cubic": rng.uniform() < 0.6, "oversample": int(rng.choice([8, 10, 12])),
        "recorder": str(rng.choice(RECORDERS)), "shaft": "chain", "rate": RATE_HZ,
        "channels": [f"b{n}{d}" for n in (1, 2) for d in "xy"], "kind": "acceleration", "unit": "m/s^2",
        "high_pass": 0.0, "offset": 0.0, "known": True, "forced": False,
    }  # fmt: skip


# kind of sensor -> units and their SI values
UNITS = {"acceleration": {"m/s^2": 1.0, "g": 9.80665}, "velocity": {"mm/s": 1e-3}}


def _varied(rig: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The rig on another shaft or none, recorded at another rate by fewer channels, or others, coupled to AC; of one in
    five the force is measured, too."""
    shaft = str(rng.choice(["chain", "beam", "none"]))
    sets = [["b1x", "b2x"], rig["channels"]] + ([["b1x", "b1y"], ["b1x"]] if shaft == "none" else [])
    kind = str(rng.choice(["acceleration"] * 4 + ["velocity"]))
    rate = float(rng.choice([12800.0, 25600.0, 51200.0]))
    return rig | {
        "shaft": shaft, "channels": sets[int(rng.integers(len(sets)))], "kind": kind, "rate": rate,
        "unit": str(rng.choice([*UNITS[kind]])), "high_pass": float(rng.choice([0.0, 0.5, 5.0])),
        "offset": float(rng.choice([0.0, 0.1])), "known": bool(rng.uniform() < 0.7),
        "high": min(rig["high"], 0.38 * rate), "oversample": int(2 * rig["oversample"] * max(RATE_HZ / rate, 0.5)),
        "forced": bool(rng.uniform() < 0.2),
    }  # fmt: skip


def rig_file(rig: dict[str, Any], base: list[str]) -> str:
    """What the user knows of it."""
    sensor = f'kind = "{rig["kind"]}"\nunit = "{rig["unit"]}"\n'
    channels = "".join(
        f'[[channel]]\nname = "{c}"\nnode = "bearing{c[1]}"\ndirection = "{c[2]}"\n{sensor}' for c in rig["channels"]
    )
    if rig["forced"]:
        channels += channels.replace('name = "b', 'name = "f').replace(sensor, 'kind = "force"\nunit = "N"\n')
    name = f'schema = 1\n[rig]\nname = "foreign"\nshaft = "{rig["shaft"]}"\n'
    turns = f"speed_rpm = {rig['rpm']!r}\nball_pass_order = {ORDER}\n" if rig["known"] else ""
    if rig["shaft"] == "none":
        masses = "".join(f"bearing{n} = {rig['m'][n - 1]!r}\n" for n in sorted({int(c[1]) for c in rig["channels"]}))
        return (
            f"{name}{turns}[rig.mass]\n{masses}[band]\nlow = {rig['low']:.1f}\nhigh = {rig['high']:.1f}\n"
            f"[model]\neffects = {base}\n{channels}"
        )
    return (
        f"{name}{turns}"
        f"[rig.mass]\ndisc = {rig['disc']!r}\nbearing1 = {rig['m'][0]!r}\nbearing2 = {rig['m'][1]!r}\n"
        f"[rig.shaft_spring]\nstiffness = {rig['ks']!r}\ndamping = {rig['cs']!r}\n"
        f"[band]\nlow = {rig['low']:.1f}\nhigh = {rig['high']:.1f}\n[model]\neffects = {base}\n{channels}"
    )


@dataclass(slots=True)
class Bench:
    """A rotor being put together. known : (degree of freedom, rad/s, N) of forces of time. shape, sensor : numbers of
    what is no law of the rotor. truth : full name of a parameter -> value."""

    rig: dict[str, Any]
    case: Case
    rng: np.random.Generator
    M: Array = field(init=False)
    C: Array = field(init=False)
    K: Array = field(init=False)
    S: Array = field(init=False)
    size: dict[str, hidden.Size] = field(init=False)
    laws: list[Law] = field(default_factory=list)
    known: list[tuple[int, float, complex]] = field(default_factory=list)
    shape: dict[str, tuple[float, ...]] = field(default_factory=dict)
    sensor: dict[str, tuple[float, ...]] = field(default_factory=dict)
    truth: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rig, n = self.rig, len(DOFS)
        shaft = np.kron(np.eye(2), SHAFTS[rig["shaft"]])
        self.M = np.diag([*rig["m"], rig["disc"]] * 2)
        self.K = rig["ks"] * shaft + np.diag([rig["kL"].get(d, 0.0) for d in DOFS])
        self.C = rig["cs"] * shaft + np.diag([rig["c"].get(d, 0.0) for d in DOFS])
        self.S = np.array([rig["S"].get(d, 0.0) for d in DOFS])
        self.truth = {f"{place}.{q}": rig[q][place] for place in rig["kL"] for q in ("kL", "c", "S")}
        P = self.rotor().covariance()
        R = np.linalg.solve(self.M, np.hstack([self.K, self.C]))
        a = np.sqrt(np.maximum(np.diag(R @ P @ R.T), 0.0) + self.S / np.diag(self.M) ** 2 * rig["rate"] / 2)
        self.size = {
            d: hidden.Size(
                self.M[i, i], rig["kL"][d], np.sqrt(P[i, i]), np.sqrt(P[n + i, n + i]),
                np.sqrt(P[n + i, n + i]) if rig["kind"] == "velocity" else a[i],
                self.case.seconds, self.turn, ORDER, rig["ks"],
            )
            for i, d in enumerate(DOFS) if d in rig["kL"]
        }  # fmt: skip

    @property
    def turn(self) -> float:
        """rad/s of the shaft."""
        return float(2 * np.pi * self.rig["rpm"] / 60)

    def rotor(self) -> Rotor:
        more = (0, len(self.M) - len(DOFS))  # below pedestals no law acts
        laws = [replace(a, along=np.pad(a.along, more), across=np.pad(a.across, more)) for a in self.laws]
        return Rotor(self.M, self.C, self.K, self.S, self.turn, laws)

    def add(self, name: str, where: str, share: float) -> None:
        """An effect at bearing1 or both, of a share of the bearing force."""
        before: tuple[float, ...] = ()
        for end in ("bearing1", "bearing2") if where == "both" else ("bearing1",):
            if name not in hidden.OF_DIRECTION:
                self._add_whole(name, end, self._numbers(name, f"{end}.x", share))
                continue
            for place in (f"{end}.x", f"{end}.y"):
                own = self._numbers(name, place, share)
                if before and name in ("local_defect", "stop"):  # one ball, one side
                    own = (own[0], *before[1:])
                before = own
                self._tell(place, name, own)
                self._add_at(name, place, own)

    def _numbers(self, name: str, place: str, share: float) -> tuple[float, ...]:
        return hidden.numbers(name, share, self.size[place], self.rng)

    def _tell(self, place: str, name: str, numbers: tuple[float, ...]) -> None:
        names = hidden.PARAMETERS.get(name, "").split()
        if name == "sensor_skew":
            numbers = (numbers[0] / self.rig["rate"],)
        self.truth |= {f"{place}.{name}.{q}": v for q, v in zip(names, numbers, strict=False)}

    def _add_whole(self, name: str, end: str, own: tuple[float, ...]) -> None:
        """What has one set of numbers for both directions, or for the shaft, the force or a sensor."""
        x, y = AT[f"{end}.x"], AT[f"{end}.y"]
        of_disc = name in ("crack", "imbalance", "bow")
        self._tell("disc" if of_disc else end if name in hidden.OF_BOTH_DIRECTIONS else f"{end}.x", name, own)
        if name in ("cross_coupling", "anisotropy"):
            self.K[x, y] += own[0]
            self.K[y, x] += own[0] if name == "anisotropy" else -own[0]
        elif name == "gyroscopic":
            self.C[x, y] += own[0]
            self.C[y, x] -= own[0]
        elif name in ("hertz", "rub"):
            self.laws += [self._law(name, x, y, (*own, 0.0)), self._law(name, y, x, (*own, 1.0))]
        elif name == "crack":
            self.laws += [self._law(name, AT[f"disc.{d}"], AT[f"disc.{d}"], own) for d in "xy"]
            for d, law in zip("xy", self.laws[-2:], strict=True):
                law.along[[AT[f"bearing1.{d}"], AT[f"bearing2.{d}"]]] = -0.5
        elif of_disc:
            for d, force in (("x", complex(*own)), ("y", -1j * complex(*own))):
                self.known.append((AT[f"disc.{d}"], self.turn, force))
                if name == "bow":
                    self.known += [(AT[f"bearing{e}.{d}"], self.turn, -force / 2) for e in (1, 2)]
        else:
            (self.shape if name in (*hidden.OF_FORCE, *hidden.SPECTRA) else self.sensor)[name] = own

    def _add_at(self, name: str, place: str, own: tuple[float, ...]) -> None:
        """What has numbers of its own in every direction."""
        i = AT[place]
        if name == "pedestal":
            self._add_pedestal(i, self.rig["kL"][place], self.rig["c"][place], *own)
        elif name == "line":
            self.known.append((i, 2 * np.pi * own[0], complex(own[1], -own[2])))
        elif name == "misalignment":
            self.known.append((i, 2 * self.turn, complex(own[0], -own[1])))
        else:
            self.laws.append(self._law(name, i, i + 3 if i < 3 else i - 3, own))

    def _law(self, name: str, dof: int, across: int, own: tuple[float, ...]) -> Law:
        """Between the ground and a degree of freedom."""
        return Law(name=name, along=np.eye(len(DOFS))[dof], across=np.eye(len(DOFS))[across], numbers=own)

    def _add_pedestal(self, i: int, k: float, c: float, mass: float, hz: float, damping: float) -> None:
        """The bearing at i stands on a mass of its own instead of on the ground."""
        n, w = len(self.M), 2 * np.pi * hz
        self.M, self.C, self.K = (np.pad(a, ((0, 1), (0, 1))) for a in (self.M, self.C, self.K))
        self.S = np.append(self.S, 0.0)
        self.M[n, n] = mass
        self.K[i, n], self.K[n, i], self.K[n, n] = -k, -k, k + mass * w**2
        self.C[i, n], self.C[n, i], self.C[n, n] = -c, -c, c + 2 * damping * mass * w


def made(case: Case) -> tuple[Bench, list[str], Array]:
    """The rotor with its truth, the effects of its rig file, and (n, channels) counts times scale in their unit."""
    rig = _draw(case)
    if case.varied:
        rig = _varied(rig, case.rng(5))
    bench = Bench(rig, case, case.rng(2))
    base = ["cubic"] if rig["cubic"] and "cubic" not in case.hidden else []
    for name in base:
        bench.add(name, "both", 0.02)
    for name, where in case.hidden.items():
        bench.add(name, where, hidden.SHARE[case.strength])
    scale, y = _recorded(bench)
    return bench, base, np.round(y / scale) * scale


def _recorded(bench: Bench) -> tuple[Array, Array]:
    """((channels,) unit a count, (n, channels) in that unit) as a recorder keeps it."""
    case, rig, S = bench.case, bench.rig, bench.S
    rate, rng = rig["rate"] * rig["oversample"], case.rng(3)
    first, second = AT["bearing1.x"], AT["bearing2.x"]
    gain, colour = _colour(bench.shape, rate)
    state = np.zeros(len(colour[1]) - 1)

    def force(t: Array, out: Array) -> Array:
        nonlocal state
        if "correlated_force" in bench.shape:
            rho = bench.shape["correlated_force"][0]
            out[:, second] *= np.sqrt(1 - rho**2)
            out[:, second] += rho * out[:, first] * np.sqrt(S[second] / S[first])
        if gain:
            extra = rng.standard_normal(t.size) * np.sqrt(gain * S[first] * rate / 2)
            extra, state = signal.lfilter(*colour, extra, zi=state)
            out[:, first] += extra
        out *= (1.0 + (case.growth - 1.0) * t / case.seconds)[:, None]
        for dof, w, amplitude in bench.known:
            out[:, dof] += np.real(amplitude * np.exp(1j * w * t))
        return out

    caps = [AT[f"bearing{c[1]}.{c[2]}"] for c in rig["channels"]]
    chunks = motion(bench.rotor(), force, rate, case.seconds, case.rng(4))
    which = {"velocity": 2, "acceleration": 3}[rig["kind"]]
    unit = UNITS[rig["kind"]][rig["unit"]]
    kept = [np.stack([out[which][:, caps] / unit, out[0][:, caps]]).astype(np.float32) for out in chunks]
    motions, forces = np.concatenate(kept, axis=1)
    sensors = [_sampled(motions, rig, rate, bench.sensor, rng)]
    sensors += [_sampled(forces, rig, rate, {}, rng)] if rig["forced"] else []
    return np.concatenate([np.full(y.shape[1], scale) for scale, y in sensors]), np.hstack([y for _, y in sensors])


def _colour(shape: dict[str, tuple[float, ...]], rate: float) -> tuple[float, tuple[Array, Array]]:
    """Power over S, at its strongest, of a force beside the white one, and the filter that makes it of white noise."""
    if "peaked_excitation" in shape:
        gain, hz, quality = shape["peaked_excitation"]
        return gain, signal.iirpeak(hz, quality, fs=rate)
    gain, corner = shape.get("coloured_excitation", (0.0, 1.0))
    return gain, signal.bilinear([2 * np.pi * corner], [1.0, 2 * np.pi * corner], rate)


def _sampled(
    a: NDArray[np.float32], rig: dict[str, Any], rate: float, sensor: dict[str, tuple[float, ...]],
    rng: np.random.Generator,
) -> tuple[float, Array]:  # fmt: skip
    """Sensors, the recorder's filter and its counts."""
    keep = rig["oversample"]
    columns = []
    rms, unit = float(np.std(a)), UNITS[rig["kind"]][rig["unit"]]
    for k in range(a.shape[1]):
        y = a[:, k].astype(np.float64)
        faulty = sensor if k == 0 else {}
        if "sensor_resonance" in faulty:
            hz, quality = faulty["sensor_resonance"]
            w = 2 * np.pi * hz
            y = signal.lfilter(*_discrete(w, quality, rate), y)
        if "sensor_skew" in faulty:
            late = faulty["sensor_skew"][0] * keep
            y = np.interp(np.arange(y.size) - late, np.arange(y.size), y)
        if "sensor_gain" in faulty:
            y *= 1.0 + faulty["sensor_gain"][0]
        y = _filtered(y, rig["recorder"], keep)[::keep]
        if rig["high_pass"]:
            y = signal.sosfilt(signal.butter(1, rig["high_pass"], "high", fs=rig["rate"], output="sos"), y)
        y += rig["offset"] * rms
        loud = rig["noise"] * rms
        y += rng.standard_normal(y.size) * loud
        if "sensor_noise" in faulty:
            y += rng.standard_normal(y.size) * faulty["sensor_noise"][0] / unit
        columns.append(y)
    out = np.stack(columns, axis=1)
    scale = 1.05 * float(np.abs(out).max()) / 32767
    if "sensor_clipping" in sensor:
        level = sensor["sensor_clipping"][0] / unit
        out[:, 0] = np.clip(out[:, 0], -level, level)
    return scale, out


def _discrete(w: float, quality: float, rate: float) -> tuple[Array, Array]:
    """Of 1 / (1 - (f/f0)^2 + i f/(f0 Q)), without the bend of the bilinear rule at f0."""
    warped = 2 * rate * np.tan(w / (2 * rate))
    b, a = signal.bilinear([warped**2], [1.0, warped / quality, warped**2], rate)
    return np.asarray(b), np.asarray(a)


def _filtered(y: Array, recorder: str, keep: int) -> Array:
    """Before one of `keep` steps is kept."""
    if recorder == "mean":
        return np.asarray(signal.lfilter(np.full(keep, 1.0 / keep), [1.0], y))
    if recorder == "butterworth":
        return np.asarray(signal.sosfilt(signal.butter(8, 0.42 * 2 / keep, output="sos"), y))
    if recorder == "bessel":
        return np.asarray(signal.sosfilt(signal.bessel(6, 0.45 * 2 / keep, norm="mag", output="sos"), y))
    taps = signal.firwin(60 * keep + 1, 0.45 * 2 / keep, window=("kaiser", 9.0))
    return np.asarray(signal.oaconvolve(y, taps, mode="same"))
