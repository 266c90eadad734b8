"""Whether a law of the model varies a stiffness by more than the fit can follow."""

from __future__ import annotations

import numpy as np

from estimator.likelihood.motion.located_law import tangent_series
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.results import NOT_CONCLUSIVE, Message

from .thresholds import LIMITS


def strong_law_message(point: WorkingPoint) -> Message | None:
    """The message that the laws at a place vary its stiffness by more than the fit can follow; None if they do not.

    The fit follows the fluctuation of a tangent to the second order alone; beside a measured force it needs none.
    """
    data = point.data
    for i, place in enumerate(() if data.measured_force else data.places):
        own = [law for law in point.placed if i in law.at and law.effect.kind == "force"]
        tangent = np.sum([tangent_series(law, data, i, law.p)[0] for law in own], axis=0)
        varies_rel = float(np.std(tangent, dtype=np.float64) / abs(point.mean_tangent[i, i, 0]))
        if varies_rel > LIMITS.max_tangent_sd_rel:
            text = f"the laws of the model vary the stiffness of {place} by {100 * varies_rel:.0f} % (rms)"
            more = "more than the fit can follow: its values may be off by several standard deviations"
            advice = "nothing missing can be named beside them; record at a lower level of vibration"
            return Message(NOT_CONCLUSIVE, f"{text}, {more}, and {advice}", place)
    return None
