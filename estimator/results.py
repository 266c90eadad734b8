"""Results of every estimator: parameters, a fit, a rolling estimate, and one value shared by all places."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

NOT_JUDGED = "not_judged"  # code of the message of a record of which nothing can be judged
NOT_CONCLUSIVE = "inconclusive"  # code of the message that no missing force is found, but one could hide
RIG_FILE = "rig_file"  # verdict on a mistake in the rig file, and code of the message that says what to check
MAX_P_VALUE_DIFFERENT = 0.01  # places differ below this p-value


@dataclass(frozen=True, slots=True)
class Message:
    """A remark of an estimator for the user.

    Parameters
    ----------
    code : str
        Stable snake_case word. Programs compare codes, never texts.
    text : str
        One line for the user. Its wording may change.
    place : str
        Location such as ``"bearing1.x"`` or ``"bearing1"``; empty where the remark is about the whole record.
    """

    code: str
    text: str
    place: str = ""


def messages_json(messages: Sequence[Message]) -> dict[str, list[str]]:
    """`messages`, a list of texts, and `message_codes`, a list of codes in the same order."""
    return {"messages": [m.text for m in messages], "message_codes": [m.code for m in messages]}


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedValue:
    """One value of a law's parameter for several places: their mean, weighted by precision.

    Parameters
    ----------
    value : float
        Weighted mean, in `unit`.
    sd : float
        Standard deviation of `value`.
    unit : str
        SI unit.
    places : tuple of str
        Locations that the mean is of, such as ``"bearing1.x"``.
    p_equal : float
        p-value of the hypothesis that all places have this value (chi-square about the mean).
    """

    value: float
    sd: float
    unit: str
    places: tuple[str, ...]
    p_equal: float

    def to_json(self) -> dict[str, Any]:
        """An entry of `shared` in the JSON of a fit."""
        names = ("value", "sd", "unit", "p_equal")
        return {name: getattr(self, name) for name in names} | {"places": list(self.places)}

    def sentence(self, name: str) -> str:
        """One line for the user about the parameter `name`."""
        if self.p_equal < MAX_P_VALUE_DIFFERENT:
            return f"{name}: the {len(self.places)} places differ (p = {self.p_equal:.2g} that one value holds)"
        per_cent = f" ({100 * self.sd / abs(self.value):.2g} %)" if self.value else ""
        return (
            f"{name}: the {len(self.places)} places agree (p = {self.p_equal:.2g}); one value for all of them would be "
            f"{self.value:.4g} +- {self.sd:.2g} {self.unit}{per_cent}"
        )


def shared(parameters: Mapping[str, Parameter]) -> dict[str, SharedValue]:
    """Parameters of laws that several places have in common.

    The places are taken as independent. They nearly are: a force balance holds at one place, and the force of the disc
    follows from the measured motion.

    Parameters
    ----------
    parameters : mapping of str to Parameter
        Estimates by full name, such as ``"bearing1.x.cubic.kNL"``.

    Returns
    -------
    dict of str to SharedValue
        By ``"EFFECT.PARAMETER"``, where two places or more have an estimate and all of these are identifiable.

    Examples
    --------
    >>> from estimator.results import Parameter, shared
    >>> places = {"bearing1.x": 1.0e18, "bearing2.x": 1.1e18}
    >>> found = shared({f"{place}.cubic.kNL": Parameter(k, 1e17, "N/m^3") for place, k in places.items()})
    >>> print(found["cubic.kNL"].sentence("kNL"))
    kNL: the 2 places agree (p = 0.48); one value for all of them would be 1.05e+18 +- 7.1e+16 N/m^3 (6.7 %)
    """
    groups: dict[str, dict[str, Parameter]] = {}
    for name, p in parameters.items():
        parts = name.split(".")
        if len(parts) == 4:  # bearing, direction, effect, parameter
            groups.setdefault(".".join(parts[2:]), {})[".".join(parts[:2])] = p
    return {
        name: _mean(group)
        for name, group in groups.items()
        if len(group) > 1 and all(p.identifiable and p.value is not None and p.sd for p in group.values())
    }


def _mean(group: Mapping[str, Parameter]) -> SharedValue:
    """The estimates of one parameter by place as one value."""
    from scipy.special import chdtrc  # scipy takes longer to import than all of this file

    value = np.array([p.value for p in group.values()], float)
    weight = np.array([p.sd for p in group.values()], float) ** -2.0
    mean = float(weight @ value / weight.sum())
    chi2 = float(weight @ (value - mean) ** 2)
    unit = next(iter(group.values())).unit
    p_equal = float(chdtrc(len(value) - 1, chi2))
    return SharedValue(value=mean, sd=float(weight.sum() ** -0.5), unit=unit, places=tuple(group), p_equal=p_equal)


@dataclass(frozen=True, slots=True)
class Fit:
    """The result of fitting a model to a record.

    Parameters
    ----------
    parameters : mapping of str to Parameter
        By full name, such as ``"bearing1.x.kL"``, in SI units.
    log_likelihood : float or None
        Log-likelihood in nats at the maximum; None where the method has no likelihood.
    samples : int
        Rows of the record that the fit rests on.
    method : {"spectral", "fokker-planck", "score-matching"}
        Estimator that was used.
    messages : tuple of Message
        Remarks: assumptions that the data contradict, parts of the record that were left out.

    Examples
    --------
    >>> from estimator import Fit, Parameter
    >>> fit = Fit({"bearing1.x.kL": Parameter(1.0e7, 2.0e4, "N/m")}, None, 25600, "fokker-planck")
    >>> fit.to_json()["parameters"]["bearing1.x.kL"]
    {'value': 10000000.0, 'sd': 20000.0, 'unit': 'N/m', 'identifiable': True}
    """

    parameters: Mapping[str, Parameter]
    log_likelihood: float | None
    samples: int
    method: str
    _: KW_ONLY
    messages: tuple[Message, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The fit as schemas/fit.json has it, with one value for all places under `shared`."""
        return {
            "schema": 1,
            "parameters": {name: p.to_json() for name, p in self.parameters.items()},
            "shared": {name: value.to_json() for name, value in shared(self.parameters).items()},
            "log_likelihood": self.log_likelihood,
            "samples": self.samples,
            "method": self.method,
        } | messages_json(self.messages)


@dataclass(frozen=True, slots=True)
class Parameter:
    """An estimate of one number of a model.

    Parameters
    ----------
    value : float or None
        Estimate, in `unit`. Where the number is not identifiable: None, or the value that the other parameters were
        fitted with, which is not shown.
    sd : float or None
        Standard deviation of `value`; 0 for a number that was given; None where it is unknown.
    unit : str
        SI unit; ``"1"`` for a number without one.
    identifiable : bool
        Whether the data determine the value.
    reason : str
        Why the number is not identifiable, or ``"given"``; empty where there is nothing to say.

    Examples
    --------
    >>> from estimator import Parameter
    >>> Parameter.from_estimate(60.0, 1.5, "N s/m")
    Parameter(value=60.0, sd=1.5, unit='N s/m', identifiable=True, reason='')
    >>> Parameter.from_estimate(60.0, 45.0, "N s/m").reason
    'relative standard deviation over 50 %'
    """

    value: float | None
    sd: float | None
    unit: str
    identifiable: bool = True
    _: KW_ONLY
    reason: str = ""

    @classmethod
    def from_estimate(cls, value: float, sd: float, unit: str, limit: float = 0.5) -> Parameter:
        """The parameter of an estimate; not identifiable where the standard deviation is too large.

        Parameters
        ----------
        value, sd : float
            Estimate and its standard deviation, in `unit`.
        unit : str
            SI unit.
        limit : float
            Largest relative standard deviation of an identifiable parameter.
        """
        if np.isfinite(value) and np.isfinite(sd) and sd <= limit * abs(value):
            return cls(float(value), float(sd), unit)
        return cls(None, None, unit, False, reason=f"relative standard deviation over {100 * limit:.0f} %")

    def to_json(self) -> dict[str, Any]:
        """The parameter as the JSON results have it: `reason` only where there is one."""
        value, sd = (self.value, self.sd) if self.identifiable else (None, None)
        out: dict[str, Any] = {"value": value, "sd": sd, "unit": self.unit, "identifiable": self.identifiable}
        return out | ({"reason": self.reason} if self.reason else {})


def with_unidentifiable_at(
    places: Collection[str], reason: str, numbers: Mapping[str, Parameter], unit: str = ""
) -> dict[str, Parameter]:
    """Parameters by full name, those at some places replaced by "not identifiable".

    places : locations such as "bearing1.x". unit : only parameters whose unit begins with this are replaced, such as
    "N" where the mass of a bearing cap is unknown.
    """
    return {
        name: Parameter(None, None, q.unit, identifiable=False, reason=reason)
        if q.unit.startswith(unit) and any(is_of_place(name, place) for place in places)
        else q
        for name, q in numbers.items()
    }


def is_of_place(name: str, place: str) -> bool:
    """Whether a full name belongs to a location ("bearing1.x"), or to a law at the node of the location."""
    node, direction = name.split(".")[:2]
    return place == f"{node}.{direction}" if direction in ("x", "y") else place.split(".")[0] == node


@dataclass(frozen=True, slots=True)
class Estimate:
    """The estimate of a rolling estimator at one instant.

    Parameters
    ----------
    index : int
        Absolute sample index of the last row that the estimate uses.
    parameters : mapping of str to Parameter
        By full name, such as ``"bearing1.x.kL"``, in SI units; empty where nothing is shown.
    samples : float
        Effective number of rows that the estimate rests on.
    log_likelihood : float or None
        Log-likelihood in nats; None where the estimator has none.
    status : str
        ``"ok"``, how far the warm-up is, or why nothing is shown.
    extra : mapping of str to float, or None
        Further numbers by name, such as ``missing_force_percent``; None where there are none.
    """

    index: int
    parameters: Mapping[str, Parameter]
    samples: float
    log_likelihood: float | None = None
    _: KW_ONLY
    status: str = "ok"
    extra: Mapping[str, float] | None = None


# Key of `Estimate.extra`, per cent of the bearing force: of all candidates together; with "_EFFECT" behind it, of one
# candidate that is certainly missing.
MISSING_FORCE_KEY = "missing_force_percent"
WARM_UP_S_KEY, WARM_UP_NEEDED_S_KEY = "warm_up_s", "warm_up_needed_s"  # keys of `Estimate.extra`, before the first fit
BACKGROUND_KEY = "background_found_s"  # key of `Estimate.extra`: structural modes and spectrum of the force are in it
SPIKES_KEY = "spikes_left_out"  # key of `Estimate.extra`: single samples far outside all others, since the start


def certain_missing_effects(extra: Mapping[str, float]) -> list[str]:
    """The candidate effects that an estimate is certain to be missing, strongest first. extra : of an `Estimate`."""
    names = [n for n in extra if n.startswith(MISSING_FORCE_KEY + "_")]
    return [n.removeprefix(MISSING_FORCE_KEY + "_") for n in sorted(names, key=lambda n: -extra[n])]


class OnlineEstimator(Protocol):
    """Interface of every rolling estimator.

    It is constructed as ``cls(model, rate_hz, time_constant_s)`` and fed consecutive blocks of one size. It is
    deterministic: live and replay agree bit for bit. It never raises on data.
    """

    def update(self, block: NDArray[np.float64]) -> None:
        """Take the next rows.

        Parameters
        ----------
        block : (n, channels) float64
            Samples in SI units, channels in the model's order; NaN where a sample is missing or clipped.
        """
        ...

    def snapshot(self) -> Estimate:
        """The estimate as of the last `update`, without side effect."""
        ...
