"""The verdict on a record of which a sensor clips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.hypotheses.ranking import Entry, named_parameters
from estimator.effects.sensor.sensor_clipping import SENSOR_CLIPPING
from estimator.identification.record import CLIPPED_CODE, RecordSurvey, clipping_level, level_parameter, pileup_p_value
from estimator.model.rig import Model
from estimator.results import Message

from .bearing import BearingJudgement, is_of_surroundings


def with_clipped_channels(found: BearingJudgement, model: Model, y: Array, survey: RecordSurvey) -> BearingJudgement:
    """The judgement with the clipped channels that the model does not know, named where no law is.

    A clipped channel goes before a line and before the shape of a spectrum.

    Parameters
    ----------
    found : BearingJudgement
        Of the other channels.
    model : Model
        The rig with all channels.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.
    survey : RecordSurvey
        What the record layer says of them.
    """
    known = {at for use in model.effects if use.name == SENSOR_CLIPPING.name for at in use.parameters}
    texts = {f.channels[0]: f for f in survey.findings if f.code == CLIPPED_CODE}
    new = [
        (channel, clipping_level(y[:, k]))
        for k, channel in enumerate(model.channels)
        if channel.name in texts and not known.intersection((channel.place, channel.node))
    ]
    clipped = [(channel, level) for channel, level in new if level is not None]
    if not clipped:
        return found
    settings = {channel.place: {"level": level_parameter(level, channel.kind)} for channel, level in clipped}
    by_effect = {SENSOR_CLIPPING.name: settings}
    counts = [count for _, (_, count) in clipped]
    entry = Entry(
        effect=SENSOR_CLIPPING.name,
        at=tuple(dict.fromkeys(place.split(".")[0] for place in settings)),
        gain=float(sum(counts)),
        heldout_gain=float(sum(counts) - len(counts)),
        p_value=min(map(pileup_p_value, counts)),
        parameters=named_parameters(by_effect),
        score=np.inf,
        settings=by_effect,
        notes=tuple(Message(f.code, f.text, f.places[0]) for f in texts.values() if f.places[0] in settings),
    )
    if is_of_surroundings(found.verdict):
        return replace(found, verdict=entry.effect, ranking=(entry, *found.ranking), separates="")
    return replace(found, ranking=(found.ranking[0], entry, *found.ranking[1:]))
