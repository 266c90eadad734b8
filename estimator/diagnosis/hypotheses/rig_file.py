"""Mistakes in the rig file as hypotheses: a mass, the shaft's spring, two channels swapped, one inverted.

A wrong number or a wrong channel changes what the shaft is thought to carry from one bearing to the other, and with it
the cross spectra of the caps. Each hypothesis changes the rig. The spectra of the caps are explained by the rig as it
is given and by each changed one, each with the structural modes and the spectrum of the force that it needs. The
likelihood, less what the modes cost, says which rig is likelier. On one bearing alone there is no such witness. A wrong
speed or rate is told by the machine layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Protocol

import numpy as np
from scipy.optimize import minimize_scalar

from estimator.arrays import Array
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.errors import ModelError
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.batch.unknown_mass import places_without_mass
from estimator.identification.structure.cross_spectra import SearchTooLongError
from estimator.identification.structure.rig_spectra import Arrangement, RigFit, RigSpectra
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import MOTION_UNITS, EffectUse, Model, Setting
from estimator.results import Parameter

TRIAL_ROWS = 2**19  # of the record, for the spectra: 20 s at 25.6 kHz
TRIAL_FACTORS = (0.1, 0.5, 2.0, 10.0)  # of a mass or a spring: slips of a unit, a factor of two, of a half
REFINING_STEPS = 8  # of the factor that explains most
MAX_FACTOR_SD_LOG = 0.2  # beyond which a factor is said to be rough
FACTOR_STEP_LOG = 0.1  # to either side of a factor, for its standard deviation
MIN_FACTOR_LOG = 0.1  # of a factor from one: instruments have +-10 % (ISO 2954)
MIN_FALL_NATS = 1e-4  # of a likelihood that does not depend on the factor
MIN_FACTOR_SD = 3.0  # of its logarithm, of a factor from one
REFINED_LOG_RANGE = 1.0  # to either side of the factor of the grid
MIN_SCREENED_NATS = 5.0  # gained before the modes of a hypothesis are sought: half of what it has to gain
RIVAL_COSTS = 10.0  # costs of a mode behind one that explains the spectra, before its own modes are sought
MAX_SEARCHED = 3  # hypotheses, the likeliest with the modes of the given rig, whose own modes are sought
UNSOUND_NATS = -1e12  # in place of the likelihood of a rig that explains nothing
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

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        """Where the channels are with the change. places : of the channels as given."""
        return channels

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        """What the rig file would say, by key."""
        ...

    def text(self, model: Model, values: Values) -> str:
        """What to check, one line."""
        ...


@dataclass(frozen=True, slots=True)
class ScaledMass(Hypothesis):
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

    def text(self, model: Model, values: Values) -> str:
        return _factor_text(self.name, values)


@dataclass(frozen=True, slots=True)
class ScaledSpring(Hypothesis):
    """The shaft has another stiffness."""

    name: str = "rig.shaft_spring.stiffness"

    def propose(self, model: Model) -> Sequence[Values]:
        return [(factor, 1.0) for factor in TRIAL_FACTORS]

    def apply(self, model: Model, values: Values) -> Model:
        return replace(model, shaft_stiffness=values[0] * model.shaft_stiffness)

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        stiffness = values[0] * model.shaft_stiffness
        return {self.name: Parameter.from_estimate(stiffness, values[1] * stiffness, "N/m")}

    def text(self, model: Model, values: Values) -> str:
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

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        order = list(channels.channel_of)
        one, other = (places.index(model.channels[k].place) for k in (self.first, self.second))
        order[one], order[other] = order[other], order[one]
        return replace(channels, channel_of=tuple(order))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        names = [model.channels[k].name for k in (self.first, self.second)]
        return {f"channel.{name}.swapped": Parameter(1.0, 0.0, "1") for name in names}

    def text(self, model: Model, values: Values) -> str:
        one, other = (model.channels[k].name for k in (self.first, self.second))
        return f"check the cables: {one} and {other} are swapped"


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

    def arrange(self, model: Model, channels: Arrangement, places: tuple[str, ...]) -> Arrangement:
        own = places.index(model.channels[self.number].place)
        return replace(channels, sign=tuple(-s if i == own else s for i, s in enumerate(channels.sign)))

    def parameters(self, model: Model, values: Values) -> Mapping[str, Parameter]:
        return {f"channel.{model.channels[self.number].name}.sign": Parameter(-1.0, 0.0, "1")}

    def text(self, model: Model, values: Values) -> str:
        return f"check the mounting: the sign of {model.channels[self.number].name} is inverted"


def _factor_text(name: str, values: Values) -> str:
    """What to check of a number that a factor changes."""
    rough = " or so" if values[1] > MAX_FACTOR_SD_LOG else ""
    return f"check {name}: with {values[0]:.2g} times its value{rough} the model explains the spectra of the caps"


def coupling_hypotheses(model: Model) -> list[Hypothesis]:
    """The mistakes that the coupling of the bearings shows; none without two bearings on a shaft."""
    nodes = {place.split(".")[0] for place in model.places}
    if places_without_mass(model) or any("." in key for key in model.mass):  # the shaft has to give masses: no witness
        return []
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistake:
    """A mistake in the rig file that makes the spectra of the caps likelier.

    Parameters
    ----------
    hypothesis, values : Hypothesis, tuple of float
        What is changed, and to what.
    gain_nats : float
        Log-likelihood gained by the change, less what structural modes cost.
    rivals : tuple of str
        What to check of other mistakes that the record does not tell from it.
    """

    hypothesis: Hypothesis
    values: Values
    gain_nats: float
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Trial:
    """A hypothesis with values, and the spectra explained by the changed rig."""

    hypothesis: Hypothesis
    values: Values
    fit: RigFit


class _Trials:
    """Hypotheses on the rig file of a record, on trial by the spectra of the caps. model, point : without a change."""

    def __init__(self, model: Model, point: WorkingPoint) -> None:
        self.model, self.spectra = model, RigSpectra(model, point)

    def screened(self, asked: Sequence[Hypothesis], start: RigFit | None) -> list[_Trial]:
        """The likeliest hypotheses with the modes of another fit, or without modes, each with its likeliest value."""
        tried = [self.tried(h, values, start) for h in asked for values in h.propose(self.model)]
        by_name: dict[str, _Trial] = {}
        for trial in sorted((t for t in tried if t is not None), key=lambda t: -t.fit.nats):
            by_name.setdefault(trial.hypothesis.name, trial)
        return [*by_name.values()][:MAX_SEARCHED]

    def tried(self, hypothesis: Hypothesis, values: Values, start: RigFit | None) -> _Trial | None:
        """The hypothesis with the modes of another fit, or without; None where the changed rig explains nothing."""
        try:
            fit = self.spectra.tried(*self._changed(hypothesis, values), start)
        except (np.linalg.LinAlgError, ModelError):
            return None
        return _Trial(hypothesis=hypothesis, values=values, fit=fit)

    def pruned(self, trial: _Trial) -> _Trial:
        """The hypothesis without the modes that it does not need."""
        return replace(trial, fit=self.spectra.without_idle_modes(trial.fit))

    def searched_in_turn(self, trials: Sequence[_Trial]) -> list[_Trial]:
        """Hypotheses with modes of their own, the likeliest first; once one explains the spectra, its rivals only.

        Those that are reached with the work that the trial may take.
        """
        found: list[_Trial] = []
        reach = RIVAL_COSTS * self.spectra.cost_nats
        with suppress(SearchTooLongError):
            for trial in trials:
                if not found or not found[0].fit.explains or trial.fit.nats > found[0].fit.nats - reach:
                    found = sorted([*found, self.searched(trial)], key=lambda t: -t.fit.nats)
        return found

    def searched(self, trial: _Trial) -> _Trial:
        """The hypothesis with modes of its own and its likeliest factor."""
        fits = [trial.fit]
        for start in (None, trial.fit):
            with suppress(np.linalg.LinAlgError):
                fits.append(self.spectra.searched(*self._changed(trial.hypothesis, trial.values), start))
        return self._refined(replace(trial, fit=max(fits, key=lambda fit: fit.nats)))

    def _changed(self, hypothesis: Hypothesis, values: Values) -> tuple[Model, Arrangement]:
        """The model whose masses and shaft are changed, and where the channels are."""
        arranged = hypothesis.arrange(self.model, self.spectra.as_given, self.spectra.places)
        if arranged != self.spectra.as_given:
            return self.model, arranged
        return hypothesis.apply(self.model, values), arranged

    def _refined(self, trial: _Trial) -> _Trial:
        """The hypothesis at its likeliest factor, with the standard deviation of the logarithm of the factor."""
        if not trial.values:
            return trial

        def at(ln_factor: float) -> float:
            found = self.tried(trial.hypothesis, (float(np.exp(ln_factor)), 0.0), trial.fit)
            return UNSOUND_NATS if found is None else found.fit.nats

        middle = float(np.log(trial.values[0]))
        best = minimize_scalar(
            lambda u: -at(u), bounds=(middle - REFINED_LOG_RANGE, middle + REFINED_LOG_RANGE), method="bounded",
            options={"maxiter": REFINING_STEPS},
        )  # fmt: skip
        ln_factor = float(best.x) if -best.fun > trial.fit.nats else middle
        fall = at(ln_factor) - 0.5 * (at(ln_factor - FACTOR_STEP_LOG) + at(ln_factor + FACTOR_STEP_LOG))
        sd = FACTOR_STEP_LOG / np.sqrt(2.0 * max(fall, MIN_FALL_NATS))
        values = float(np.exp(ln_factor)), float(sd)
        found = self.tried(trial.hypothesis, values, trial.fit)
        if found is not None and found.fit.nats > trial.fit.nats:
            return found
        return replace(trial, values=(trial.values[0], float(sd)))


def likeliest_mistake(model: Model, y: Array, rate_hz: float) -> Mistake | None:
    """The mistake with which the rig explains the spectra of the caps best; None where the rig as given does as well.

    None either where the trial would take more work than it may.

    Parameters
    ----------
    model : Model
        As the rig file has it, without disturbances, with the background that was found.
    y : (n, channels) float64
        Samples, SI.
    rate_hz : float
        Sampling rate, Hz.

    Raises
    ------
    DataError
        The record is too short.
    """
    asked = coupling_hypotheses(model)
    if not asked:
        return None
    model, background = replace(model, background=None), model.background
    trials = _Trials(model, fit_record(model, prepare(model, y[:TRIAL_ROWS], rate_hz)))
    try:
        return _likeliest(trials, asked, trials.spectra.as_fitted(model, background))
    except (np.linalg.LinAlgError, SearchTooLongError):
        return None


def _likeliest(trials: _Trials, asked: Sequence[Hypothesis], given: RigFit) -> Mistake | None:
    """The mistake that explains the spectra best; None for none. given : the fit of the rig as given."""
    model, spectra = trials.model, trials.spectra
    spectra.begin_again()
    near = [trials.pruned(t) for t in trials.screened(asked, given)]
    near = [t for t in near if t.fit.nats > given.nats + MIN_SCREENED_NATS]
    if not given.explains:
        plain = spectra.tried(model, spectra.as_given, None)
        near += [t for t in trials.screened(asked, None) if t.fit.nats > plain.nats + MIN_SCREENED_NATS]
    found = trials.searched_in_turn(near)
    if not found or not (found[0].fit.explains or _explains_coherence(given, found[0].fit)):
        return None
    best = found[0]
    spectra.begin_again()  # the rig as given has the modes of the best one on trial too
    with suppress(np.linalg.LinAlgError):
        again = spectra.without_idle_modes(spectra.searched(model, spectra.as_given, best.fit))
        given = max(given, again, key=lambda fit: fit.nats)
    least = THRESHOLDS.rival_nats * best.fit.dispersion * spectra.dispersion
    gain = best.fit.nats - given.nats
    if gain < least or not _is_slip(best.values):
        return None
    rivals = {
        t.hypothesis.name: t.hypothesis.text(model, t.values)
        for t in found[1:] if t.hypothesis.name != best.hypothesis.name and t.fit.nats > best.fit.nats - least
    }  # fmt: skip
    return Mistake(
        hypothesis=best.hypothesis, values=best.values, gain_nats=gain, rivals=tuple(rivals.values())
    )  # fmt: skip


def _explains_coherence(given: RigFit, changed: RigFit) -> bool:
    """Whether the caps predict each other with the rig as given, and little with the changed one."""
    if given.coherence_p_value > THRESHOLDS.coherence_max_p_value:
        return False
    return changed.coherence_nats <= THRESHOLDS.coherence_max_left_rel * given.coherence_nats


def _is_slip(values: Values) -> bool:
    """Whether a factor differs from one by more than instruments and its standard deviation allow, and is a slip."""
    if not values:
        return True
    size = abs(float(np.log(values[0])))
    least, most = max(MIN_FACTOR_LOG, MIN_FACTOR_SD * values[1]), float(np.log(max(TRIAL_FACTORS))) + MIN_FACTOR_LOG
    return least < size < most
