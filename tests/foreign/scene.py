"""A rig and all that surrounds it, drawn at random: what is true. All of a case follows from its kind and seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

KINDS = ("complete", "one", "two", "mistake")
ONE_CAP = (("b1x",), ("b1x", "b1y"))
TWO_CAPS = (("b1x", "b2x"), ("b1x", "b1y", "b2x"), ("b1x", "b1y", "b2x", "b2y"))
LAWS_OF_CAP = (
    "cubic", "clearance", "coulomb", "quadratic", "bouc_wen", "ball_pass", "stop", "quadratic_damping", "hertz",
    "displacement_damping", "quintic", "stiffness_drift",
)  # fmt: skip
BOTH_DIRECTIONS = ("rub", "cross_coupling", "anisotropy", "gyroscopic")
# The order in which seeds take them, so that a short run has all sorts. Strikes come thrice, as on machines.
EFFECTS = (
    "local_defect", "cubic", "imbalance", "coulomb", "clearance", "line", "quadratic", "misalignment", "local_defect",
    "bouc_wen", "sensor_clipping", "ball_pass", "stop", "cross_coupling", "quadratic_damping", "hertz", "local_defect",
    "stiffness_drift", "anisotropy", "displacement_damping", "rub", "correlated_force", "quintic", "gyroscopic",
    "crack",
)  # fmt: skip
MISTAKES = ("cap_mass", "shaft_spring", "swapped", "speed", "disc_mass", "inverted", "rate")
STIFF_SHAFT = ("crack", "cap_mass", "disc_mass", "swapped", "inverted")  # on a soft one nothing of them can be seen
TWO_OF_A_DIRECTION = (*STIFF_SHAFT, "shaft_spring", "correlated_force")
RATES_HZ = (1600.0, 2048.0, 2560.0, 4096.0, 5000.0, 8000.0, 10000.0, 12800.0, 20000.0, 25600.0, 48000.0, 51200.0)
MAX_SAMPLES = 16_000_000  # of all channels: memory at the inner rate
MIN_NATS = 60.0  # of an effect, given all the rest: less is not to be seen by anybody
MIN_SHARE, MAX_SHARE = 0.03, 0.25  # of the rms bearing force
MIN_LINE = 60.0  # power over the floor that each line of strikes has in the squared envelope, if they came evenly
MIN_DAMPING_OF_WHIRL = 0.04  # of a rotor that a circulating force drives: with less, a share of 3 % is not stable


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A structural mode beside the bearing's own. place : of the cap. form : "support", below the bearing, or
    "attached", on the cap. mass kg, hz, damping : of it alone."""

    place: str
    form: str
    mass: float
    hz: float
    damping: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Around:
    """All that is beside the rotor and its laws.

    once, twice : rms bearing force of the tones at 1 and 2 x shaft speed, of the rms bearing force. sway : m/s rms with
    which all caps go round together, on soil and feet, at 1 x; a quarter of it at 2 x. wander : rms of the
    speed, relative, wander_s : its memory. hum : (Hz, rms of the channel's rms). colour : place -> (Hz, Hz) of the zero
    and the pole of the unknown force. level : rms of the logarithm of its level. white, pink : rms of noise, of the
    channel's rms. mount : (Hz, quality). filter : (kind, order, cutoff Hz). ac_hz : high pass, 0 for none. bits : of a
    count.
    """

    once: float
    twice: float
    sway: float
    wander: float
    wander_s: float
    hum: tuple[tuple[float, float], ...]
    modes: tuple[Mode, ...]
    colour: dict[str, tuple[float, float]]
    level: float
    white: float
    pink: float
    mount: tuple[float, float]
    filter: tuple[str, int, float]
    filter_given: bool
    ac_hz: float
    bits: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A case. Masses kg, stiffness N/m, damping N s/m, S N^2/Hz one-sided, by bearing or by place; share : of the
    bearing force that an effect has; hidden : effect -> where; mistake : what is wrong in the rig file, "" for nothing;
    factor : of the wrong number."""

    kind: str
    seed: int
    seconds: float
    rate_hz: float
    keep: int
    channels: tuple[str, ...]
    sensor: str
    unit: str
    tacho: bool
    shaft: str
    m: dict[str, float]
    kL: dict[str, float]
    c: dict[str, float]
    S: dict[str, float]
    disc: float
    ks: float
    cs: float
    rpm: float
    masses_known: bool
    speed_known: bool
    balls: int
    ratio: float
    band: tuple[float, float]
    cubic: bool
    share: float
    hidden: dict[str, str]
    mistake: str = ""
    factor: float = 1.0
    strikes: dict[str, Any] = field(default_factory=dict)
    around: Around

    @property
    def places(self) -> tuple[str, ...]:
        """Of all caps that move: on a shaft both, also one that nobody measures."""
        return tuple(self.kL)

    @property
    def measured(self) -> tuple[str, ...]:
        """Places with a sensor."""
        return tuple(f"bearing{c[1]}.{c[2]}" for c in self.channels)

    def rng(self, use: int) -> np.random.Generator:
        """Random numbers of this case for one use."""
        return np.random.default_rng([self.seed, KINDS.index(self.kind), use])

    @property
    def fade_s(self) -> float:
        """Time in which a strike fades: short beside the band."""
        return max(2 / self.rate_hz / self.keep, 0.1 / self.band[1])

    @property
    def orders(self) -> dict[str, float]:
        """Strikes a turn by name, contact angle 0."""
        n, g = self.balls, self.ratio
        return {"BPFO": n / 2 * (1 - g), "BPFI": n / 2 * (1 + g), "2BSF": (1 - g**2) / g, "FTF": (1 - g) / 2}


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Any magnitude between the two is as likely."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw(kind: str, seed: int, seconds: tuple[float, float], effects: tuple[str, ...] = ()) -> Scene:
    """The case of a kind and a seed. effects : to be hidden, or the mistake; none for those of the seed's turn."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 0])
    wanted = effects or _turn_of(kind, seed, rng)
    scene = _rig(kind, seed, seconds, wanted)
    scene = replace(scene, around=_around(scene, wanted))
    zeta = max(scene.c[p] / (2 * np.sqrt(scene.kL[p] * scene.m[p[:8]])) for p in scene.measured)
    w = min(np.sqrt(scene.kL[p] / scene.m[p[:8]]) for p in scene.measured)
    least = float(np.sqrt(MIN_NATS * 8 * zeta / (scene.seconds * w)))
    share = min(max(log_uniform(rng, MIN_SHARE, 4 * MIN_SHARE), least), MAX_SHARE)
    if "cross_coupling" in wanted:
        share = min(share, max(MIN_SHARE, zeta))
    if kind == "mistake":
        factor = {"speed": 1 + 0.03 * rng.choice([-1, 1]), "rate": 1 + 0.024 * rng.choice([-1, 1])}
        times = {"cap_mass": 2.0, "disc_mass": 2.0, "shaft_spring": 10.0}.get(wanted[0], 1.0)
        return replace(scene, mistake=wanted[0], factor=float(factor.get(wanted[0], times ** rng.choice([-1, 1]))))
    strikes = {}
    if "local_defect" in wanted:
        name = str(rng.choice(["BPFO", "BPFI", "2BSF"]))
        slip = rng.uniform(0.0, 0.02)
        ratio = np.sqrt(MIN_LINE / scene.seconds / (scene.band[1] - scene.band[0]))  # of powers, strikes over force
        audible = float(np.sqrt(ratio * 8 * zeta / w / (4 * scene.fade_s)))
        strikes = {
            "share": max(log_uniform(rng, MIN_SHARE, 4 * MIN_SHARE), audible),
            "name": name, "order": scene.orders[name] * (1 - slip), "slip": slip,
            "jitter": log_uniform(rng, 1e-3, 1e-2), "modulated": 0.0 if name == "BPFO" else rng.uniform(0.2, 0.8),
        }  # fmt: skip
    two_ended = len({c[1] for c in scene.channels}) > 1
    ends = {name: name in LAWS_OF_CAP and two_ended and bool(rng.uniform() < 0.4) for name in wanted}
    where = {name: "both" if both else "bearing1" for name, both in ends.items()}
    return replace(scene, share=share, hidden=where, strikes=strikes)


def _turn_of(kind: str, seed: int, rng: np.random.Generator) -> tuple[str, ...]:
    if kind == "mistake":
        return (MISTAKES[seed % len(MISTAKES)],)
    if kind == "one":
        return (EFFECTS[seed % len(EFFECTS)],)
    if kind == "two":
        return tuple(str(name) for name in rng.choice(sorted(set(EFFECTS)), 2, replace=False))
    return ()


def _channels(wanted: tuple[str, ...], rng: np.random.Generator) -> tuple[str, ...]:
    if "swapped" in wanted:
        return TWO_CAPS[2]
    pairs = any(w in TWO_OF_A_DIRECTION for w in wanted)
    across = any(w in BOTH_DIRECTIONS for w in wanted)
    sets = [s for s in (*(() if pairs else ONE_CAP), *TWO_CAPS) if not across or "b1y" in s]
    return sets[int(rng.integers(len(sets)))]


def _rig(kind: str, seed: int, seconds: tuple[float, float], wanted: tuple[str, ...]) -> Scene:
    """The rotor, its sensors and what the user knows, without surroundings."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 1])
    channels, rate = _channels(wanted, rng), float(rng.choice(RATES_HZ))
    need_shaft = any(w in TWO_OF_A_DIRECTION for w in wanted)
    ends = {c[1] for c in channels}
    shaft = str(rng.choice(["chain", "chain", "beam"] if need_shaft or len(ends) == 2 and rng.uniform() < 0.8 else
                           ["none", "none", "none", "chain"]))  # fmt: skip
    directions = sorted({c[2] for c in channels})
    bearings = ("1", "2") if shaft != "none" else sorted(ends)
    f0 = rate * log_uniform(rng, 0.03, 0.15)
    mass = log_uniform(rng, 0.1, float(np.clip(50.0 * 300.0 / f0, 1.0, 50.0)))  # heavy caps are slow
    m = {f"bearing{b}": mass * (1.0 if b == "1" else log_uniform(rng, 0.8, 1.25)) for b in bearings}
    hz = {f"bearing{b}.{d}": f0 * log_uniform(rng, 0.85, 1.18) for b in bearings for d in directions}
    kL = {p: m[p[:8]] * (2 * np.pi * f) ** 2 for p, f in hz.items()}
    zeta = max(log_uniform(rng, 0.003, 0.15), MIN_DAMPING_OF_WHIRL if "cross_coupling" in wanted else 0.0)
    c = {p: 2 * zeta * log_uniform(rng, 0.8, 1.25) * float(np.sqrt(k * m[p[:8]])) for p, k in kL.items()}
    rms = log_uniform(rng, 0.3, 30.0)  # m/s^2
    S = {p: (rms / (2 * np.pi * hz[p])) ** 2 * 4 * c[p] * m[p[:8]] * log_uniform(rng, 0.5, 2.0) for p in kL}
    low, high = f0 * log_uniform(rng, 0.12, 0.5), min(f0 * log_uniform(rng, 2.5, 8.0), 0.38 * rate)
    softness = log_uniform(rng, 0.3, 1.2) if any(w in STIFF_SHAFT for w in wanted) else (
        log_uniform(rng, 0.03, 0.2) if "shaft_spring" in wanted else log_uniform(rng, 0.003, 1.2))  # fmt: skip
    ks = softness * float(np.mean([*kL.values()]))
    below, inside = log_uniform(rng, 0.15 * low, 0.8 * low), log_uniform(rng, low, min(3 * f0, high))
    disc_hz = (below, inside, high * rng.uniform(1.1, 2.0))[int(rng.integers(3))]
    disc = float(np.clip(2 * ks / (2 * np.pi * disc_hz) ** 2, 0.02 * mass, 60 * mass))
    span = log_uniform(rng, *seconds)
    unit = str(rng.choice(["m/s^2", "g", "m/s^2", "g", "mm/s"]))
    turn = log_uniform(rng, 5.0, 120.0)
    certain = kind == "mistake"
    return Scene(
        kind=kind, seed=seed, seconds=min(span, MAX_SAMPLES / rate / len(channels)), rate_hz=rate, keep=8,
        channels=channels, sensor="velocity" if unit == "mm/s" else "acceleration", unit=unit,
        tacho=bool(rng.uniform() < 0.25) and not certain, shaft=shaft, m=m, kL=kL, c=c, S=S, disc=disc, ks=ks,
        cs=log_uniform(rng, 0.001, 0.01) * float(np.sqrt(2 * ks * disc)), rpm=60 * min(turn, rate / 40, 0.4 * f0),
        masses_known=bool(rng.uniform() < 0.75) or certain, speed_known=bool(rng.uniform() < 0.8) or certain,
        balls=int(rng.integers(6, 17)), ratio=rng.uniform(0.15, 0.35), band=(low, high),
        cubic=bool(rng.uniform() < 0.25) and "cubic" not in wanted, share=MIN_SHARE, hidden={}, around=NOTHING,
    )  # fmt: skip


def _around(scene: Scene, wanted: tuple[str, ...]) -> Around:
    rng = np.random.default_rng([scene.seed, KINDS.index(scene.kind), 2])
    rate, f0 = scene.rate_hz, np.sqrt(scene.kL["bearing1.x"] / scene.m["bearing1"]) / (2 * np.pi)
    own_tones = bool({"imbalance", "misalignment"} & {*wanted})
    once = log_uniform(rng, 0.05, 0.3) if {"speed", "rate"} & {*wanted} else log_uniform(rng, 0.003, 0.3)
    mains = float(rng.choice([50.0, 60.0]))
    loud = log_uniform(rng, 0.02, 0.1) if "rate" in wanted else log_uniform(rng, 1e-3, 0.1)
    multiples = [k for k in (1, 2, 3, 4, 6) if (k == 1 or rng.uniform() < 0.5) and k * mains < 0.45 * rate]
    modes = []
    for place in scene.places:
        for _ in range(int(rng.integers(2, 5))):
            support = bool(rng.uniform() < 0.5)
            mass = scene.m[place[:8]] * (log_uniform(rng, 2.0, 50.0) if support else log_uniform(rng, 0.003, 0.1))
            modes.append(Mode(place=place, form="support" if support else "attached", mass=mass, damping=
                              log_uniform(rng, 0.005, 0.08), hz=f0 * log_uniform(rng, 0.3, 4.0)))  # fmt: skip
    colour = {}
    for place in scene.places:
        zero = f0 * log_uniform(rng, 0.2, 3.0)
        colour[place] = (zero, zero * log_uniform(rng, 1 / 3, 3.0)) if rng.uniform() < 0.7 else (zero, zero)
    kind = str(rng.choice(["butterworth", "bessel", "chebyshev1", "chebyshev2", "fir", "mean"]))
    return Around(
        once=0.0 if own_tones else once, twice=0.0 if own_tones else once * rng.uniform(0.1, 0.7),
        sway=log_uniform(rng, 5e-5, 1.4e-3), wander=log_uniform(rng, 0.001, 0.01), wander_s=log_uniform(rng, 0.5, 10.0),
        hum=tuple((k * mains, loud / k**0.5 * rng.uniform(0.3, 1.0)) for k in multiples), modes=tuple(modes),
        colour=colour, level=log_uniform(rng, 0.03, 0.4), white=log_uniform(rng, 2e-4, 1e-2),
        pink=log_uniform(rng, 1e-4, 1e-2), mount=(rate * log_uniform(rng, 0.35, 3.0), log_uniform(rng, 5.0, 30.0)),
        filter=(kind, int(rng.choice([4, 6, 8])), rate * rng.uniform(0.39, 0.45)),
        filter_given=bool(rng.uniform() < 0.5), ac_hz=float(rng.choice([0.0, 0.1, 0.5, 2.0])),
        bits=int(rng.choice([16, 24])),
    )  # fmt: skip


NOTHING = Around(
    once=0.0, twice=0.0, sway=0.0, wander=0.0, wander_s=1.0, hum=(), modes=(), colour={}, level=0.0, white=0.0,
    pink=0.0, mount=(0.0, 0.0), filter=("none", 0, 0.0), filter_given=False, ac_hz=0.0, bits=24,
)  # fmt: skip
