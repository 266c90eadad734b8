"""A record without the channels that its survey condemns, for the judgement of the bearings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.arrays import Array
from estimator.effects import found_by
from estimator.effects.engine.custom import effect_of
from estimator.errors import DataError
from estimator.likelihood.motion.prepare import check_shape
from estimator.model.rig import LINEAR_UNITS, MOTION_UNITS, EffectUse, Model
from estimator.results import Message, Parameter

from .clipping import clipping_level
from .findings import SPIKES_CODE, RecordSurvey
from .thresholds import RECORD_LIMITS


@dataclass(frozen=True, kw_only=True, slots=True)
class UsableRecord:
    """The usable part of a record for the judgement of the bearings.

    Parameters
    ----------
    model : Model
        The rig with the channels that are left, and without laws at places that no channel measures any more.
    y : (n, channels) float64
        Samples of these channels, SI.
    messages : tuple of Message
        The findings of the survey.
    parameters : mapping of str to Parameter
        Parameters that no fit has, by full name: levels of clipped channels that the model knows, and those of the
        places left out, not identifiable, with the reason.
    """

    model: Model
    y: Array
    messages: tuple[Message, ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)


def usable_record(model: Model, y: Array, survey: RecordSurvey) -> UsableRecord:
    """The record without its condemned channels.

    Parameters
    ----------
    model : Model
        The rig.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.
    survey : RecordSurvey
        What the record layer says of them.

    Raises
    ------
    DataError
        The samples are no record of this rig, or no place of a bearing is left. In that case the text is the first
        finding that condemns a channel.
    """
    y = check_shape(model, y)
    y = without_spikes(model, y, survey)
    messages = record_messages(survey)
    kept = [k for k, channel in enumerate(model.channels) if channel.name not in survey.unjudged]
    plain = tuple(u for u in model.effects if found_by(u.name) != "samples")  # a clipped channel is left out, no law
    parameters = _clipping_levels(model, y)
    if len(kept) == len(model.channels):
        return UsableRecord(model=replace(model, effects=plain), y=y, messages=messages, parameters=parameters)
    usable = replace(model, channels=tuple(model.channels[k] for k in kept))
    lost = [p for p in model.places if p not in usable.places]
    if not usable.places and lost:
        raise DataError(next(f.text for f in survey.findings if f.condemned))
    reasons = {place: _reason(survey, place) for place in lost}
    parameters |= {
        f"{place}.{name}": Parameter(None, None, unit, identifiable=False, reason=reasons[place])
        for place in lost
        for name, unit in LINEAR_UNITS.items()
        if name != "m"
    }
    effects = []
    for use in plain:
        here = {at: own for at, own in use.parameters.items() if _is_measured(at, usable)}
        for at in use.parameters.keys() - here.keys():
            place = next(p for p in lost if p.startswith(at))
            for q in effect_of(use).parameters:
                parameters[f"{at}.{use.name}.{q.name}"] = Parameter(
                    None, None, q.unit, identifiable=False, reason=reasons[place]
                )
        if here:
            effects.append(EffectUse(use.name, here, use.custom))
    return UsableRecord(
        model=replace(usable, effects=tuple(effects)), y=y[:, kept], messages=messages, parameters=parameters
    )


def without_spikes(model: Model, y: Array, survey: RecordSurvey) -> Array:
    """The record with NaN in place of its spikes; itself if it has none.

    Parameters
    ----------
    model : Model
        The rig.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.
    survey : RecordSurvey
        What is known of the channels of the record.
    """
    names = [channel.name for channel in model.channels]
    spikes = [(names.index(f.channels[0]), f.rows) for f in survey.findings if f.code == SPIKES_CODE]
    if not spikes:
        return y
    out = np.array(y)
    for k, rows in spikes:
        for first, stop in rows:
            out[first:stop, k] = np.nan
    return out


def _clipping_levels(model: Model, y: Array) -> dict[str, Parameter]:
    """Levels at which channels clip that the model calls clipped, by full name."""
    out = {}
    for use in (u for u in model.effects if found_by(u.name) == "samples"):
        for k, channel in enumerate(model.channels):
            if channel.kind in MOTION_UNITS and any(_covers(at, channel.place) for at in use.parameters):
                out[f"{channel.place}.{use.name}.level"] = level_parameter(clipping_level(y[:, k]), channel.kind)
    return out


def level_parameter(found: tuple[float, int] | None, kind: str) -> Parameter:
    """The level of a clipped channel as a parameter.

    Parameters
    ----------
    found : (float, int) or None
        Level, SI, and number of samples there; None for a channel that does not clip.
    kind : str
        Kind of the channel, such as "acceleration".
    """
    if found is None:
        return Parameter(None, None, MOTION_UNITS[kind], identifiable=False, reason="the channel does not clip")
    return Parameter(found[0], RECORD_LIMITS.level_sd_rel * found[0], MOTION_UNITS[kind])


def record_messages(survey: RecordSurvey) -> tuple[Message, ...]:
    """The findings of a survey as messages.

    Parameters
    ----------
    survey : RecordSurvey
        What is known of the channels of a record.
    """
    return tuple(Message(f.code, f.text, f.places[0] if len(f.places) == 1 else "") for f in survey.findings)


def _reason(survey: RecordSurvey, place: str) -> str:
    """Why a place is left out: the first finding that condemns a channel there."""
    return next(f.text for f in survey.findings if f.condemned and place in f.places)


def _is_measured(at: str, model: Model) -> bool:
    """Whether a location ("bearing1.x", or the node "bearing1") is measured; the shaft always is."""
    node = at.split(".")[0]
    if not node.startswith("bearing"):
        return True
    return any(_covers(at, p) for p in model.places)


def _covers(at: str, place: str) -> bool:
    """Whether a location, a place or its node, is that of a place."""
    return at in (place, place.split(".")[0])
