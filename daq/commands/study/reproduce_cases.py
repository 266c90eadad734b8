"""Section 5 of Tiwari and Vyas (1997): the simulated rigs, and what each method finds of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.identification.moments import Cap, Plane, PlaneMoments, fokker_planck
from estimator.model import BearingGeometry, Channel, EffectUse, Model, Setting
from estimator.simulation import Simulator

Array = NDArray[np.float64]
RATE_HZ = 12800.0
RECORD_SECONDS = 160.0
OVERSAMPLE_FACTOR = 8
BOOTSTRAP_BLOCKS = 64
BOOTSTRAP_REPLICATES = 100
PAPER_METHODS = ("eq. (36) midpoint", "eq. (36) response", "score, density form", "score, velocity form")
TRUE_KNL = 1.3e18  # N/m^3
NONLINEARITY_SHARE = 0.1  # kNL E[x^2] / kL that the level of the force is set for
TRUE_STIFFNESS = {"bearing1.x": 10.0e6, "bearing2.x": 11.0e6, "bearing1.y": 9.2e6, "bearing2.y": 10.4e6}  # kL, N/m
TRUE_DAMPING = {"bearing1.x": 60.0, "bearing2.x": 65.0, "bearing1.y": 55.0, "bearing2.y": 58.0}  # c, N s/m
DISC_KG = 0.515  # kg; the caps 0.245 (vertical, x) and 0.220 (horizontal, y): physics.md section 4
CAP_KG = {"x": 0.245, "y": 0.220}
SOFT_SHAFT = 155e3  # N/m, 12 EI / L^3 of a 10 mm steel shaft, elements of about 0.2 m
PAPER_BEARING = BearingGeometry(6, 6e-3, 20e-3, 3.09e-3, preload=0.3e-6)


@dataclass(frozen=True, slots=True)
class Case:
    """One simulated rig and its record. x, v : direction -> (n, 2) m and m/s. temperature : J."""

    name: str
    title: str
    model: Model
    temperature: float
    _: KW_ONLY
    x: dict[str, Array]
    v: dict[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One parameter in and out. value, sd : None where not identifiable; interval : 95 %."""

    case: str
    masses: str
    direction: str
    parameter: str
    unit: str
    true: float
    method: str
    value: float | None
    sd: float | None

    @property
    def interval(self) -> tuple[float, float] | None:
        if self.value is None or self.sd is None:
            return None
        return self.value - 1.96 * self.sd, self.value + 1.96 * self.sd

    def to_json(self) -> dict[str, Any]:
        names = ("case", "masses", "direction", "parameter", "unit", "true", "method", "value", "sd")
        return {n: getattr(self, n) for n in names} | {"interval": self.interval}


def paper_model(shaft_stiffness: float) -> tuple[Model, float]:
    """The rig with force levels of one temperature T (Q = 2 T C, the exact condition), and T in J."""
    temperature = NONLINEARITY_SHARE * TRUE_STIFFNESS["bearing1.x"] ** 2 / TRUE_KNL
    linear = {
        place: {
            "kL": Setting(kL),
            "c": Setting(TRUE_DAMPING[place]),
            "S": Setting(4.0 * temperature * TRUE_DAMPING[place]),
        }
        for place, kL in TRUE_STIFFNESS.items()
    }
    channels = tuple(
        Channel(f"{place}.{kind}", place.split(".")[0], place.split(".")[1], kind)
        for place in TRUE_STIFFNESS
        for kind in ("displacement", "velocity")
    )
    mass = {"disc": DISC_KG} | {place: CAP_KG[place[-1]] for place in TRUE_STIFFNESS}
    cubic = EffectUse("cubic", {place: {"kNL": Setting(TRUE_KNL)} for place in TRUE_STIFFNESS})
    model = Model(
        channels,
        (150.0, 5000.0),
        shaft="chain",
        mass=mass,
        shaft_stiffness=shaft_stiffness,
        bearing=PAPER_BEARING,
        linear=linear,
        effects=(cubic,),
        name="tiwari_vyas_1997",
    )
    return model, temperature


def run_case(name: str, title: str, shaft: float, seconds: float, seed: int, progress: Callable[[float], None]) -> Case:
    """Simulate one rig: exponential Runge-Kutta, force held over the step, started from the stationary density."""
    model, temperature = paper_model(shaft)
    source = Simulator(model, RATE_HZ, seed, OVERSAMPLE_FACTOR)
    parts = []
    chunks = max(1, round(seconds / 10.0))
    for k in range(chunks):
        parts.append(source.next(round(seconds * RATE_HZ / chunks)))
        progress((k + 1) / chunks)
    y = np.concatenate(parts)
    column = {c.name: i for i, c in enumerate(model.channels)}

    def take(direction: str, kind: str) -> Array:
        return y[:, [column[f"{node}.{direction}.{kind}"] for node in ("bearing1", "bearing2")]]

    x = {d: take(d, "displacement") for d in CAP_KG}
    v = {d: take(d, "velocity") for d in CAP_KG}
    return Case(name=name, title=title, model=model, temperature=temperature, x=x, v=v)


def plane_of(case: Case, direction: str, masses_known: bool) -> Plane:
    """The direction as eq. (36) has it: disc integrated out of the density, masses given or not."""
    mass = CAP_KG[direction] if masses_known else None
    caps = tuple(Cap(f"{node}.{direction}", (1, 3), mass) for node in ("bearing1", "bearing2"))
    return Plane(direction, caps, case.model.shaft_stiffness, 0.5, b=-0.5)


def _score(plane: Plane, x: Array, v: Array, velocity: bool) -> tuple[dict[str, float], Array]:
    moments = PlaneMoments(plane, "velocity" if velocity else "density")
    size = len(x) // BOOTSTRAP_BLOCKS
    for at in range(0, len(x), size):
        moments.add(x[at : at + size], v[at : at + size])
    return moments.values()


def estimates(case: Case, direction: str, masses_known: bool, replicates: int = BOOTSTRAP_REPLICATES) -> list[Row]:
    """Parameters out, by every method, beside those that went in."""
    plane = plane_of(case, direction, masses_known)
    x, v = case.x[direction], case.v[direction]
    rows = []
    for method in PAPER_METHODS:
        if method.startswith("eq"):
            form: fokker_planck.Form = "midpoint" if "midpoint" in method else "response"
            values, cov = fokker_planck.fokker_planck_parameters(plane, x, v, form, replicates)
        else:
            values, cov = _score(plane, x, v, "velocity" in method)
        sds = np.sqrt(np.diag(cov))
        judged = plane.judged({n: (values[n], float(sd)) for n, sd in zip(values, sds, strict=True)})
        for name, parameter in judged.items():
            place, kind = name.rsplit(".", 1)[0].removesuffix(".cubic"), name.rsplit(".", 1)[1]
            kL = TRUE_STIFFNESS[place]
            true = {"kL": kL, "kNL": TRUE_KNL, "lambda": TRUE_KNL / kL, "m": CAP_KG[direction]}[kind]
            value, sd, unit = parameter.value, parameter.sd, parameter.unit
            if kind == "m":  # the paper's mu = m3/m
                kind, unit, true = "mu", "1", DISC_KG / true
                if value is not None and sd is not None:
                    value, sd = DISC_KG / value, DISC_KG / value * sd / value
            given = "given" if masses_known else "unknown"
            rows.append(
                Row(
                    case=case.name,
                    masses=given,
                    direction=direction,
                    parameter=f"{place}.{kind}",
                    unit=unit,
                    true=true,
                    method=method,
                    value=value,
                    sd=sd,
                )
            )
    return rows
