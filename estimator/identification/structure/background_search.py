"""Search for the background of the bearings: structural modes and smooth spectra of the force that a record shows.

Modes are added one at a time where the score is largest, and knots of the spectrum of the force, as long as they gain.
What kL and c lose in certainty by the background is part of the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import expit

from estimator.arrays import Array, Complexes, products
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background, BearingBackground, ModeForm
from estimator.model.rig import Model
from estimator.parallel import map_single_core

from .cross_spectra import Work
from .joint_spectrum import MASS_RATIO_LIMITS, JointPoint, JointSpectrum, JointValues, ModePlace, Solution
from .spectral_problem import (
    caps_by_direction,
    in_other_form,
    measured_spectra,
    smooth_start,
    spectral_problem,
    start_values,
    under_bearing,
    with_known_background,
)
from .spectral_shape import nats_of_one_cause
from .thresholds import LIMITS


def find_background(model: Model, point: WorkingPoint) -> Background | None:
    """The background that a record shows beside a fitted model; None where the model explains the spectra.

    A measured force has the spectrum that it has, and its path shows the structure: no background is sought there. One
    cause of the catalogue that explains all spectra as well as the background is left to the diagnosis.

    Parameters
    ----------
    model : Model
        The rig, with the background that the working point has.
    point : WorkingPoint
        The fitted model.
    """
    found, gain_nats = background_of_spectra(model, point, Work())
    if found is None or model.background is not None:
        return found
    return None if one_cause_is_enough(model, point, found, gain_nats) else found


def one_cause_is_enough(model: Model, point: WorkingPoint, found: Background, gain_nats: float) -> bool:
    """Whether no location has a spectral shape, or one cause of the catalogue explains all as well as a background.

    One pedestal is no cause of several modes at a place, nor of a mode and a shaped force. gain_nats : of the
    background.
    """
    several = any(len(own.modes) + bool(np.ptp(own.psd_rel)) > 1 for own in found.at.values())
    cause_nats = nats_of_one_cause(model, point, several_modes=several)
    if not cause_nats:
        return cause_nats is None
    return gain_nats < cause_nats / LIMITS.explained_share + LIMITS.min_gain_nats * force_dispersion(point)


def background_of_spectra(
    model: Model, point: WorkingPoint, work: Work, thorough: bool = True
) -> tuple[Background | None, float]:  # fmt: skip
    """The background that explains the spectra of a record, and the nats that it gains; None where the model does.

    Effects are not considered.

    Parameters
    ----------
    model, point
        As of `find_background`.
    work : Work
        What the search may do; a thorough one has no limit.
    thorough : bool
        Whether the search starts from a scan of the band as well: that takes some times as long.

    Raises
    ------
    SearchTooLongError
        The search would do more.
    """
    if point.data.measured_force:
        return None, 0.0
    asked = [
        partial(_of_direction, model, point, places, work, thorough) for places in caps_by_direction(point.data.places)
    ]
    found = map_single_core(asked) if thorough else [ask() for ask in asked]
    at = {place: own for caps, _ in found for place, own in caps.items()}
    return (Background(at=at) if at else None), sum(gained for _, gained in found)


def _of_direction(
    model: Model, point: WorkingPoint, places: tuple[int, ...], work: Work, thorough: bool
) -> tuple[dict[str, BearingBackground], float]:
    """The background of the caps of one direction, by place, and the nats that it gains; none where the model explains
    their spectra.
    """
    problem = replace(spectral_problem(model, point, measured_spectra(model, point, places)), work=work)
    cost_nats = LIMITS.min_gain_nats * force_dispersion(point)
    try:
        if (known := with_known_background(problem, point, model.background)) is not None:
            problem, found = known
            problem, found = search_background(problem, without_idle_modes(problem, found, cost_nats), cost_nats)
            gained = cost_nats
        else:
            first = problem.maximised(start_values(problem, point))
            if thorough and _leaves_unknown(problem, first):
                problem, found = search_from_starts([smooth_start(problem, point), (problem, first)], cost_nats)
            else:
                problem, found = search_background(problem, first, cost_nats)
            gained = found.log_likelihood - first.log_likelihood
    except np.linalg.LinAlgError:
        return {}, 0.0
    if gained < cost_nats or float(problem.misfit(found).max()) > LIMITS.max_background_depth_rms:
        return {}, 0.0
    if not _resonates(problem, found):
        return {}, 0.0
    return dict(backgrounds(problem, found, point)), gained


def search_from_starts(starts: Sequence[Solution], cost_nats: float) -> Solution:
    """The best problem and point of greedy searches from several starts, as their ends depend on the start.

    A search from white forces follows where the others leave something to be explained. cost_nats : nats that a
    mode has to gain.
    """
    found = map_single_core([partial(search_background, *start, cost_nats, thorough=True) for start in starts])
    if all(float(problem.misfit(point).max()) > LIMITS.explained_misfit for problem, point in found):
        problem, point = starts[0]
        white = replace(problem, octaves=np.inf, fall_power=0)
        first = white.maximised(white.respaced(point.values, problem))
        found.append(search_background(white, first, cost_nats, thorough=True))
    return max(found, key=lambda one: score_nats(one, cost_nats))


def search_background(
    problem: JointSpectrum, point: JointPoint, cost_nats: float, thorough: bool = False
) -> Solution:  # fmt: skip
    """The likeliest problem and point, modes and knots added while they gain `cost_nats`, and modes taken out.

    The problem as it is where it explains the spectra, unless the search is to be thorough.
    """
    if not thorough and not _leaves_unknown(problem, point):
        return problem, point
    while True:
        problem, point = _with_more(problem, point, cost_nats)
        before = point.values.modes
        point = without_idle_modes(problem, _in_likelier_forms(problem, point, cost_nats), cost_nats)
        if point.values.modes == before:
            return problem, point


def _leaves_unknown(problem: JointSpectrum, point: JointPoint) -> bool:
    """Whether spectra depart from the model by more than missing laws can shape them."""
    return float(problem.misfit(point).max()) >= LIMITS.min_unknown_depth_rms


def _with_more(problem: JointSpectrum, point: JointPoint, cost_nats: float) -> Solution:
    """The likeliest problem and point, modes and knots added while they gain `cost_nats`."""
    octaves = [o for o in LIMITS.tried_knot_octaves if _least_octaves(problem, point) <= o < problem.octaves]
    while len(point.values.modes) < LIMITS.max_modes_per_cap * problem.mass.size:
        tried = list(_tried_modes(problem, point))
        finer = [replace(problem, octaves=own) for own in octaves[:1]]
        if problem.fall_power == 0 and _resonates_low(problem, point):
            finer += [replace(problem, fall_power=power) for power in LIMITS.fall_powers]
        tried += [(other, tried_point(other, other.respaced(point.values, problem))) for other in finer]
        sound = [one for one in tried if _resonates(*one)]
        there, best = max(sound, key=lambda one: one[1].log_likelihood, default=(problem, point))
        best = there.maximised(best.values)
        if best.log_likelihood - point.log_likelihood < cost_nats or not _resonates(there, best):
            break
        octaves = [o for o in octaves if o < there.octaves]
        problem, point = there, best
    return problem, point


def _in_likelier_forms(problem: JointSpectrum, point: JointPoint, cost_nats: float) -> JointPoint:
    """The point with each mode under the bearing or on the cap, whichever is likelier, and all of a cap under it.

    cost_nats : nats that a mode costs.
    """
    k = 0
    while k < len(point.values.modes):
        point = _likelier(problem, point, in_other_form(problem, point.values, k), cost_nats)
        k += 1
    for cap in range(problem.mass.size):
        if sum(mode.cap == cap for mode in point.values.modes) > 1:
            for other in list(under_bearing(problem, point.values, cap)):
                point = _likelier(problem, point, other, cost_nats)
    return point


def _likelier(problem: JointSpectrum, point: JointPoint, other: JointValues, cost_nats: float) -> JointPoint:
    """The point, or the point reached from other values if that is likelier and each bearing resonates there.

    In its new form a mode may make another one idle.
    """
    found = problem.maximised(other)
    if found.log_likelihood < point.log_likelihood - LIMITS.max_idle_modes * cost_nats:
        return point
    if found.log_likelihood < point.log_likelihood:
        found = without_idle_modes(problem, found, cost_nats)
    gained = score_nats((problem, found), cost_nats) - score_nats((problem, point), cost_nats)
    return found if gained > LIMITS.tried_tolerance_nats and _resonates(problem, found) else point


def _resonates(problem: JointSpectrum, point: JointPoint) -> bool:
    """Whether each cap on its bearing, damped below critical, and each mode resonate below the upper edge of the band.

    The flank of a mode above the edge is not identifiable beside a roll-off of the force.
    """
    f0, edge_hz = _resonances_hz(problem, point), problem.spectra.f_hz[-1]
    zeta = np.exp(point.values.damping) / (4.0 * np.pi * f0 * problem.mass)
    return bool(np.all((f0 < edge_hz) & (zeta < 1.0)) and np.all(np.exp(point.values.q[:, 0]) < edge_hz))


def _resonances_hz(problem: JointSpectrum, point: JointPoint) -> Array:
    """(caps,) Hz, natural frequency of each cap on its bearing alone."""
    return np.asarray(np.sqrt(np.exp(point.values.stiffness) / problem.mass) / (2.0 * np.pi))


def score_nats(solution: Solution, cost_nats: float) -> float:
    """Nats of a solution, less the nats that its modes and the form of its force spectrum have to gain."""
    problem, point = solution
    return point.log_likelihood - cost_nats * (len(point.values.modes) + problem.refinements)


def _sd_of_forms(problem: JointSpectrum, found: JointPoint, point: WorkingPoint) -> Array:
    """(2, caps) standard deviations of ln kL and ln c over both forms of a mode, each as likely as its likelihood."""
    sd = np.zeros((2, problem.mass.size))
    for k in range(len(found.values.modes)):
        other = tried_point(problem, in_other_form(problem, found.values, k))
        lost = (found.log_likelihood - other.log_likelihood) / force_dispersion(point)
        share = float(expit(-lost)) if _resonates(problem, other) else 0.0
        old, new = found.values, other.values
        apart = np.abs([new.stiffness - old.stiffness, new.damping - old.damping])
        sd = np.maximum(sd, apart * np.sqrt(share * (1.0 - share)))
    return sd


def without_idle_modes(problem: JointSpectrum, point: JointPoint, cost_nats: float) -> JointPoint:
    """The point without the modes that lose less than `cost_nats` when they are taken out."""
    J, _ = problem.score(point)
    sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(products(J)))))
    mass_sd = sd[sd.size - 3 * len(point.values.modes) :].reshape(-1, 3)[:, 2]
    for k in reversed(range(len(point.values.modes))):
        if mass_sd[k] < LIMITS.sure_mass_sd:
            continue
        bare = problem.maximised(point.values.without_mode(k))
        sound = _resonates(problem, bare) or not _resonates(problem, point)
        if sound and point.log_likelihood - bare.log_likelihood < cost_nats:
            point = bare
    return point


def _resonates_low(problem: JointSpectrum, point: JointPoint) -> bool:
    """Whether all bearings resonate so far below the upper edge of the band that a roll-off there is not theirs."""
    return bool(_resonances_hz(problem, point).max() * LIMITS.min_edge_ratio < problem.spectra.f_hz[-1])


def _least_octaves(problem: JointSpectrum, point: JointPoint) -> float:
    """Least distance of the knots at which the spectrum of the force is smooth over the resonance of a bearing."""
    k, c = np.exp(point.values.stiffness), np.exp(point.values.damping)
    zeta = c / (2.0 * np.sqrt(k * problem.mass))
    return float(np.log2(1.0 + LIMITS.min_knot_widths * 2.0 * zeta.min()))


def tried_point(problem: JointSpectrum, values: JointValues) -> JointPoint:
    """The point after a few steps from some values, for a comparison of values."""
    return problem.maximised(values, LIMITS.tried_steps, LIMITS.tried_tolerance_nats)


def _tried_modes(problem: JointSpectrum, point: JointPoint) -> Iterator[Solution]:
    """Points with one more mode, for the modes of the highest score."""
    seen: list[tuple[ModePlace, float]] = []
    for _, mode, q in sorted(_scores(problem, point), key=lambda one: -one[0]):
        if any(mode == other and abs(q[0] - f) < LIMITS.same_frequency_ln for other, f in seen):
            continue
        seen.append((mode, float(q[0])))
        try:
            yield problem, tried_point(problem, point.values.with_mode(mode, q))
        except np.linalg.LinAlgError:
            continue
        if len(seen) == LIMITS.proposal_count:
            return


def _scores(problem: JointSpectrum, point: JointPoint) -> Iterator[tuple[float, ModePlace, Array]]:
    """Nats that a mode would gain by its mass to first order, at all frequencies and dampings of a grid."""
    J, r = problem.score(point)
    spectra, s = problem.spectra, point.s
    R = problem.matrices(r - np.linalg.lstsq(products(J), J @ r, rcond=1e-10)[0] @ J)
    low, high = spectra.f_hz[0], spectra.f_hz[-1]
    f = np.geomspace(low, high, int(np.log2(high / low) * LIMITS.scanned_per_octave) + 2)
    w0, zeta = (2.0 * np.pi * z.ravel()[:, None] for z in np.meshgrid(f, LIMITS.scanned_damping, indexing="ij"))
    zeta = zeta / (2.0 * np.pi)
    damp = 2.0 * zeta * w0 * s
    den = s * s + damp + w0 * w0
    for i, half in enumerate(problem.by_stiffness(point)):
        slope = 2.0 * np.einsum("fij,fij->f", R.conj(), half)
        square = 2.0 * spectra.n * np.einsum("fij,fji->f", half, half)
        norm = 2.0 * spectra.n * np.einsum("fij,fij->f", half, half.conj()).real
        support = -(point.B[:, i] ** 2) / (problem.mass[i] * den)
        attached = problem.mass[i] * s * s * (w0 * w0 + damp) / den
        forms: tuple[tuple[ModeForm, Complexes], ...] = (("support", support), ("attached", attached))
        for form, dz in forms:
            score = (dz @ slope).real
            information = (dz**2 @ square).real + np.abs(dz) ** 2 @ norm
            size = np.maximum(score, 0.0) / information
            gain = 0.5 * score * size
            low, high = MASS_RATIO_LIMITS[form]
            for k in np.argsort(-gain)[: LIMITS.best_scores]:
                if size[k] > 0.0:
                    ratio = float(np.clip(1.0 / size[k] if form == "support" else size[k], 1.5 * low, 0.7 * high))
                    yield float(gain[k]), ModePlace(i, form), np.log([w0[k, 0] / (2 * np.pi), zeta[k, 0], ratio])


def force_dispersion(point: WorkingPoint) -> float:
    """Variance of averaged spectra over that of an even record: a force whose level changes has fewer independent
    samples."""
    level = point.data.level
    return 1.0 if level is None else float(np.mean(level**2, axis=1).max())


def backgrounds(
    problem: JointSpectrum, found: JointPoint, point: WorkingPoint
) -> Iterator[tuple[str, BearingBackground]]:  # fmt: skip
    """The background of each cap, by place, in proportion to the masses of the problem."""
    values, caps = found.values, problem.mass.size
    J, _ = problem.score(found)
    first = caps * (problem.basis.shape[1] + 1)
    bearing = np.arange(first, first + 2 * caps)
    whole = np.diag(np.linalg.pinv(products(J)))[bearing]
    white = replace(problem, octaves=np.inf, fall_power=0, loose=())
    J, _ = white.score(replace(found, values=replace(values, force=np.zeros((caps, 1)), heavier=np.zeros(0))))
    known = np.diag(np.linalg.pinv((products(J))[: 4 * caps, : 4 * caps]))[2 * caps :]
    more = np.sqrt(np.maximum(whole - known, 0.0).reshape(2, caps) + _sd_of_forms(problem, found, point) ** 2)
    cells = problem.spectra.f_hz
    f = cells if problem.fall_power else np.geomspace(cells[0], cells[-1], LIMITS.shape_knots)
    for cap, i in enumerate(problem.spectra.places):
        ln_psd = np.interp(np.log(f), np.log(problem.spectra.f_hz), problem.basis @ values.force[cap])
        ln_mean = float(np.log(np.mean(np.exp(problem.basis @ values.force[cap]))))
        tangent = problem.laws[:, cap]
        yield (
            point.data.places[i],
            BearingBackground(
                modes=tuple(mode for at, mode in problem.modes(values) if at == cap),
                stiffness=float(np.exp(values.stiffness[cap]) + tangent.real.mean()),
                damping=float(np.exp(values.damping[cap]) + (tangent / found.s).real.mean()),
                f_hz=f,
                psd_rel=np.exp(ln_psd - ln_mean),
                noise_ratio=float(np.exp(values.noise[cap] - ln_mean)),
                knot_octaves=problem.octaves,
                fall_power=problem.fall_power,
                stiffness_sd_rel=float(more[0, cap]),
                damping_sd_rel=float(more[1, cap]),
            ),
        )
