"""Parameters by the spectral path likelihood, the default method of a fit: the full fit, with its messages."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.identification.residual.measured_path import force_noise_ratio
from estimator.identification.residual.strong_law import strong_law_message
from estimator.identification.structure.spectral_models import mean_power
from estimator.likelihood.fitting.gauss_newton import last_step_sd
from estimator.likelihood.motion.prepare import RECORD_LONG_CODE, check_record
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import LINEAR_UNITS, Model
from estimator.results import Fit, Message, Parameter

from .full_fit import FullFit, fit_all_effects
from .long_record import fit_of_all_parts
from .thresholds import LIMITS


def fit_spectral(model: Model, y: Array, rate_hz: float) -> Fit:
    """Parameters of a rig from a record, by the spectral path likelihood.

    Parameters
    ----------
    model : Model
        The rig. Values that are None are fitted.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``. NaN where a sample is missing or clipped.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    Fit
        Parameters by full name, each with its standard deviation, and messages for the user.

    Raises
    ------
    DataError
        The record cannot answer: too short, a dead channel, no resonance in the band.
    """
    found = fit_all_effects(model, check_record(model, y, rate_hz), rate_hz)
    messages = (*found.messages, *_fit_messages(found))
    noisy = force_noise_ratio(found.model, found.point)
    messages += tuple(_force_noise_message(place, ratio) for place, ratio in noisy.items())
    estimates, samples = fit_of_all_parts(found, y, rate_hz)
    if samples > found.point.data.blocks * found.point.data.block:
        messages = tuple(m for m in messages if m.code != RECORD_LONG_CODE)
    parameters = found.with_estimates(estimates)
    for name, c in [(f"{place}.c", parameters[f"{place}.c"]) for place in noisy]:
        if c.value is not None and c.sd is not None:
            wide = float(np.hypot(c.sd, noisy[name.removesuffix(".c")] * c.value))
            parameters[name] = Parameter.from_estimate(c.value, wide, c.unit)
    parameters = _given_masses(found.model) | parameters
    return Fit(parameters, found.point.fit.log_likelihood, samples, "spectral", messages=messages)


def _force_noise_message(place: str, ratio: float) -> Message:
    """The message that noise of a force channel biases the damping. ratio : of its power to that of the force."""
    text = f"noise of the force channel has {100 * ratio:.2g} % of the power of the force: c is too large by as much"
    return Message("force_noise", f"{place}: {text}", place)


def _given_masses(model: Model) -> dict[str, Parameter]:
    """Masses that the rig file gives, by full name."""
    given = {place: model.cap_mass(place) for place in model.places}
    return {f"{p}.m": Parameter(m, 0.0, LINEAR_UNITS["m"], reason="given") for p, m in given.items() if m is not None}


def _fit_messages(found: FullFit) -> tuple[Message, ...]:
    """Messages on the fit itself: no convergence, a residual force that is not white."""
    point = found.point
    out = []
    if last_step_sd(point) > LIMITS.max_last_step_sd:
        out.append(Message("not_converged", "the fit did not converge, so all values are provisional: record longer"))
    if (strong := strong_law_message(point)) is not None:
        out.append(strong)
    return (*out, *(m for i in range(len(point.data.places)) for m in _not_white(point, i)))


def _not_white(point: WorkingPoint, i: int) -> tuple[Message, ...]:
    """A message if the spectrum of the residual force at place i is not that of the model, else none.

    Where a force is measured the residual is sensor noise and may have any spectrum.
    """
    if point.data.measured_force or not point.kL[i] > 0.0:
        return ()
    data, share = point.data, mean_power(point, i) * point.whitening.weight[i] / point.S[i]
    edges = np.unique(np.round(np.geomspace(LIMITS.min_colour_bins, share.size, LIMITS.max_colour_cells)).astype(int))[
        :-1
    ]
    first = np.concatenate([[0], edges])
    bins = np.diff(np.append(first, share.size))
    excess = np.add.reduceat(share, first) / bins - 1.0
    sds = np.abs(excess) * np.sqrt(bins * data.blocks)
    worst = int(np.argmax(sds))
    if sds[worst] < LIMITS.min_colour_sd or abs(excess[worst]) < LIMITS.min_colour_rel:
        return ()
    hz = float(data.f_hz[first[worst] + bins[worst] // 2])
    place = data.places[i]
    text = (
        f"{place}: the spectrum of the residual force is not white: {100 * excess[worst]:+.0f} % near {hz:.0f} Hz; the "
        "model lacks something there, and rotorscope compare shows where"
    )
    return (Message("force_not_white", text, place),)
