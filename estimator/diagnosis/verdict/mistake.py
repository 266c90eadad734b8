"""A mistake in the rig file as a verdict: the likeliest one, if the model without it explains the record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.survey import BearingSurvey, survey_bearing
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.hypotheses.rig_changes import is_common_slip
from estimator.diagnosis.hypotheses.rig_file import Mistake, MistakeTrial, likeliest_mistake
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import DataError
from estimator.identification.batch.full_fit import fit_all_effects, is_disturbance
from estimator.identification.finding import OTHER_BEARING
from estimator.identification.structure.thresholds import LIMITS as STRUCTURE_LIMITS
from estimator.model.rig import Model
from estimator.results import RIG_FILE, Message, Parameter

MISTAKES_UNTRIED = "mistakes_untried"  # code: the trial of mistakes was cut


def explaining_mistake(
    model: Model, y: Array, rate_hz: float, survey: BearingSurvey | None,
    max_work: float = STRUCTURE_LIMITS.max_work_derivatives,
) -> tuple[Entry | None, tuple[Message, ...]]:  # fmt: skip
    """The likeliest mistake in the rig file as a candidate, and what to check; None where none explains the record.

    A remark says where not all mistakes were tried. Beside a model that leaves nothing a factor is named only where it
    is a common slip and gains what ten modes cost: structural modes that are not quite right, or one that is not found,
    are explained as well by a factor of any size (by 29 and 83 nats in two complete rigs).

    Parameters
    ----------
    model : Model
        The rig, with all of its effects.
    y : (n, channels) float64
        Samples, SI.
    rate_hz : float
        Sampling rate, Hz.
    survey : BearingSurvey or None
        What the model leaves over; None where it cannot be fitted.
    max_work : float
        As of `likeliest_mistake`.
    """
    bare = replace(model, effects=tuple(use for use in model.effects if not is_disturbance(use)))
    before = after = 0.0 if survey is None else survey.interval[0]
    untried: tuple[Message, ...] = ()
    try:
        trial = likeliest_mistake(bare, y, rate_hz, max_work)
        mistake, untried = trial.mistake, _untried(trial)
        if mistake is None or (survey is not None and survey.explained and not is_sure(mistake)):
            return None, untried
        if survey is None or not survey.explained:
            corrected = mistake.hypothesis.apply(replace(model, background=None), mistake.values)
            whole = fit_all_effects(corrected, y, rate_hz)
            left = survey_bearing(whole.model, whole.point, y)[0]
            after = left.interval[0]
            if not _explains(survey, left, is_sure(mistake)):
                return None, untried
    except (DataError, np.linalg.LinAlgError):
        return None, untried
    text = "; or ".join([mistake.hypothesis.text(model, mistake.values), *mistake.rivals])
    parameters = dict(mistake.hypothesis.parameters(model, mistake.values))
    return mistake_entry(mistake.gain_nats, parameters, before, after), (Message(RIG_FILE, text), *untried)


def is_sure(mistake: Mistake) -> bool:
    """Whether a mistake is named beside a model that leaves nothing."""
    least = THRESHOLDS.rival_costs * STRUCTURE_LIMITS.min_gain_nats
    return not mistake.values or (is_common_slip(mistake.values) and mistake.gain_nats >= least)


def _untried(trial: MistakeTrial) -> tuple[Message, ...]:
    """The remark on a trial that was cut; none where all mistakes were tried."""
    if trial.tried == trial.asked:
        return ()
    text = (
        f"mistakes in the rig file: {trial.tried} of {trial.asked} were tried, as the spectra of the caps need many "
        "modes: check masses, shaft and cables yourself, or narrow the band"
    )
    return (Message(MISTAKES_UNTRIED, text),)


def mistake_entry(
    gain_nats: float, parameters: dict[str, Parameter], before_percent: float = 0.0, after_percent: float = 0.0
) -> Entry:
    """The candidate of a mistake. parameters : what the rig file would say, by key."""
    return Entry(
        effect=RIG_FILE, at=(), gain=gain_nats, heldout_gain=gain_nats, p_value=0.0, before_percent=before_percent,
        after_percent=after_percent, parameters=parameters, score=gain_nats,
    )  # fmt: skip


def _explains(survey: BearingSurvey | None, left: BearingSurvey, sure: bool) -> bool:
    """Whether the corrected rig leaves nothing, a fifth of the missing force, or none that the other bearing predicts.

    What is left is judged by its lower 95 % limit, as of a law. A mistake that leaves more has to be sure.
    Where the given rig cannot be fitted, a corrected one that can is named only if it is sure.
    """
    if survey is None:
        return sure
    if left.explained:
        return True
    coupled = [any(d.against == OTHER_BEARING for d in one.missing.disturbances) for one in (survey, left)]
    return left.interval[1] <= THRESHOLDS.max_left_rel * survey.interval[0] or sure and coupled == [True, False]
