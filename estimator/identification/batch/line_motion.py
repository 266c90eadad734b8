"""The narrow lines of a record: which are left out of a fit, and whether the bearings deflect at them.

A law acts on the deflection of its bearing. A periodic force deflects a bearing. Hum of a sensor does not, nor does
motion of the whole machine, and both are large in a displacement at a low frequency. The line itself does not show
which it is. A law does: it predicts more along the motion that its bearing has.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.identification.residual import missing_force
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.motion_record import MotionRecord, without_lines
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.model.rig import Model
from estimator.results import Message

from .thresholds import LIMITS


def with_judged_lines(model: Model, point: WorkingPoint) -> tuple[Model, WorkingPoint]:
    """The model and its fit along the motion by which laws predict more: with the lines of the record, or without.

    Parameters
    ----------
    model, point : Model, WorkingPoint
        The fitted model.

    Returns
    -------
    model, point
        The same where the lines are small or taken out already, or where laws do not predict more without them.
    """
    data = point.data
    if not data.lines or not data.deflects_at_lines or data.measured_force:
        return model, point
    part = point_on_part(point, missing_force.survey_seconds(data.rate_hz))
    bare = without_lines(part.data)
    if np.all(bare.rms[0] ** 2 > (1.0 - LIMITS.min_line_power_share) * np.var(part.data.x, axis=1)):
        return model, point
    without = fit_model(bare, list(part.placed), start=part)
    if predicted_nats(model, without) < predicted_nats(model, part) + LIMITS.min_line_nats:
        return model, point
    uses = list(point.placed)
    return replace(model, deflects_at_lines=False), fit_model(without_lines(data), uses, start=point)


def line_messages(model: Model, data: MotionRecord) -> tuple[Message, ...]:
    """Remarks on the lines in the band that a fit leaves out, and on lines at which the bearings do not deflect."""
    out = []
    low, high = data.band
    if inside := tuple(hz for line in data.lines if low < (hz := line.centre_hz) < high):
        text = f"spectral lines left out of the fit: {lines_in_words(inside, model.speed_rpm)}"
        out.append(Message("lines_left_out", f"{text}; their force is not in the missing force"))
    if not data.deflects_at_lines:
        listed = ", ".join(f"{line.centre_hz:.4g}" for line in data.lines[: LIMITS.max_lines_named])
        text = f"the bearings do not deflect at the lines of {listed} Hz (hum of a sensor, or the whole machine moves)"
        out.append(Message("lines_without_deflection", f"{text}: laws predict the force better without these lines"))
    return tuple(out)


def lines_in_words(lines_hz: tuple[float, ...], speed_rpm: float | None) -> str:
    """Frequencies of lines in words, the first `max_lines_named` of them, with the shaft order where there is one."""
    words = []
    for hz in lines_hz[: LIMITS.max_lines_named]:
        shaft = (speed_rpm or 0.0) / 60.0
        order = round(hz / shaft) if shaft else 0
        words.append(f"{hz:.0f} Hz ({order}X)" if order and abs(hz - order * shaft) < 0.01 * hz else f"{hz:.0f} Hz")
    more = f" and {len(lines_hz) - LIMITS.max_lines_named} more" if len(lines_hz) > LIMITS.max_lines_named else ""
    return ", ".join(words) + more


def predicted_nats(model: Model, point: WorkingPoint) -> float:
    """Nats that laws predict of the residual force of a linear model: those of the model, and what it lacks."""
    found = sum(group.gain_nats for own in missing_force.survey(point, model).residuals for group in own.found)
    if not point.placed:
        return found
    return found + point.fit.log_likelihood - fit_model(point.data, [], start=point).fit.log_likelihood
