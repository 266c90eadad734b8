"""The gates that a candidate passes before it is named: one function and one threshold each.

No gate knows an effect by name. A gate that does not concern a candidate lets it pass. They are asked in order, the
cheap ones first, and the first that refuses ends the questions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.arrays import Array
from estimator.diagnosis.comparison.heldout import heldout_gain_nats
from estimator.diagnosis.comparison.survey import BearingSurvey
from estimator.diagnosis.hypotheses import gate_amplitude, ranking
from estimator.diagnosis.hypotheses.ranking import Entry, GateResult
from estimator.diagnosis.hypotheses.screen import Progress
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.errors import NotFiniteError
from estimator.identification.residual.missing_force import negligible_force_share
from estimator.identification.structure.thresholds import LIMITS as STRUCTURE_LIMITS
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model

from .joint_fit import JointFit, joint_fit

INSIDE_LIMITS = "inside limits"  # name of the gate
LEAVES_LITTLE = "leaves little"  # name of the gate


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """The data that the gates read.

    Parameters
    ----------
    model, point : Model, WorkingPoint
        The model as it is, fitted to the record.
    y : (n, channels) float64
        Samples, SI.
    survey : BearingSurvey
        What the model leaves over.
    say : callable
        Progress.
    fits : dict of str to JointFit
        Candidates that were fitted together with the model, by effect.
    """

    model: Model
    point: WorkingPoint
    y: Array
    survey: BearingSurvey
    say: Progress
    fits: dict[str, JointFit] = field(default_factory=dict)

    def fitted(self, entry: Entry) -> JointFit:
        """The candidate fitted together with the model."""
        if entry.effect not in self.fits:
            self.say(0.85, f"does {entry.effect} explain it?")
            self.fits[entry.effect] = joint_fit(self.model, self.point, self.y, self.survey, entry)
        return self.fits[entry.effect]

    def gain_together(self, one: Entry, other: Entry) -> float:
        """Held-out nats that two laws, fitted together with the model, gain over the model; -inf without a fit."""
        part = self.survey.part
        laws = [*part.placed, *one.placed, *other.placed]
        try:
            return heldout_gain_nats(part, fit_model(part.data, laws, start=part, rounds=THRESHOLDS.law_fit_rounds))
        except NotFiniteError:
            return -np.inf


Gate = Callable[[Entry, Context], GateResult]


def significant(entry: Entry, context: Context) -> GateResult:
    """The p-value pays for everything that was tried."""
    p, most = entry.p_value, THRESHOLDS.max_p_value
    return GateResult(gate="significant", passed=p <= most, measured=p, limit=most, text="p-value")


def large_enough(entry: Entry, context: Context) -> GateResult:
    """The force is larger than the errors of a simulation or a filter, and than those of structural modes if any.

    Beside lines that shaft and mains explain a tone has to be larger, within its uncertainty: a record holds tones of
    its surroundings. So has a law that alone shows its force: it may be an error of the modes.
    """
    least, force = 100 * negligible_force_share(context.point.data), entry.explained_percent
    if context.survey.law is not None:
        least = max(least, THRESHOLDS.min_hidden_law_percent)
    if entry.effect in PERIODIC_EFFECTS and any(band.has_cause for band in context.model.record_lines or ()):
        least, force = max(least, THRESHOLDS.min_tone_percent), entry.explained_limits_percent[1]
    text = "force, % of the bearing force"
    return GateResult(gate="large enough", passed=force >= least, measured=force, limit=least, text=text)


def inside_limits(entry: Entry, context: Context) -> GateResult:
    """No tone outside the band, no mode above half the rate, and no gap wider than the motion."""
    data = context.point.data
    hz = [p.value for p in entry.parameters.values() if p.unit == "Hz" and p.value is not None]
    for tone_hz in hz if entry.effect in PERIODIC_EFFECTS else ():
        edge_hz = float(np.clip(tone_hz, *data.band))
        if tone_hz != edge_hz:
            text = "frequency outside the band"
            return GateResult(gate=INSIDE_LIMITS, passed=False, measured=tone_hz, limit=edge_hz, text=text)
    most = THRESHOLDS.max_frequency_over_rate
    highest = max(hz, default=0.0) / data.rate_hz
    if highest > most:
        text = "frequency over the rate"
        return GateResult(gate=INSIDE_LIMITS, passed=False, measured=highest, limit=most, text=text)
    gaps = [
        law.p[k] / np.sqrt(np.sum(np.max(np.abs(data.x[list(law.at)]), axis=1) ** 2))
        for law in entry.placed for k, q in enumerate(law.effect.parameters)
        if not q.linear and q.scale == "x" and q.low >= 0.0
    ]  # fmt: skip
    if not gaps:
        return GateResult(gate=INSIDE_LIMITS, passed=True)
    widest, most = float(min(gaps)), THRESHOLDS.max_gap_over_motion
    text = "gap over the largest motion"
    return GateResult(gate=INSIDE_LIMITS, passed=widest <= most, measured=widest, limit=most, text=text)


def gains_in_folds(entry: Entry, context: Context) -> GateResult:
    """The candidate predicts in all but one of the held-out time folds."""
    if not entry.folds:
        return GateResult(gate="gains in folds", passed=True)
    gained, least = sum(g > 0.0 for g in entry.folds), len(entry.folds) - THRESHOLDS.max_lost_folds
    return GateResult(
        gate="gains in folds", passed=gained >= least, measured=gained, limit=least, text="held-out folds gained"
    )


def holds_at_large_amplitudes(entry: Entry, context: Context) -> GateResult:
    """A law of displacement fitted to the smaller motion predicts the largest."""
    concerned = gate_amplitude.is_displacement_law(entry.law)
    test = gate_amplitude.extrapolated(context.survey.part, entry.placed) if concerned else None
    gate = ranking.LARGE_AMPLITUDES
    if test is None:
        return GateResult(gate=gate, passed=True)
    return GateResult(gate=gate, passed=not test.refused, measured=test.gain, limit=-test.allowed, text="nats gained")


def told_from_zero(entry: Entry, context: Context) -> GateResult:
    """Fitted together with the model, the candidate predicts held-out data: it is not zero.

    It has to predict as much as separates two candidates where the record gives none of its numbers, or where it is
    not fitted together with the model. Beside structural modes a law has to gain what one more mode would have to.
    """
    fit = context.fitted(entry)
    gain, values = fit.gain_nats, fit.entry.parameters.values()
    vague = gain is None or bool(values) and not any(value.identifiable for value in values)
    least = THRESHOLDS.rival_nats if vague else THRESHOLDS.min_gain_nats
    if entry.placed and context.point.data.background is not None:
        least = STRUCTURE_LIMITS.min_gain_nats
    text = "held-out nats" if gain is None else "held-out nats, fitted with the model,"
    gain = entry.heldout_gain if gain is None else gain
    return GateResult(gate="told from zero", passed=gain >= least, measured=gain, limit=least, text=text)


def leaves_little(entry: Entry, context: Context) -> GateResult:
    """The candidate leaves at most a fifth of what it was to explain, within the uncertainty of what is left."""
    fit, most = context.fitted(entry), THRESHOLDS.max_left_rel
    left = fit.left_rel
    if left is None:
        return GateResult(gate=LEAVES_LITTLE, passed=True)
    least = left if fit.least_left_rel is None else fit.least_left_rel
    limit = f" (lower 95 % limit {least:.2f})" if least < most < left else ""
    text = f"share left of what it was to explain{limit}"
    return GateResult(gate=LEAVES_LITTLE, passed=least <= most, measured=left, limit=most, text=text)


NAMING_GATES: tuple[Gate, ...] = (
    significant, large_enough, inside_limits, gains_in_folds, holds_at_large_amplitudes, told_from_zero, leaves_little,
)  # fmt: skip


def judged(entry: Entry, context: Context) -> Entry:
    """The candidate with what the gates say, and with the numbers of its joint fit if the joint fit was asked for."""
    said: list[GateResult] = []
    for gate in NAMING_GATES:
        said.append(gate(entry, context))
        if not said[-1].passed:
            break
    known = context.fits.get(entry.effect)
    return replace(entry if known is None else known.entry, gates=tuple(said))
