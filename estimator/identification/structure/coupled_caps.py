"""A sensor whose gain or delay is wrong, told by what two caps answer each other through the shaft.

Of a channel that reads g times its motion the equation of motion, times g, has its known mass again, and
    D1 y1 + g B x2 = g F1,    D2 x2 + B y1 / g = F2,
B what shaft and disc put between the caps: it seems to be stronger one way and weaker the other by the same factor,
g = 1 + error or exp(-i w delay). A shaft or a disc other than the rig file's changes both ways alike, a cap's mass one
of them. Which of the two sensors is wrong, by g or by 1 / g, is not told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.effects.places import at, written
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.effects.sensor.sensor_skew import SENSOR_SKEW
from estimator.identification.finding import Finding
from estimator.likelihood.motion.force_balance import shaft_notch
from estimator.likelihood.path.subproblem import Subproblem, subproblem
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.response.regressor_set import Regressor
from estimator.model.rig import EffectUse, Model, Setting
from estimator.model.rotor import between_caps, shaft_matrix
from estimator.parallel import map_threads
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY, RESPONSE_EFFECTS

GAIN_EFFECT, SKEW_EFFECT = SENSOR_GAIN.name, SENSOR_SKEW.name
# Changes of B: ln of its size in the first cap's force and in the second's, its delay (s) and, in the second's, advance
FAULT_PATTERNS = {GAIN_EFFECT: (1.0, -1.0, 0.0, 0.0), SKEW_EFFECT: (0.0, 0.0, 1.0, 1.0)}
OTHER_PATTERNS = (
    (1.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, -1.0),
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
)  # shaft, masses
MAX_SD_BY_EFFECT = {
    GAIN_EFFECT: 0.05,
    SKEW_EFFECT: 0.3,
}  # standard deviation, of 1 and of a sample, beyond which nothing is said
MIN_FAULT_BY_EFFECT = {GAIN_EFFECT: 2e-3, SKEW_EFFECT: 0.01}  # that no calibration would show
MIN_GAIN_NATS = 10.0  # nats, for a cause, and for another one beside it
MAX_STEPS = 30  # of Newton's method at most
DAMPING_REL = 0.03  # of the root of stiffness and mass
MAX_FAULT_P_VALUE = 1e-3  # p-value above which nothing is said
FINDING_NOTE = (
    "found from the response of the caps to each other through the shaft: the inverse error of the other cap's sensor "
    "would look the same"
)


@dataclass(frozen=True, slots=True)
class Between:
    """Changes of the coupling B between two caps, in the directions of `FAULT_PATTERNS`.

    i, j : indices of the locations. mean : (4,). information : (4, 4). rms : (4,) N, force of a unit of each change.
    """

    i: int
    j: int
    mean: Array
    information: Array
    rms: Array

    def along(self, *directions: tuple[float, ...]) -> tuple[Array, Array]:
        """The likeliest multiples of some directions and their covariance."""
        H = np.array(directions).T
        C = np.linalg.inv(H.T @ self.information @ H)
        return C @ (H.T @ self.information @ self.mean), C

    def nats(self, *directions: tuple[float, ...]) -> float:
        """What they explain."""
        z, C = self.along(*directions)
        return float(0.5 * z @ np.linalg.solve(C, z))


def find_coupled_sensor_faults(model: Model, point: WorkingPoint) -> list[Finding]:
    """Gains and delays of sensors that the model does not have yet, the likelier one of each pair of caps."""
    out = []
    for i, j in _pairs(model, point):
        here = {point.data.places[i], point.data.places[j]}
        uses = [use for use in model.effects if use.name in RESPONSE_EFFECTS]
        used = {use.name for use in uses if here.intersection(at(CATALOGUE[use.name], use, model))}
        if not used.issubset(GAIN_AND_DELAY):  # undone, by numbers whose errors would be a delay
            continue
        if names := [name for name in _told(model, point, i, j) if name not in used]:
            out += _found(point, _between(model, point, i, j), names)
    return out


def _found(point: WorkingPoint, seen: Between, names: list[str]) -> list[Finding]:
    """The likeliest fault, if nothing else that may be wrong with B is likelier."""
    places, rate = point.data.places, point.data.rate_hz
    name = max(names, key=lambda one: seen.nats(FAULT_PATTERNS[one]))
    alone, other = seen.nats(FAULT_PATTERNS[name]), max(OTHER_PATTERNS, key=lambda one: seen.nats(one))
    both = seen.nats(FAULT_PATTERNS[name], other) > alone + MIN_GAIN_NATS
    gain = seen.nats(FAULT_PATTERNS[name], other) - seen.nats(other) if both else alone
    z, C = seen.along(FAULT_PATTERNS[name], *([other] if both else []))
    p = float(chdtrc(1, 2 * gain)) * len(FAULT_PATTERNS) * len(places)
    unit = 1.0 / rate if name == SKEW_EFFECT else 1.0
    if abs(z[0]) < MIN_FAULT_BY_EFFECT[name] * unit or C[0, 0] > (MAX_SD_BY_EFFECT[name] * unit) ** 2:
        return []
    if alone < seen.nats(other) or gain < MIN_GAIN_NATS or p > MAX_FAULT_P_VALUE:
        return []
    k = _whose(point, seen, name, float(z[0]))
    own = _parameter(name, float(z[0]) if k == seen.i else -float(z[0]), float(np.sqrt(C[0, 0])))
    force = np.abs(z[0] * np.array(FAULT_PATTERNS[name])) * seen.rms
    power = {seen.i: float(force[0] ** 2 + force[2] ** 2), seen.j: float(force[1] ** 2 + force[3] ** 2)}
    where = f"{places[seen.i]} and {places[seen.j]} respond to each other differently"
    return [
        Finding(
            effect=name,
            at=(places[k],),
            gain_nats=gain,
            dof=1,
            p_value=p,
            power_N2=power,
            against="other_bearing",
            region=where,
            settings={places[k]: own},
            note=FINDING_NOTE,
        )
    ]


def _whose(point: WorkingPoint, seen: Between, name: str, z: float) -> int:
    """Which of the two: the one that is late; of a gain the one without which forces of both directions are alike."""
    if name == SKEW_EFFECT:
        return seen.i if z > 0 else seen.j
    apart = np.zeros(2)
    for row, k in enumerate((seen.i, seen.j)):
        if (o := point.data.other(k)) is not None:
            apart[row] = np.log(point.S[k] / point.S[o])
    return seen.i if abs(apart[0] - 2 * z) + abs(apart[1]) <= abs(apart[0]) + abs(apart[1] + 2 * z) else seen.j


def _parameter(name: str, z: float, sd: float) -> dict[str, Parameter]:
    """The number of a fault that is a change of B by z."""
    if name == SKEW_EFFECT:
        return {"delay": Parameter(z, sd, "s")}
    return {"error": Parameter(float(np.expm1(z)), float(np.exp(z)) * sd, "1")}


def refined(model: Model, point: WorkingPoint) -> tuple[Model, dict[str, Parameter]]:
    """The model with the numbers of such faults, those undone in the record of the point, one step nearer, and these as
    parameters. Of two sensors of a pair the first."""
    found: dict[str, Parameter] = {}
    uses = {use.name: use for use in model.effects}
    for i, j in _pairs(model, point) if uses.keys() & set(GAIN_AND_DELAY) else ():
        sought: dict[str, tuple[str, float]] = {}
        for name in set(_told(model, point, i, j)) & uses.keys():
            keys = at(CATALOGUE[name], uses[name], model)
            here = [(point.data.places[k], sign) for k, sign in ((i, 1.0), (j, -1.0)) if point.data.places[k] in keys]
            fixed = any(s.fixed for key, _ in here for s in written(CATALOGUE[name], uses[name], model, key).values())
            if here and not fixed:
                sought[name] = here[0]
        if not sought:
            continue
        z, C = _between(model, point, i, j).along(*(FAULT_PATTERNS[name] for name in sought))
        for k, (name, (key, sign)) in enumerate(sought.items()):
            ((q, old),) = written(CATALOGUE[name], uses[name], model, key).items()
            now = _now(name, old.value or 0.0) + sign * float(z[k])
            own = _parameter(name, now, float(np.sqrt(C[k, k])))
            found[f"{key}.{name}.{q}"] = own[q]
            numbered = {key: {q: replace(old, value=own[q].value)}}
            uses[name] = replace(uses[name], parameters={**_apart(uses[name], model), **numbered})
    return replace(model, effects=tuple(uses[use.name] for use in model.effects)), found


def _apart(use: EffectUse, model: Model) -> dict[str, dict[str, Setting]]:
    """What a use has at each of its places, by itself."""
    return {key: dict(written(CATALOGUE[use.name], use, model, key)) for key in at(CATALOGUE[use.name], use, model)}


def _damped(point: WorkingPoint, problem: Subproblem) -> Array:
    """(terms,) scaled steps to where both caps are damped, as all caps are: late by a sample they can seem to drive the
    shaft, at a maximum that ends at the line which no mode crosses, and no step leads away from there."""
    out = np.zeros(len(problem.gram.names))
    for i in problem.places:
        least = DAMPING_REL * np.sqrt(max(point.kL[i], 0.0) * point.data.mass[i])
        k = problem.gram.names.index(f"{point.data.places[i]}.c")
        out[k] = max(least - point.c[i], 0.0) / problem.gram.scales[k]
    return out


def _now(name: str, value: float) -> float:
    """The change of B that a number is."""
    return value if name == SKEW_EFFECT else float(np.log1p(value))


def _pairs(model: Model, point: WorkingPoint) -> list[tuple[int, int]]:
    """Both caps of a direction, where no force is measured, a shaft is between and both can be judged."""
    data = point.data
    if not data.shaft.any() or data.measured_force or point.kL.min() <= 0.0:
        return []
    opposite = [(i, data.opposite(i)) for i in range(len(data.places))]
    return [(i, j) for i, j in opposite if j is not None and i < j]


def _told(model: Model, point: WorkingPoint, i: int, j: int) -> list[str]:
    """Faults that the record can show, by what the motion of a cap makes of the force on the other; a gain where both
    caps' masses are known."""
    data = point.data
    w = 2 * np.pi * data.f_hz
    R = np.linalg.inv(point.A)
    a = np.einsum("bij,j,bij->bi", R, point.S, R.conj()).real  # one-sided PSD of the acceleration
    mutual = np.abs(data.shaft[:, i, j]) ** 2 * (a[:, j] / point.S[i] + a[:, i] / point.S[j]) / w**4
    per_bin = 2 * data.seconds * data.rate_hz / data.block
    known = all(model.cap_mass(data.places[k]) is not None for k in (i, j))
    sd = {GAIN_EFFECT: (per_bin * mutual.sum()) ** -0.5 if known else np.inf,
          SKEW_EFFECT: (per_bin * (w**2 * mutual).sum()) ** -0.5 * data.rate_hz}  # fmt: skip
    return [name for name in GAIN_AND_DELAY if sd[name] < MAX_SD_BY_EFFECT[name]]


def _between(model: Model, point: WorkingPoint, i: int, j: int) -> Between:
    """The likeliest changes of B, beside everything else of the model."""
    from scipy.fft import irfft, next_fast_len, rfft

    data, P = point.data, len(point.data.places)
    low, high = shaft_notch(model) or (0.0, 0.0)
    m, still = model.mass["disc"], 1j * np.pi * (high - low)
    k, c = (shaft_matrix(model.shaft, z)[2, 2] for z in (model.shaft_stiffness, model.shaft_damping))

    def both_ways(w: Array | Complexes) -> Complexes:
        """Of a disc damped to ring no longer than a block: the same along the axis and the line of the determinant."""
        own = k + 1j * w * c - w**2 * m
        between = between_caps(model.shaft, model.shaft_stiffness, model.shaft_damping, m, w)
        return np.asarray(between * own / (own + still * w * m))

    n = data.x.shape[1]
    size = next_fast_len(n, real=True)
    w: Array = 2 * np.pi * np.asarray(np.fft.rfftfreq(size, 1 / data.rate_hz), dtype=np.float64)
    whole, delayed = both_ways(w).astype(np.complex64), (-1j * w).astype(np.complex64)  # as precise as the motion

    def terms_of(row: int) -> list[Regressor]:
        """Of the size and of the delay of B in the force on the first cap, or the second, whose delay is an advance."""
        (here, there), sign = ((i, j), (j, i))[row], (1.0, -1.0)[row]
        pulled = rfft(data.x[there], size) * whole
        s = point.whitening.s
        out = []
        for k, series, own in (
            (row, irfft(pulled, size)[:n], both_ways(s / 1j)),
            (row + 2, sign * irfft(pulled * delayed, size)[:n], both_ways(s / 1j) * -sign * s),
        ):
            memory = np.zeros((P, data.bins.size), complex)
            memory[there] = own
            scale = 1.0 / max(float(np.std(series)), 1e-300)
            out.append(Regressor(str(k), "1", {here: series}, np.zeros((P, P, 2)), scale, {here: memory}))
        return out

    terms = [term for pair in zip(*map_threads(terms_of, range(2)), strict=True) for term in pair]
    problem = subproblem(point, (i, j), point.whitening.whiten(terms))
    begun = (problem.fit(steps=MAX_STEPS, start=start) for start in (None, _damped(point, problem)))
    fitted = max(begun, key=lambda fit: fit.log_likelihood)
    at_end = [fitted.names.index(str(k)) for k in range(4)]
    scale = fitted.scales[at_end]
    mean, C = fitted.delta[at_end] * scale, fitted.covariance[np.ix_(at_end, at_end)] * np.outer(scale, scale)
    grown = np.array([*(1.0 + mean[:2]), 1.0, 1.0])
    mean = np.array([*np.log(np.maximum(grown[:2], 1e-3)), *mean[2:]])
    information = np.asarray(np.linalg.inv(C / np.outer(grown, grown)), dtype=np.float64)
    return Between(i=i, j=j, mean=mean, information=information, rms=np.array([1.0 / t.scale for t in terms]))
