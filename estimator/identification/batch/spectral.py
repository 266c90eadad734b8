"""Parameters by the spectral path likelihood, the default method of a fit."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.errors import DataError
from estimator.identification.structure import transfer_faults, upper_edge
from estimator.likelihood.motion.checks import check_record
from estimator.likelihood.motion.force_balance import force_channels
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import searched_parameters
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path import excitation_level
from estimator.likelihood.path.contour import slowest_modes
from estimator.likelihood.path.gram_likelihood import responses
from estimator.likelihood.path.measured_force import is_force_measured
from estimator.likelihood.response.below_band import has_even_part, usual_parameters, usual_sizes
from estimator.model.rig import Model
from estimator.results import Fit, Message
from estimator.signals.channel_response import measured_force_places

from . import full_fit, unknown_mass, unmeasured_end
from .full_fit import FullFit
from .grid_start import fit_record
from .line_notches import lines_in_words
from .measured_force import analyse
from .report import SpectralFit, fitted_parameters, ratios_only_message

COARSE_FIT_S = 20.0  # of the record, for the start of a parameter that a law is not linear in
MAX_UNMEASURED_POWER_REL = 1e-3  # of the power of the measured force: a smaller rest is noise or force, either will do
MAX_OUTSIDE_SD = 2.0  # of an amplitude beyond a limit: nearer, an amplitude of at least 0 is not identifiable
MAX_SHARED_NOISE_REL = 0.03  # of the PSD of a residual force in a cell; 0.17 moved kL by one standard deviation


def fit_spectral(model: Model, y: Array, rate_hz: float, phase: Array | None = None) -> Fit:
    """Parameters of a rig from a record, by the spectral path likelihood.

    The Gram matrices of the record are enough for laws of the displacement and velocity of a cap. The full fit takes
    over for: disturbances, forces with memory, laws with an even part, a mode that the mean response lets
    grow, an unmeasured force beside a measured one, sensor noise that acts through the
    shaft, a search for nonlinear parameters that does not converge, and values outside the limits of their
    parameters.

    Parameters
    ----------
    model : Model
        The rig. Values that are None are fitted.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``. NaN where a sample is missing or clipped.
    rate_hz : float
        Sampling rate, Hz.
    phase : (n,) float64, optional
        Measured shaft angle, rad. None: that of the given shaft speed.

    Returns
    -------
    Fit
        Parameters by full name, each with its standard deviation, and messages for the user.

    Raises
    ------
    DataError
        The record cannot answer: too short, a dead channel, no resonance in the band.
    """
    has_scale = not unknown_mass.places_without_mass(model) or bool(unknown_mass.places_scaled_by_shaft(model))
    gram_fit: SpectralFit | None = None
    if not (has_scale and _has_more_than_laws(model)):
        gram_fit = analyse(model, y, rate_hz, phase, _coarse_values(model, y, rate_hz) if has_scale else None)
    failed = (
        gram_fit is not None
        and has_scale
        and (
            search_has_failed(gram_fit)
            or is_outside_limits(gram_fit)
            or _has_growing_mode(gram_fit)
            or _shares_sensor_noise(gram_fit)
        )
    )
    if gram_fit is None or failed:
        return full_fit.fit_all_effects(model, check_record(model, y, rate_hz), rate_hz).to_fit()
    if (with_unmeasured := _full_fit_with_unmeasured_force(gram_fit, y)) is not None:
        return with_unmeasured.to_fit()
    samples = int(gram_fit.record.motion.valid.sum())
    return Fit(
        parameters=fitted_parameters(gram_fit),
        log_likelihood=-gram_fit.local.nll,
        samples=samples,
        method="spectral",
        messages=spectral_messages(gram_fit),
    )


def _full_fit_with_unmeasured_force(gram_fit: SpectralFit, y: Array) -> FullFit | None:
    """The full fit where every place has a measured force and an unmeasured one beside it; None elsewhere.

    The Gram fit takes the whole residual for sensor noise, and c would be too small by the share of that force.
    """
    model, rate_hz = gram_fit.record.model, gram_fit.record.rate_hz
    if not is_force_measured(gram_fit.balance) or any(model.cap_mass(place) is None for place in model.places):
        return None
    forces = np.array([np.nanvar(y[:, k]) for _, k in sorted(force_channels(model).items())]) / (0.5 * rate_hz)
    shares = gram_fit.point.S / forces
    if (shares < MAX_UNMEASURED_POWER_REL).all():
        return None
    found = full_fit.fit_all_effects(model, check_record(model, y, rate_hz), rate_hz)
    return found if transfer_faults.has_unmeasured_force(found.model, found.point) else None


def _coarse_values(model: Model, y: Array, rate_hz: float) -> dict[str, float] | None:
    """Start values by full name for a model with laws that are not linear in a free parameter; None without such a law.

    Gauss-Newton alone ends at a local maximum if a gap starts far off.
    """
    if not any(searched_parameters(effect_of(use), model) for use in model.effects):
        return None
    part = y[: int(COARSE_FIT_S * rate_hz)]
    try:
        point = fit_record(model, prepare(model, part, rate_hz))
    except DataError:
        return None  # the fit itself says what is wrong
    return {use.name(k): float(v) for use in point.placed for k, v in enumerate(use.p)}


def _has_more_than_laws(model: Model) -> bool:
    """Whether the model needs the full fit: it has more than force laws of the states of a cap, or laws with an even
    part and no measured force."""
    effects = [effect_of(use) for use in model.effects]
    more = any(e.kind != "force" or e.name in PERIODIC_EFFECTS for e in effects)
    if not measured_force_places(model):
        more |= any(has_even_part(e, usual_parameters(e), usual_sizes(e)) for e in effects)
        timed = bool(model.speed_rpm) or model.tacho is not None
        more |= timed and any(u.name == BALL_PASS.name for u in model.effects)
    return more


def search_has_failed(gram_fit: SpectralFit) -> bool:
    """Whether the search for nonlinear parameters did not converge, or ended where one of them has no effect."""
    sd = np.sqrt(np.diag(gram_fit.covariance))
    identifiable = [np.isfinite(sd[j]) for j, f in enumerate(gram_fit.balance.free) if f.searched]
    return bool(identifiable) and not (gram_fit.converged and all(identifiable))


def is_outside_limits(gram_fit: SpectralFit) -> bool:
    """Whether a searched parameter of a law, or an amplitude by more than its uncertainty, is outside its limits."""
    balance, sd = gram_fit.balance, np.sqrt(np.diag(gram_fit.covariance))
    of_laws = {law.name(j) for law in balance.laws for j in (*law.linear, *law.searched)}
    for f, s in zip(balance.free, sd.tolist(), strict=False):
        beyond = 0.0 if f.searched else MAX_OUTSIDE_SD * s
        if f.name in of_laws and not f.low - beyond <= gram_fit.values[f.name] <= f.high + beyond:
            return True
    return False


def _has_growing_mode(gram_fit: SpectralFit) -> bool:
    """Whether a mode of the mean response grows, so that only a nonlinearity limits the motion."""
    balance, f_hz = gram_fit.balance, gram_fit.start.nodes.f_hz
    B = balance.coefficients(gram_fit.point.beta)
    A = B @ responses(balance, gram_fit.bank.tangents, f_hz)
    modes = slowest_modes(A, np.diag(B), f_hz)
    return bool(np.any(modes.real > 0.0))


def _shares_sensor_noise(gram_fit: SpectralFit) -> bool:
    """Whether the noise of one sensor is a large part of the residual force at another place, through the shaft.

    The Gram fit takes the residual forces of the places as independent.
    """
    point, local = gram_fit.point, gram_fit.local
    shares = point.noise * local.floor / local.spread[:, :, None]
    return bool(np.max(shares, where=~np.eye(point.S.size, dtype=bool), initial=0.0) > MAX_SHARED_NOISE_REL)


def _upper_edge_messages(gram_fit: SpectralFit) -> tuple[Message, ...]:
    """A message if the upper end of the band is not to be trusted, else none."""
    record, local, grid = gram_fit.record, gram_fit.local, gram_fit.record.grid
    if (messages := upper_edge.aliasing_message(record.model, record.rate_hz)) or record.force:
        return messages
    count = gram_fit.bank.blocks.sum() * grid.per_cell.astype(np.float64)
    resonance_hz = max(gram_fit.start.sizes[place]["hz_peak"] for place in gram_fit.balance.places)
    ratio = (local.power / local.spread).T / record.counted
    return upper_edge.roll_off_message(ratio, grid.mean_by_cell(grid.f_hz), count, resonance_hz)


def spectral_messages(gram_fit: SpectralFit) -> tuple[Message, ...]:
    """Messages of a Gram fit: no convergence, lines left out, assumptions that do not hold, a scale that is missing."""
    out: list[Message] = []
    point, places = gram_fit.point, gram_fit.balance.places
    if not gram_fit.converged:
        out.append(Message("not_converged", "the fit did not converge, so all values are provisional: record longer"))
    out += excitation_level.uneven_message(gram_fit.bank.level)
    record = gram_fit.record
    out += unmeasured_end.unmeasured_end_messages(
        record.model, {p: gram_fit.values.get(f"{p}.kL", 0.0) for p in places}
    )
    if record.lines:
        words = lines_in_words(record.lines, record.model.speed_rpm)
        out.append(Message("lines_left_out", f"spectral lines left out of the fit: {words}"))
    out += _upper_edge_messages(gram_fit)
    values, sd = gram_fit.values, np.sqrt(np.diag(gram_fit.covariance))
    for i, place in enumerate(places):
        name = f"{place}.m"
        if name in values and not np.isfinite(sd[gram_fit.balance.names.index(name)]):
            out.append(ratios_only_message(place, values[f"{place}.kL"], values[f"{place}.c"], values[name]))
        if gram_fit.record.force:  # the residual is sensor noise, not a force
            continue
        excess = gram_fit.local.power[:, i] / (gram_fit.local.spread[:, i] * record.counted) - 1.0
        count = 0.5 * gram_fit.bank.blocks.sum() * gram_fit.record.grid.per_cell
        z = excess * np.sqrt(count)
        worst = int(np.argmax(np.abs(z)))
        if abs(z[worst]) > 5.0 and abs(excess[worst]) > 0.05:
            f = gram_fit.record.grid.f_hz[gram_fit.record.grid.starts]
            text = (
                f"{place}: the spectrum of the residual force is not white: {100 * excess[worst]:+.0f} % near "
                f"{f[worst]:.0f} Hz; the model lacks something there, and rotorscope compare shows where"
            )
            out.append(Message("force_not_white", text, place))
        if point.noise[i] > 0 and point.noise[i] * gram_fit.local.floor[0, i, i] > point.S[i]:
            text = f"{place}: sensor noise exceeds the excitation at the lower end of the band: raise band.low"
            out.append(Message("noise_at_band_low", text, place))
    return tuple(out)
