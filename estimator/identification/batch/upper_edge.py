"""Upper edge of the trusted band: a filter that the rig file does not describe, or aliased components."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.identification.structure.spectral_models import base_model, cells_of
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import Message

from .thresholds import LIMITS

FALL_POWERS = np.array([2, 4, 8, 16, 32])  # of frequency, in the nepers of a common fall of any form


def upper_edge_messages(model: Model, point: WorkingPoint) -> tuple[Message, ...]:
    """A message if the upper end of the band is not to be trusted, else none.

    Parameters
    ----------
    model : Model
        The rig, with the recorder's filter if it is known.
    point : WorkingPoint
        The model fitted to the record.

    Returns
    -------
    tuple of Message
        Of code ``band_aliased`` or ``band_rolls_off``, with the frequency to lower band.high to.
    """
    data = point.data
    if messages := aliasing_message(model, data.rate_hz):
        return messages
    places = [i for i in range(len(data.places)) if point.kL[i] > 0.0]
    if data.measured_force or not places:
        return ()
    cells = [cells_of(point, i) for i in places]
    ratio = np.array([c.power / base_model(c, _fitted(point, i)) for i, c in zip(places, cells, strict=True)])
    resonance = float(np.sqrt(np.max(point.kL[places] / data.mass[places])) / (2 * np.pi))
    return roll_off_message(ratio, cells[0].w / (2 * np.pi), cells[0].n, resonance)


def aliasing_message(model: Model, rate_hz: float) -> tuple[Message, ...]:
    """A message if the filter of the rig file lets components above half the rate alias into the band."""
    trusted = np.inf if model.anti_alias is None else model.anti_alias.trusted_to_hz(rate_hz)
    if trusted >= model.band[1]:
        return ()
    remedy = f"lower band.high to {trusted:.0f} Hz" if trusted > model.band[0] else "record at a higher rate"
    text = (
        "the anti-alias filter of the rig file lets more than 1 % of what is above half the rate into the band above "
        f"{max(trusted, model.band[0]):.0f} Hz: {remedy}"
    )
    return (Message("band_aliased", text),)


def roll_off_message(ratio: Array, f_hz: Array, count: Array, resonance_hz: float) -> tuple[Message, ...]:
    """A message if all places roll off alike towards the end of the band.

    ratio : (places, cells) power of the residual force over the model's. f_hz, count : (cells,) mean frequency and
    number of independent values. resonance_hz : the highest.
    """
    fall = common_fall_db(ratio, f_hz, count, LIMITS.above_resonance_rel * resonance_hz)
    if fall is None or fall[1][-1] < LIMITS.min_fall_db:
        return ()
    f, lost = fall
    seen = f"all channels roll off alike towards the end of the band, by {lost[-1]:.1f} dB at {f_hz[-1]:.0f} Hz"
    known = "give acquisition.anti_alias in the rig file"
    sound = f[lost < LIMITS.trusted_fall_db]
    remedy = f"lower band.high to {sound[-1]:.0f} Hz, or {known}" if sound.size else known
    return (Message("band_rolls_off", f"{seen}, as behind an anti-alias filter: {remedy}"),)


def _fitted(point: WorkingPoint, i: int) -> Array:
    """(4,) ln S, ln of the noise PSD and no change of stiffness and damping, of the fit at location i."""
    quiet = 1e-12 * point.S[i]
    return np.array([np.log(point.S[i]), np.log(max(point.nu[i] * point.S[i], quiet)), 0.0, 0.0])


def common_fall_db(ratio: Array, f_hz: Array, count: Array, from_hz: float) -> tuple[Array, Array] | None:
    """Frequencies above all resonances, Hz, and the roll-off there that all places share, dB; None without one.

    ratio : (places, cells) power of the residual force over the model's. f_hz, count : (cells,) mean frequency and
    number of independent values. from_hz : where the laws end to shape the force.
    """
    from scipy.optimize import nnls

    above = f_hz > from_hz
    if above.sum() < LIMITS.min_cells:
        return None
    f, n, level = f_hz[above], count[above], np.log(ratio[:, above])
    x = (f / f_hz[-1]) ** FALL_POWERS[2]
    x = x - np.average(x, weights=n)
    slope, sd = level @ (n * x) / (n @ x**2), 1 / np.sqrt(n @ x**2)
    if np.any(slope > -LIMITS.min_fall_sd * sd):
        return None
    basis, mean = (f[:, None] / f_hz[-1]) ** FALL_POWERS, level.mean(axis=0)
    free, root = basis - np.average(basis, axis=0, weights=n), np.sqrt(n)
    nepers, _ = nnls(root[:, None] * free, root * (np.average(mean, weights=n) - mean))
    return f, np.asarray(10 * np.log10(np.e) * (basis @ nepers))
