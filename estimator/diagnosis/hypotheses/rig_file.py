"""Mistakes in the rig file as hypotheses: a mass, the shaft's spring, two channels swapped, one inverted.

A wrong number or a wrong channel changes what the shaft is thought to carry from one bearing to the other. The residual
forces of the two bearings are then coherent. Each hypothesis changes the model, the model is fitted again, and the
coherence that is left says how much of the mistake it explains. On one bearing alone there is no such witness. A wrong
speed or rate is told by the machine layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Protocol

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc

from estimator.arrays import Array
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.errors import DataError, ModelError, NotFiniteError
from estimator.identification.batch.grid_start import fit_record
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import MOTION_UNITS, EffectUse, Model, Setting
from estimator.parallel import map_processes
from estimator.results import Parameter

TRIAL_ROWS = 2**17  # of the record, that a hypothesis is fitted to: 5 s at 25.6 kHz
COHERENCE_CELLS = 40  # of about equal width in log frequency
TRIAL_FACTORS = (0.1, 0.5, 2.0, 10.0)  # of a mass or a spring: slips of a unit, a factor of two, of a half
REFINING_STEPS = 6  # of the factor that explains most
MAX_FACTOR_SD_LOG = 0.2  # beyond which a factor is said to be rough
FACTOR_STEP_LOG = 0.2  # to either side of a factor, for its standard deviation
MIN_REFINED_NATS = 3.0  # gained by a factor between those of the grid
MAX_REFINED = 2  # hypotheses, the likeliest, whose factor is refined
REFINED_LOG_RANGE = 1.0  # to either side of the factor of the grid
UNSOUND_NATS = 1e12  # in place of the coherence of a fit that diverges
INVERTED_ERROR = -2.0  # relative error of the gain of an inverted channel

Values = tuple[float, ...]  # none, or a factor and the standard deviation of its logarithm


class Hypothesis(Protocol):
    """A named change of the model with a few numbers."""

    @property
    def name(self) -> str:
        """Key of what it changes, such as "rig.mass.bearing1"."""
        ...

    def propose(self, model: Model) -> Sequence[Values]:
        """Values to try; none where the hypothesis makes no sense for this rig."""
        ...

    def apply(self, model: Model, values: Values) -> Model:
        """The model with the change."""
        ...

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        """What the rig file would say, by key."""
        ...

    def text(self, values: Values) -> str:
        """What to check, one line."""
        ...


@dataclass(frozen=True, slots=True)
class ScaledMass:
    """The mass of the disc or of a cap is another one. key : of [rig.mass]."""

    key: str

    @property
    def name(self) -> str:
        return f"rig.mass.{self.key}"

    def propose(self, model: Model) -> Sequence[Values]:
        return [(factor, 1.0) for factor in TRIAL_FACTORS] if self.key in model.mass else []

    def apply(self, model: Model, values: Values) -> Model:
        return replace(model, mass={**model.mass, self.key: values[0] * model.mass[self.key]})

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        mass = values[0] * model.mass[self.key]
        return {self.name: Parameter.from_estimate(mass, values[1] * mass, "kg")}

    def text(self, values: Values) -> str:
        return _factor_text(self.name, values)


@dataclass(frozen=True, slots=True)
class ScaledSpring:
    """The shaft has another stiffness."""

    name: str = "rig.shaft_spring.stiffness"

    def propose(self, model: Model) -> Sequence[Values]:
        return [(factor, 1.0) for factor in TRIAL_FACTORS]

    def apply(self, model: Model, values: Values) -> Model:
        return replace(model, shaft_stiffness=values[0] * model.shaft_stiffness)

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        stiffness = values[0] * model.shaft_stiffness
        return {self.name: Parameter.from_estimate(stiffness, values[1] * stiffness, "N/m")}

    def text(self, values: Values) -> str:
        return _factor_text(self.name, values)


@dataclass(frozen=True, slots=True)
class SwappedChannels:
    """Two channels have each other's place. first, second : their numbers."""

    first: int
    second: int

    @property
    def name(self) -> str:
        return f"channel.{self.first}.{self.second}"

    def propose(self, model: Model) -> Sequence[Values]:
        return [()]

    def apply(self, model: Model, values: Values) -> Model:
        channels = list(model.channels)
        one, other = channels[self.first], channels[self.second]
        channels[self.first] = replace(one, node=other.node, direction=other.direction)
        channels[self.second] = replace(other, node=one.node, direction=one.direction)
        return replace(model, channels=tuple(channels))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        names = [model.channels[k].name for k in (self.first, self.second)]
        return {f"channel.{name}.swapped": Parameter(1.0, 0.0, "1") for name in names}

    def text(self, values: Values) -> str:
        return f"check the cables: channels {self.first + 1} and {self.second + 1} are swapped"


@dataclass(frozen=True, slots=True)
class InvertedChannel:
    """A channel has the other sign. number : of the channel."""

    number: int

    @property
    def name(self) -> str:
        return f"channel.{self.number}.sign"

    def propose(self, model: Model) -> Sequence[Values]:
        return [()]

    def apply(self, model: Model, values: Values) -> Model:
        place = model.channels[self.number].place
        turned = EffectUse(
            SENSOR_GAIN.name, {place: {SENSOR_GAIN.parameters[0].name: Setting(INVERTED_ERROR, fixed=True)}}
        )
        return replace(model, effects=(*(u for u in model.effects if u.name != turned.name), turned))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        return {f"channel.{model.channels[self.number].name}.sign": Parameter(-1.0, 0.0, "1")}

    def text(self, values: Values) -> str:
        return f"check the mounting: channel {self.number + 1} has the other sign"


def _factor_text(name: str, values: Values) -> str:
    """What to check of a number that a factor changes."""
    rough = " or so" if values[1] > MAX_FACTOR_SD_LOG else ""
    return f"check {name}: with {values[0]:.2g} times its value{rough} the bearings respond to each other as measured"


def coupling_hypotheses(model: Model) -> list[Hypothesis]:
    """The mistakes that the coupling of the bearings shows; none without two bearings on a shaft."""
    nodes = {place.split(".")[0] for place in model.places}
    if model.shaft == "none" or model.shaft_stiffness <= 0.0 or "disc" not in model.mass or len(nodes) < 2:
        return []
    moving = [k for k, c in enumerate(model.channels) if c.kind in MOTION_UNITS]
    alike = [
        (i, j) for i, j in combinations(moving, 2)
        if model.channels[i].kind == model.channels[j].kind and model.channels[i].place != model.channels[j].place
        and len(moving) > 2 and model.channels[i].direction != model.channels[j].direction
    ]  # fmt: skip
    first_bearing = [k for k in moving if model.channels[k].node == min(nodes)]
    return [
        *(ScaledMass(key) for key in model.mass), ScaledSpring(), *(SwappedChannels(i, j) for i, j in alike),
        *(InvertedChannel(k) for k in first_bearing),
    ]  # fmt: skip


def force_coherence(point: WorkingPoint) -> tuple[float, int]:
    """Nats by which residual forces of different places predict each other, and the number of parameters paid.

    The likelihood ratio of a free cross-spectrum in `COHERENCE_CELLS` cells, over all pairs of places.
    """
    data = point.data
    P = len(data.places)
    Z = [np.ascontiguousarray(point.spectra[i]).view(np.complex64) for i in range(P)]
    edges = np.unique(np.round(np.geomspace(8, Z[0].shape[1], COHERENCE_CELLS + 1)).astype(int))[:-1]
    starts = np.concatenate([[0], edges])
    width = np.diff(np.append(starts, Z[0].shape[1])) * data.blocks
    power = [np.add.reduceat(np.sum(np.abs(z) ** 2, axis=0, dtype=np.float64), starts) for z in Z]
    nats, paid = 0.0, 0
    for i, j in combinations(range(P), 2):
        cross = np.add.reduceat(np.sum(Z[i] * Z[j].conj(), axis=0, dtype=np.complex128), starts)
        share = np.minimum(np.abs(cross) ** 2 / np.maximum(power[i] * power[j], 1e-300), 1.0 - 1e-9)
        nats -= float(np.sum(width * np.log1p(-share)))
        paid += 2 * share.size
    return nats, paid


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistake:
    """A mistake in the rig file that explains the coherence of the residual forces.

    Parameters
    ----------
    hypothesis, values : Hypothesis, tuple of float
        What is changed, and to what.
    model : Model
        With the change.
    nats, left_nats : float
        Coherence of the residual forces without and with the change.
    """

    hypothesis: Hypothesis
    values: Values
    model: Model
    nats: float
    left_nats: float


def likeliest_mistake(model: Model, y: Array, rate_hz: float) -> Mistake | None:
    """The mistake that leaves least of the coherence; None where nothing is coherent, or all leave much.

    Parameters
    ----------
    model : Model
        As the rig file has it, without disturbances.
    y : (n, channels) float64
        Samples, SI.
    rate_hz : float
        Sampling rate, Hz.
    """
    asked = coupling_hypotheses(model)
    part = y[:TRIAL_ROWS]

    def coherence(changed: Model) -> float:
        try:
            nats, paid = force_coherence(fit_record(changed, prepare(changed, part, rate_hz)))
        except (DataError, ModelError, NotFiniteError, np.linalg.LinAlgError, FloatingPointError):
            return np.inf
        return nats - paid / 2 if np.isfinite(nats) else np.inf

    if not asked:
        return None
    nats, paid = force_coherence(fit_record(model, prepare(model, part, rate_hz)))
    if chdtrc(paid, 2 * nats) * len(asked) > THRESHOLDS.coherence_max_p_value:
        return None
    before = nats - paid / 2
    pairs = [(h, values) for h in asked for values in h.propose(model)]
    left = map_processes([partial(coherence, h.apply(model, values)) for h, values in pairs])
    tried: dict[str, tuple[float, Values, Hypothesis]] = {}
    for rest, (h, values) in sorted(zip(left, pairs, strict=True), key=lambda one: one[0]):
        tried.setdefault(h.name, (rest, values, h))

    def refined(rest: float, values: Values, h: Hypothesis) -> tuple[float, Values, Hypothesis]:
        """The hypothesis at its likeliest factor, with the standard deviation of the logarithm of the factor."""
        if not values or not np.isfinite(rest):
            return rest, values, h

        def at(u: float) -> float:
            return min(coherence(h.apply(model, (float(np.exp(u)), 0.0))), UNSOUND_NATS)

        middle = float(np.log(values[0]))
        found = minimize_scalar(
            at, bounds=(middle - REFINED_LOG_RANGE, middle + REFINED_LOG_RANGE), method="bounded",
            options={"maxiter": REFINING_STEPS},
        )  # fmt: skip
        if found.fun < rest - MIN_REFINED_NATS:
            middle, rest = float(found.x), float(found.fun)
        rise = 0.5 * (at(middle - FACTOR_STEP_LOG) + at(middle + FACTOR_STEP_LOG)) - rest
        sd = FACTOR_STEP_LOG / np.sqrt(2.0 * max(rise, 0.5 * FACTOR_STEP_LOG**2))
        return rest, (float(np.exp(middle)), float(sd)), h

    likeliest = [partial(refined, *one) for one in [*tried.values()][:MAX_REFINED]]
    rest, values, best = min(map_processes(likeliest), key=lambda one: one[0])
    if not rest <= THRESHOLDS.coherence_max_left_rel * before:
        return None
    return Mistake(hypothesis=best, values=values, model=best.apply(model, values), nats=before, left_nats=rest)
