"""What may be hidden in a foreign record: how strong it is, in the numbers that the product's catalogue calls it by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .motion import LAWS, push

Array = NDArray[np.float64]
# Of the rms bearing force; of a stiffness what no straight line in x explains of it.
SHARE = {"weak": 0.02, "strong": 0.06}
OUTSIDE = ("saturating", "rippled", "smooth")  # laws that the catalogue does not have
SPECTRA = ("peaked_excitation",)  # spectra of the unknown force that it does not have
# What another author may write for an effect of the catalogue: its name there.
FORMS = {
    "smooth_friction": "coulomb", "smooth_clearance": "clearance", "stribeck": "coulomb", "other_loop": "bouc_wen",
    "half_sine_strikes": "local_defect", "two_orders": "ball_pass", "warming": "stiffness_drift",
    "off_centre": "quadratic",
}  # fmt: skip
OF_CAP = (
    "cubic", "quintic", "quadratic", "clearance", "stop", "coulomb", "quadratic_damping", "displacement_damping",
    "bouc_wen", "ball_pass", "stiffness_drift", "local_defect", *OUTSIDE,
    *FORMS,
)  # fmt: skip
OF_DIRECTION = (*OF_CAP, "pedestal", "line", "misalignment")
OF_BOTH_DIRECTIONS = ("hertz", "rub", "cross_coupling", "anisotropy", "gyroscopic")
LINEAR = ("cross_coupling", "anisotropy", "gyroscopic", "pedestal")
WHOLE = (
    "coulomb", "quadratic_damping", "displacement_damping", "bouc_wen", "ball_pass", "local_defect", "smooth_friction",
    "stribeck", "other_loop", "half_sine_strikes", "two_orders",
)  # fmt: skip
OF_TIME = ("imbalance", "misalignment", "bow", "line")
OF_FORCE = ("correlated_force", "coloured_excitation")
OF_SENSOR = ("sensor_gain", "sensor_clipping", "sensor_skew", "sensor_resonance", "sensor_noise")
OF_CATALOGUE = OF_CAP[: -len(OUTSIDE) - len(FORMS)]
CATALOGUE = (*OF_CATALOGUE, *OF_BOTH_DIRECTIONS, "pedestal", "crack", *OF_TIME, *OF_FORCE, *OF_SENSOR)
PARAMETERS = {  # in the order that `numbers` gives them
    "cubic": "kNL", "quintic": "k5", "quadratic": "kq", "clearance": "k gap", "stop": "k gap", "coulomb": "fc",
    "quadratic_damping": "cq", "displacement_damping": "cx", "bouc_wen": "k slip", "ball_pass": "k_cos k_sin order",
    "stiffness_drift": "rate curvature", "local_defect": "strike order angle width", "hertz": "k preload balls",
    "rub": "k kt clearance", "cross_coupling": "k", "anisotropy": "kxy", "gyroscopic": "g",
    "pedestal": "mass frequency damping", "crack": "loss loss_cos loss_sin", "imbalance": "a b", "misalignment": "a b",
    "bow": "a b", "line": "frequency a b", "correlated_force": "rho", "coloured_excitation": "gain corner",
    "sensor_gain": "error", "sensor_clipping": "level", "sensor_skew": "delay", "sensor_resonance": "frequency quality",
    "sensor_noise": "rms",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Size:
    """Of a cap, of the linear rotor: m kg, kL N/m, x and v rms in SI, a of what the sensor's channel measures;
    seconds, turn (rad/s), ball order and balls of the record."""

    m: float
    kL: float
    x: float
    v: float
    a: float
    seconds: float
    turn: float
    order: float
    shaft: float
    balls: int = 6


def numbers(name: str, share: float, at: Size, rng: np.random.Generator) -> tuple[float, ...]:
    """Numbers of an effect whose force has about `share` of the rms bearing force; of a sensor as large as is usual."""
    wanted, strong = share * at.kL * at.x, share > 0.03
    x, v, spread = at.x, at.v, rng.uniform
    if name in OF_TIME:
        a = np.exp(2j * np.pi * spread()) * wanted * np.sqrt(2)
        return (*((float(spread(180.0, 2500.0)),) if name == "line" else ()), float(a.real), float(a.imag))
    if name in LINEAR:
        if name == "pedestal":
            return at.m * spread(1.0, 4.0), spread(1.4, 2.4) * np.sqrt(at.kL / at.m) / (2 * np.pi), spread(0.02, 0.1)
        return (wanted / (v if name == "gyroscopic" else x),)
    if name == "crack":
        half = 0.5 * (0.3 if strong else 0.1) * at.shaft
        angle = spread(0, 2 * np.pi)
        return half, half * np.cos(angle), half * np.sin(angle)
    other = {
        "correlated_force": (spread(0.3, 0.6) if strong else 0.15,),
        "coloured_excitation": (4.0 if strong else 1.0, spread(400.0, 2500.0)),
        "peaked_excitation": (3.0 if strong else 1.0, spread(1500.0, 4000.0), 2.0),
        "sensor_gain": (spread(0.1, 0.3) if strong else 0.05,),
        "sensor_clipping": ((2.3 if strong else 3.0) * at.a,),
        "sensor_skew": (spread(0.8, 1.6) if strong else 0.3,),
        "sensor_resonance": (spread(5000.0, 7500.0) if strong else spread(9000.0, 12000.0), spread(5.0, 20.0)),
        "sensor_noise": ((0.1 if strong else 0.03) * at.a,),
    }
    if name in other:
        return other[name]
    shape: dict[str, tuple[float, ...]] = {
        "clearance": (1.0, spread(0.5, 1.3) * x),
        "stop": (1.0, spread(0.4, 1.4) * x * (1 if spread() < 0.5 else -1)),
        "bouc_wen": (1.0, spread(0.5, 1.5) * x),
        "ball_pass": (*(np.array([np.cos(a := spread(0, 6.28)), np.sin(a)])), at.order),
        "local_defect": (1.0, at.order, spread(0.0, 6.28), spread(0.03, 0.1)),
        "hertz": (1.0, spread(-0.5, 2.5) * x, float(at.balls)),
        "rub": (1.0, spread(0.1, 0.3), spread(1.0, 1.8) * x),
        "stiffness_drift": (1.0, 0.0),
        "saturating": (1.0, spread(0.6, 1.5) * x),
        "rippled": (1.0, spread(0.25, 0.5) * x),
        "smooth": (1.0, spread(0.7, 1.2) * x, spread(-1, 1), spread(-1, 1)),
        "smooth_friction": (1.0, spread(0.1, 0.3) * v),
        "smooth_clearance": (1.0, spread(0.5, 1.3) * x, 0.1 * x),
        "stribeck": (1.0, spread(0.3, 0.8) * v, 0.5),
        "other_loop": (1.0, spread(0.5, 1.5) * x, spread(0.6, 0.9)),
        "half_sine_strikes": (1.0, at.order, spread(0.0, 6.28), spread(1e-4, 4e-4), spread(0.0, 0.02)),
        "two_orders": (*(np.array([np.cos(a := spread(0, 6.28)), np.sin(a)])), at.order),
        "warming": (1.0, spread(0.2, 0.5) * at.seconds),
        "off_centre": (1.0, spread(0.3, 0.8) * x),
    }
    one = shape.get(name, (1.0,))
    rms = rest_of_line(name, one, at, rng)
    amplitudes = 2 if name in ("ball_pass", "two_orders", "rub") else 1
    scaled = [wanted / rms * q for q in one[:amplitudes]]
    return tuple(float(q) for q in (*scaled, *one[amplitudes:]))


def rest_of_line(name: str, one: tuple[float, ...], at: Size, rng: np.random.Generator) -> float:
    """rms, N, of what no straight line in x explains of a law, of those in WHOLE of all of it, in a Gaussian motion of
    the cap; of one with memory in a swing of its frequency."""
    n = 20_000
    x, v, xo = rng.standard_normal((3, n)) * np.array([at.x, at.v, at.x])[:, None]
    t, z = rng.uniform(0.0, at.seconds, n), np.zeros(n)
    if name in ("bouc_wen", "other_loop"):
        beta = one[2] if name == "other_loop" else 0.5
        w = at.v / at.x
        dt = 0.01 / w
        swing = 1.0 + 0.3 * np.sin(0.02 * w * dt * np.arange(n))
        angle = w * dt * np.arange(n)
        x, v = np.sqrt(2) * at.x * swing * np.sin(angle), np.sqrt(2) * at.v * swing * np.cos(angle)
        for k in range(1, n):
            z[k] = z[k - 1] + dt * (v[k] - (beta * abs(v[k]) * z[k - 1] + (1 - beta) * v[k] * abs(z[k - 1])) / one[1])
    p = np.array([*one, *np.zeros(5 - len(one))])
    f = np.array([push(LAWS.index(name), p, *q, m) for *q, m in zip(x, v, xo, t, at.turn * t, z, strict=True)])
    if name in WHOLE:
        return float(np.sqrt(np.mean(f**2)))
    X = np.stack([np.ones(n), x], axis=1)
    return float(np.std(f - X @ np.linalg.lstsq(X, f, rcond=None)[0]))
