"""What the recorder delays over the band otherwise than is known: a steep filter what is near its end, long before it
takes anything of it; one that is run to and fro, or has symmetric taps, nothing.

All channels late alike by psi(f) rad are nothing to a linear rotor. To a law of the true motion, P^-1 phi(P x) with
P = exp(i b psi), they are: its derivative by b, phi'(x) (i psi x) - i psi phi(x), is a force that a wrong phase leaves.
In the mean it answers nothing, as the two tangents are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.identification.residual import missing_force
from estimator.likelihood.motion.linear_memory import filtered_series
from estimator.likelihood.motion.located_law import law_along_record
from estimator.likelihood.path.subproblem import subproblem
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.likelihood.response.regressor_set import Regressor, orthogonalised
from estimator.model.recorder import LATE, POWERS, Filter, RollOff
from estimator.model.rig import Model
from estimator.parallel import map_threads

PHASE_STEP_RAD = 0.05  # rad at psi = 1, of the difference that the derivative is taken from
MAX_LAW_GAIN_REL = 2.0  # nats of regressors of the states over those of a phase: 4 and more where a law is missing
MAX_LEAD_REL = 1.5  # of the known lag, by which the lag may be less: no recorder is ahead of the motion
MAX_LAG_RAD = 5.0  # rad of a lag: an elliptic filter of order 12 whose edge is the end of the band has 4.5
LOOKS_S_SD = ((8.0, 2.5), (24.0, 5.0))  # s of the record; standard deviations that call for more of it, or suffice


def find_recorder_phase(model: Model, point: WorkingPoint) -> RollOff | None:
    """The model's filters with the phase that the record shows; None where it shows none but theirs, or where columns
    of the states explain more: harmonics of damping are a quarter of a turn beside those of a spring."""
    data, part = point.data, point
    if point.kL.min() <= 0.0:
        return None
    flat = Filter(data.rate_hz, data.band[1], nepers=(0.0,) * POWERS.size)
    known = {place: (model.roll_off or {}).get(place, flat) for place in data.places}
    behind = [float(own.lag(np.array([own.top_hz]))[0]) for own in known.values()]
    rad = nats = 0.0
    for seconds, sure in LOOKS_S_SD:
        part = point_on_part(point, seconds)
        seen = excess(part, lambda f: np.minimum(f / data.band[1], 1.0) ** LATE)
        if seen is None or abs(seen[0]) < sure * seen[1]:
            return None
        if not -MAX_LEAD_REL * min(behind) < seen[0] < MAX_LAG_RAD - max(behind):
            return None
        rad, nats = seen[0], 0.5 * (seen[0] / seen[1]) ** 2
    felt = sum(f.gain_nats for r in missing_force.survey(part, model).residuals for f in r.found)
    if felt > MAX_LAW_GAIN_REL * nats:
        return None
    return {place: replace(own, late=own.late + rad) for place, own in known.items()}


def excess(point: WorkingPoint, psi: Callable[[Array], Array]) -> tuple[float, float] | None:
    """b of exp(i b psi), psi of f (f,) Hz, by which the motion of all places is to be turned, and its standard
    deviation. None where no law of the model feels it."""
    data, places = point.data, tuple(range(len(point.data.places)))
    uses = [use for use in point.placed if use.effect.kind == "force"]

    @cache
    def ahead(bins: int, top: float) -> Any:
        """Factors of evenly spaced frequencies to `top` rad/s, single as the motion is."""
        return np.exp(1j * PHASE_STEP_RAD * psi(np.linspace(0.0, top, bins) / (2 * np.pi))).astype(np.complex64)

    def turned(z: Any, back: bool = False) -> Any:
        return filtered_series(lambda w: ahead(w.size, w[-1]).conj() if back else ahead(w.size, w[-1]), z, data.rate_hz)

    def left(i: int) -> Array:
        own = [use for use in uses if i in use.at]
        here, moved = (
            sum((law_along_record(use, at, i, point.lin)[0] for use in own), np.zeros(1)) for at in (data, there)
        )
        return np.asarray((turned(moved, back=True) - here) / PHASE_STEP_RAD)

    felt = [i for i in places if any(i in use.at for use in uses)]
    if not felt:
        return None
    there = data.states(lambda z: np.array(map_threads(turned, z)))
    series = dict(zip(felt, map_threads(left, felt), strict=True))
    rms = float(np.sqrt(np.mean([np.mean(z**2) for z in series.values()])))
    P = len(places)
    term = orthogonalised(Regressor("phase", "1", series, np.zeros((P, P, 2)), 1.0 / max(rms, 1e-300)), point.spans)
    if term is None:
        return None
    return subproblem(point, places, point.whitening.whiten([term])).fit(steps=6).value("phase")
