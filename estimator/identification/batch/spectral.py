"""Parameters by the spectral path likelihood (docs/estimator.md), the default method of `rotorscope fit`."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.errors import DataError
from estimator.identification.structure import transfer_faults
from estimator.likelihood.motion.checks import check_record
from estimator.likelihood.motion.force_balance import force_channels
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import searched_parameters
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path import excitation_level
from estimator.likelihood.path.contour import slowest_modes
from estimator.likelihood.path.gram_likelihood import evidence_of, responses
from estimator.likelihood.path.measured_force import is_force_measured
from estimator.likelihood.response.below_band import has_even_part, usual_parameters, usual_sizes
from estimator.model.recorder import devices, suspected
from estimator.model.rig import Model
from estimator.results import Fit, Message
from estimator.signals.channel_response import measured_force_places

from . import full_fit, unknown_mass, unmeasured_end
from .full_fit import FullFit
from .grid_start import fit_record
from .line_notches import lines_in_words
from .measured_force import analyse
from .report import SpectralFit, fitted_parameters, ratios_only_message

COARSE_FIT_S = 20.0  # of a record, for where a gap is begun
MAX_UNMEASURED_POWER_REL = (
    1e-3  # of the measured force, in power, from which on it matters whether the rest is noise or a force
)
MAX_SHARED_NOISE_REL = (
    0.03  # of the PSD of an inferred force in a cell: with 0.17, kL was one standard deviation high, with 0.9 five
)


def fit_spectral(model: Model, y: Array, rate_hz: float, phase: Array | None = None) -> Fit:
    """Parameters with standard deviations from (n, channels) rows in SI. Raises DataError.

    A model with more than laws of the states of a cap, with a force that remembers, or with a law that moves the cap
    off its centre is fitted as compare fits it, and so are a record behind a filter that shows, a rotor beyond whirl,
    a force beside those measured, noise of a sensor that comes through the shaft into the force at another, and a law
    with searched numbers whose likelihood is not brought to its maximum here.
    """
    known = not unknown_mass.places_without_mass(model) or bool(unknown_mass.places_scaled_by_shaft(model))
    solution: SpectralFit | None = None
    if not (known and _has_more_than_laws(model)):
        solution = analyse(model, y, rate_hz, phase, _coarse_values(model, y, rate_hz) if known else None)
    lost = (
        solution is not None
        and known
        and (search_has_failed(solution) or _has_growing_mode(solution) or _shares_sensor_noise(solution))
    )
    if solution is None or lost or (known and _shows_roll_off(solution)):
        found = full_fit.fit_all_effects(model, check_record(model, y, rate_hz), rate_hz)
        if solution is None or lost or found.model.roll_off:
            return found.to_fit()
    if (beside := _full_fit_with_unmeasured_force(solution, y)) is not None:
        return beside.to_fit()
    samples = int(solution.record.motion.valid.sum())
    return Fit(fitted_parameters(solution), -solution.local.nll, samples, "spectral", spectral_messages(solution))


def _full_fit_with_unmeasured_force(solution: SpectralFit, y: Array) -> FullFit | None:
    """The model fitted as compare fits it, where the force is measured everywhere, yet not all of it: another acts
    beside it. Such a fit takes what is left for noise of the sensors, and c comes out too small by its share."""
    model, rate_hz = solution.record.model, solution.record.rate_hz
    if not is_force_measured(solution.balance) or any(model.cap_mass(place) is None for place in model.places):
        return None
    forces = np.array([np.nanvar(y[:, k]) for _, k in sorted(force_channels(model).items())]) / (0.5 * rate_hz)
    shares = solution.point.S / forces
    if (shares < MAX_UNMEASURED_POWER_REL).all():
        return None
    found = full_fit.fit_all_effects(model, check_record(model, y, rate_hz), rate_hz)
    return found if transfer_faults.has_unmeasured_force(found.model, found.point) else None


def _coarse_values(model: Model, y: Array, rate_hz: float) -> dict[str, float] | None:
    """Values by name to begin from, where a law has numbers that no linear fit finds, as compare finds them: from a
    gap of another size Gauss-Newton ends at a maximum of its own. None without such a law."""
    if not any(searched_parameters(effect_of(use), model) for use in model.effects):
        return None
    part = y[: int(COARSE_FIT_S * rate_hz)]
    try:
        point = fit_record(model, prepare(model, part, rate_hz))
    except DataError:
        return None  # the fit itself says what is wrong
    return {use.name(k): float(v) for use in point.placed for k, v in enumerate(use.p)}


def _has_more_than_laws(model: Model) -> bool:
    """Whether the model has effects that the Gram matrices do not hold; those that move a cap off its centre they hold
    where the force is measured."""
    effects = [effect_of(use) for use in model.effects]
    more = any(e.kind != "force" or e.name in PERIODIC_EFFECTS for e in effects)
    if not measured_force_places(model):
        more |= any(has_even_part(e, usual_parameters(e), usual_sizes(e)) for e in effects)
        timed = bool(model.speed_rpm) or model.tacho is not None
        more |= timed and any(u.name == BALL_PASS.name for u in model.effects)
    return more


def search_has_failed(solution: SpectralFit) -> bool:
    """Whether the search for a law's numbers has not come to rest, or has left for where they do nothing: of two that
    nearly do the same, say."""
    sd = np.sqrt(np.diag(solution.covariance))
    told = [np.isfinite(sd[j]) for j, f in enumerate(solution.balance.free) if f.searched]
    return bool(told) and not (solution.converged and all(told))


def _has_growing_mode(solution: SpectralFit) -> bool:
    """Whether a mode of the mean response grows, so that only the law's bend holds it: see contour.py."""
    balance, f_hz = solution.balance, solution.start.nodes.f_hz
    B = balance.coefficients(solution.point.beta)
    A = B @ responses(balance, solution.bank.tangents, f_hz)
    modes = slowest_modes(A, np.diag(B), f_hz)
    return bool(np.any(modes.real > 0.0))


def _shares_sensor_noise(solution: SpectralFit) -> bool:
    """Whether noise of a sensor is much of the force that is inferred at another place, through the shaft: rows are
    taken as independent here, and are not then (sensor_noise.py)."""
    point, local = solution.point, solution.local
    shares = point.noise * local.floor / local.spread[:, :, None]
    return bool(np.max(shares, where=~np.eye(point.S.size, dtype=bool), initial=0.0) > MAX_SHARED_NOISE_REL)


def _shows_roll_off(solution: SpectralFit) -> bool:
    """Whether the force seems to fall alike at all places, or those of a bearing, as behind a filter of the recorder:
    recorder.py."""
    record, local, grid = solution.record, solution.local, solution.record.grid
    if record.force:
        return False
    count = evidence_of(solution.bank).blocks * grid.per_cell.astype(np.float64)
    peaks = [solution.start.sizes[place]["hz_peak"] for place in solution.balance.places]
    ratio, f_hz, places = local.power / local.spread, grid.mean_by_cell(grid.f_hz), solution.balance.places
    return any(suspected(ratio[:, own], f_hz, count, max(peaks)) for own in ([*range(len(places))], *devices(places)))


def spectral_messages(solution: SpectralFit) -> tuple[Message, ...]:
    """What the user should know beside the numbers: what was assumed and does not hold, what sets no scale."""
    out: list[Message] = []
    point, places = solution.point, solution.balance.places
    if not solution.converged:
        out.append(Message("not_converged", "the fit did not converge, so all values are provisional: record longer"))
    out += excitation_level.uneven_message(solution.bank.level)
    record = solution.record
    out += unmeasured_end.unmeasured_end_messages(
        record.model, {p: solution.values.get(f"{p}.kL", 0.0) for p in places}
    )
    if record.lines:
        out.append(
            Message(
                "lines_left_out",
                f"spectral lines left out of the fit: {lines_in_words(record.lines, record.model.speed_rpm)}",
            )
        )
    values, sd = solution.values, np.sqrt(np.diag(solution.covariance))
    for i, place in enumerate(places):
        name = f"{place}.m"
        if name in values and not np.isfinite(sd[solution.balance.names.index(name)]):
            out.append(ratios_only_message(place, values[f"{place}.kL"], values[f"{place}.c"], values[name]))
        if solution.record.force:  # what is left is the sensor's noise, not a force
            continue
        excess = solution.local.power[:, i] / (solution.local.spread[:, i] * record.counted) - 1.0
        count = 0.5 * solution.bank.blocks.sum() * solution.record.grid.per_cell
        z = excess * np.sqrt(count)
        worst = int(np.argmax(np.abs(z)))
        if abs(z[worst]) > 5.0 and abs(excess[worst]) > 0.05:
            f = solution.record.grid.f_hz[solution.record.grid.starts]
            text = (
                f"{place}: the spectrum of the residual force is not white: {100 * excess[worst]:+.0f} % near "
                f"{f[worst]:.0f} Hz; the model lacks something there, and rotorscope compare shows where"
            )
            out.append(Message("force_not_white", text, place))
        if point.noise[i] > 0 and point.noise[i] * solution.local.floor[0, i, i] > point.S[i]:
            text = f"{place}: sensor noise exceeds the excitation at the lower end of the band: raise band.low"
            out.append(Message("noise_at_band_low", text, place))
    return tuple(out)
