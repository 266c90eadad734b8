"""Search for the background of the bearings: structural modes and smooth spectra of the force that a record shows.

Modes are added one at a time where the score is largest, and knots of the spectrum of the force, as long as they gain.
What kL and c lose in certainty by the background is part of the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.known_spectra import FORCE_SHAPES, excitation_shapes, shaft_response
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background, BearingBackground, ModeForm
from estimator.model.rig import Model

from .cross_spectra import CrossSpectra, Work, cross_spectra
from .joint_spectrum import MASS_RATIO_LIMITS, JointPoint, JointSpectrum, JointValues, ModePlace, products
from .spectral_shape import MIN_UNKNOWN_DEPTH_RMS, spectra_are_explained

MIN_GAIN_NATS = 20.0  # of a mode or of more knots: 3 parameters at 1 of some 1e3 distinct frequencies, p = 1e-6
MAX_MISFIT = 0.23  # rms of ln(measured / model) with a background, 1 dB: instruments have +-10 % (ISO 2954)
MAX_MODES_PER_CAP = 6
KNOT_OCTAVES = (2.0, 1.0)  # distances of the knots of the spectrum of the force, tried in turn
FALL_POWERS = (8, 16, 32)  # of the frequency in ln S, towards the upper edge: an unknown filter, a mounting resonance
MIN_EDGE_RATIO = 2.0  # of the upper edge over a resonance, for a fall in the spectrum that is not the bearing's
MIN_KNOT_WIDTHS = 4.0  # the same in half-power widths of the bearing's resonance: no bend within it
SCANNED_PER_OCTAVE = 40
SCANNED_DAMPING = (0.006, 0.02, 0.06)
PROPOSAL_COUNT = 4  # fitted at each step
BEST_SCORES = 60  # of a form at a cap, among which the proposals are
SAME_FREQUENCY_LN = 0.1  # proposals nearer than this are one
SURE_MASS_SD = 0.1  # of ln(mass): a mode as sure is worth some 50 nats
TRIED_STEPS, TRIED_TOLERANCE_NATS = 12, 1.0
MIN_STIFFNESS_REL = 1e-3  # of the stiffest bearing, for a start where a fit is far from the rotor
START_NOISE_REL = 1e-4  # of the least PSD
SHAPE_KNOTS = 64  # of the spectrum of the force in the result


def find_background(model: Model, point: WorkingPoint) -> Background | None:
    """The background that a record shows beside a fitted model; None where the model explains the spectra.

    A measured force has the spectrum that it has, and its path shows the structure: no background is sought there.
    None either where one effect of the catalogue explains the spectra.

    Parameters
    ----------
    model : Model
        The rig, with the background that the working point has.
    point : WorkingPoint
        The fitted model.
    """
    found = background_of_spectra(model, point, Work())
    if found is None or (model.background is None and spectra_are_explained(model, point)):
        return None
    return found


def background_of_spectra(model: Model, point: WorkingPoint, work: Work) -> Background | None:
    """The background that explains the spectra of a record; None where the model does. Effects are not considered.

    Parameters
    ----------
    model, point
        As of `find_background`.
    work : Work
        What the search may do.

    Raises
    ------
    SearchTooLongError
        The search would do more.
    """
    if point.data.measured_force or not np.all(point.kL > 0.0):
        return None
    at: dict[str, BearingBackground] = {}
    for places in caps_by_direction(point.data.places):
        at |= _of_direction(model, point, places, work)
    return Background(at=at) if at else None


def caps_by_direction(places: Sequence[str]) -> list[tuple[int, ...]]:
    """Indices of the places of each direction, such as "bearing1.x" and "bearing2.x": these caps respond together."""
    directions = dict.fromkeys(place[-1] for place in places)
    return [tuple(i for i, place in enumerate(places) if place[-1] == direction) for direction in directions]


def _of_direction(
    model: Model, point: WorkingPoint, places: tuple[int, ...], work: Work
) -> dict[str, BearingBackground]:  # fmt: skip
    """The background of the caps of one direction, by place; empty where the model explains their spectra."""
    problem = replace(spectral_problem(model, point, measured_spectra(model, point, places)), work=work)
    least = MIN_GAIN_NATS * force_dispersion(point)
    try:
        if (known := with_known_background(problem, point, model.background)) is None:
            found = first = problem.maximised(start_values(problem, point))
        else:
            problem, found = known
            first, found = None, without_idle_modes(problem, found, least)
        problem, found = search_background(problem, found, least)
    except np.linalg.LinAlgError:
        return {}
    if first is not None and found.log_likelihood - first.log_likelihood < least:
        return {}
    if float(problem.misfit(found).max()) > MAX_MISFIT:
        return {}
    return dict(backgrounds(problem, found, point))


def measured_spectra(model: Model, point: WorkingPoint, places: tuple[int, ...]) -> CrossSpectra:
    """The spectral matrices of the caps at some places: of the measured velocity, or of the residual force of laws.

    Where laws act, the residual force and the linearised rotor give the spectra without the harmonics of the laws.
    """
    if point.placed or point.data.background is not None:
        return cross_spectra(
            point.data, point.force, places, lambda f_hz: _acceleration_per_force(model, point, places, f_hz)
        )

    def acceleration_per_velocity(f_hz: Array) -> Complexes:
        return np.asarray(2j * np.pi * f_hz[:, None, None] * np.eye(len(places)), np.complex128)

    return cross_spectra(point.data, point.data.v, places, acceleration_per_velocity)


def spectral_problem(
    model: Model, point: WorkingPoint, spectra: CrossSpectra, channel_of: tuple[int, ...] | None = None,
    loose: tuple[int, ...] = (),
) -> JointSpectrum:  # fmt: skip
    """The spectral problem of the caps of one direction at the mean tangents of a working point.

    channel_of : by place, the place whose channel is there in truth, and with it the tangents; None: its own.
    loose : numbers of the caps among those of the spectra whose mass is fitted.
    """
    data, own = point.data, list(spectra.places)
    tangents_of = own if channel_of is None else [channel_of[i] for i in own]
    s = 2j * np.pi * spectra.f_hz
    across = point.mean_tangent[own][:, own] * (1.0 - np.eye(len(own)))[..., None]
    shaft = _shaft_at(model, point, own, spectra.f_hz)
    Z0 = shaft - _inertia(model, point, own, spectra.f_hz) + across[..., 0] + s[:, None, None] * across[..., 1]
    laws = _law_response(point, spectra.f_hz)[:, tangents_of]
    shape = excitation_shapes(model, data.places, spectra.f_hz, FORCE_SHAPES)[own].T
    mass = cap_masses(model, point)[own]
    _, c = sound_stiffness_and_damping(point)
    damping0 = np.log(c[tangents_of] * mass / data.mass[tangents_of])
    return JointSpectrum(
        spectra=spectra, Z0=Z0, laws=laws, mass=mass, shape=shape, damping0=damping0, loose=loose, shaft=shaft
    )  # fmt: skip


def cap_masses(model: Model, point: WorkingPoint) -> Array:
    """(places,) kg of the caps; of the working point where the model has none."""
    data = point.data
    return np.array([model.cap_mass(place) or data.mass[i] for i, place in enumerate(data.places)])


def _acceleration_per_force(model: Model, point: WorkingPoint, places: tuple[int, ...], f_hz: Array) -> Complexes:
    """(f, caps, caps) 1/kg, acceleration of the caps at some places per force there, of the linearised rotor."""
    data, own, s = point.data, list(places), 2j * np.pi * f_hz
    D = point.mean_tangent[own][:, own]
    bearings = D[..., 0] + s[:, None, None] * D[..., 1]
    np.einsum("fii->fi", bearings)[...] = point.kL[own] + s[:, None] * point.c[own] + _law_response(point, f_hz)[:, own]
    Z = _shaft_at(model, point, own, f_hz) - _inertia(model, point, own, f_hz)
    if data.background is not None:
        bearings *= data.background.deflections(data.places, s)[:, None, own]
        np.einsum("fii->fi", Z)[...] += data.background.attached_stiffness(data.places, s)[:, own]
    return np.asarray((s * s)[:, None, None] * np.linalg.inv(Z + bearings), np.complex128)


def _shaft_at(model: Model, point: WorkingPoint, own: list[int], f_hz: Array) -> Complexes:
    """(f, caps, caps) N/m, dynamic stiffness of shaft and disc at some places."""
    return np.asarray(shaft_response(model, point.data.places, f_hz)[:, own][:, :, own], np.complex128)


def _inertia(model: Model, point: WorkingPoint, own: list[int], f_hz: Array) -> Array:
    """(f, caps, caps) N/m, inertia force of the caps at some places per displacement."""
    return np.asarray(((2.0 * np.pi * f_hz) ** 2)[:, None, None] * np.diag(cap_masses(model, point)[own]), np.float64)


def _law_response(point: WorkingPoint, f_hz: Array) -> Complexes:
    """(f, places) N/m, mean response of the laws at each place to the deflection of its bearing, without kL and c."""
    data, s = point.data, 2j * np.pi * point.data.f_hz
    total = -(s * s)[:, None] * (data.mass - np.einsum("fii->fi", point.A)) - np.einsum("fii->fi", data.shaft)
    if data.background is not None:
        total = total / data.background.deflections(data.places, s)
    laws = (total - point.kL - s[:, None] * point.c).T
    return np.array([np.interp(f_hz, data.f_hz, z.real) + 1j * np.interp(f_hz, data.f_hz, z.imag) for z in laws]).T


def sound_stiffness_and_damping(point: WorkingPoint) -> tuple[Array, Array]:
    """(places,) N/m and N s/m, of the fit, but a stiffness above zero, and a damping of 0.1 % of critical at least."""
    k = np.maximum(point.kL, MIN_STIFFNESS_REL * np.abs(point.kL).max())
    return k, np.maximum(point.c, 2e-3 * np.sqrt(k * point.data.mass))


def start_values(problem: JointSpectrum, point: WorkingPoint) -> JointValues:
    """Values of the fitted model."""
    own = list(problem.spectra.places)
    least = START_NOISE_REL * np.min(np.einsum("fii->fi", problem.spectra.psd).real / problem.spectra.noise, axis=0)
    return JointValues(
        force=np.log(point.S[own])[:, None] * problem.flat,
        noise=np.log(np.maximum((point.nu * point.S)[own], least)),
        stiffness=np.log(sound_stiffness_and_damping(point)[0][own]),
        damping=problem.damping0.copy(),
    )


def with_known_background(
    problem: JointSpectrum, point: WorkingPoint, known: Background | None
) -> tuple[JointSpectrum, JointPoint] | None:
    """The problem and its point from a fitted model and a background; None where no cap has one."""
    own = {c: point.data.places[i] for c, i in enumerate(problem.spectra.places)}
    there = {} if known is None else {c: b for c, p in own.items() if (b := known.at.get(p))}
    if not there:
        return None
    octaves, fall = min(b.knot_octaves for b in there.values()), max(b.fall_power for b in there.values())
    problem = replace(problem, octaves=octaves, fall_power=fall)
    values = start_values(problem, point)
    for cap, background in there.items():
        ln_psd = np.log(background.force_shape(problem.spectra.f_hz))
        values.force[cap] += np.linalg.lstsq(problem.basis, ln_psd, rcond=None)[0]
        for m in background.modes:
            q = np.log([m.frequency_hz, m.damping, m.mass / problem.mass[cap]])
            values = values.with_mode(ModePlace(cap, m.form), q)
    return problem, problem.maximised(values)


def search_background(problem: JointSpectrum, point: JointPoint, least: float) -> tuple[JointSpectrum, JointPoint]:
    """The likeliest problem and point, modes and knots added while they gain `least` nats, and modes taken out.

    The problem as it is where it explains the spectra.
    """
    if float(problem.misfit(point).max()) < MIN_UNKNOWN_DEPTH_RMS:
        return problem, point
    octaves = [o for o in KNOT_OCTAVES if _least_octaves(problem, point) <= o < problem.octaves]
    while len(point.values.modes) < MAX_MODES_PER_CAP * problem.mass.size:
        tried = list(_tried_modes(problem, point))
        finer = [replace(problem, octaves=own) for own in octaves[:1]]
        if problem.fall_power == 0 and _resonates_low(problem, point):
            finer += [replace(problem, fall_power=power) for power in FALL_POWERS]
        tried += [(other, tried_point(other, other.respaced(point.values, problem))) for other in finer]
        there, best = max(tried, key=lambda one: one[1].log_likelihood, default=(problem, point))
        best = there.maximised(best.values)
        if best.log_likelihood - point.log_likelihood < least:
            break
        octaves = [o for o in octaves if o < there.octaves]
        problem, point = there, best
    return problem, without_idle_modes(problem, _in_likelier_forms(problem, point), least)


def _in_likelier_forms(problem: JointSpectrum, point: JointPoint) -> JointPoint:
    """The point with each mode under the bearing or on the cap, whichever is likelier.

    Both forms have the same dynamic stiffness near their frequency where M_support M_attached w0^4 = kL^2.
    """
    for k, mode in enumerate(point.values.modes):
        f, zeta, ratio = point.values.q[k]
        ln_w0_squared = 2.0 * (np.log(2.0 * np.pi) + f)
        stiffness = point.values.stiffness[mode.cap] - np.log(problem.mass[mode.cap]) - ln_w0_squared
        other = ModePlace(mode.cap, "attached" if mode.form == "support" else "support")
        limits = np.log(MASS_RATIO_LIMITS[other.form])
        q = np.array([f, zeta, float(np.clip(2.0 * stiffness - ratio, *limits))])
        flipped = problem.maximised(point.values.without_mode(k).with_mode(other, q))
        if flipped.log_likelihood > point.log_likelihood:
            order = [*range(k), len(point.values.modes) - 1, *range(k, len(point.values.modes) - 1)]
            values = replace(
                flipped.values, modes=tuple(flipped.values.modes[j] for j in order), q=flipped.values.q[order]
            )
            point = replace(flipped, values=values)
    return point


def without_idle_modes(problem: JointSpectrum, point: JointPoint, least: float) -> JointPoint:
    """The point without the modes that lose less than `least` nats when they are taken out."""
    J, _ = problem.score(point)
    sd = np.sqrt(np.abs(np.diag(np.linalg.pinv(products(J)))))
    mass_sd = sd[sd.size - 3 * len(point.values.modes) :].reshape(-1, 3)[:, 2]
    for k in reversed(range(len(point.values.modes))):
        if mass_sd[k] < SURE_MASS_SD:
            continue
        bare = problem.maximised(point.values.without_mode(k))
        if point.log_likelihood - bare.log_likelihood < least:
            point = bare
    return point


def _resonates_low(problem: JointSpectrum, point: JointPoint) -> bool:
    """Whether all bearings resonate so far below the upper edge of the band that a fall there is not theirs."""
    hz = np.sqrt(np.exp(point.values.stiffness) / problem.mass) / (2.0 * np.pi)
    return bool(hz.max() * MIN_EDGE_RATIO < problem.spectra.f_hz[-1])


def _least_octaves(problem: JointSpectrum, point: JointPoint) -> float:
    """Least distance of the knots that leaves the force without a bend in the resonance of a bearing."""
    k, c = np.exp(point.values.stiffness), np.exp(point.values.damping)
    zeta = c / (2.0 * np.sqrt(k * problem.mass))
    return float(np.log2(1.0 + MIN_KNOT_WIDTHS * 2.0 * zeta.min()))


def tried_point(problem: JointSpectrum, values: JointValues) -> JointPoint:
    """The point after some steps, to compare values by."""
    return problem.maximised(values, TRIED_STEPS, TRIED_TOLERANCE_NATS)


def _tried_modes(problem: JointSpectrum, point: JointPoint) -> Iterator[tuple[JointSpectrum, JointPoint]]:
    """Points with one more mode, those that promise most."""
    seen: list[tuple[ModePlace, float]] = []
    for _, mode, q in sorted(_scores(problem, point), key=lambda one: -one[0]):
        if any(mode == other and abs(q[0] - f) < SAME_FREQUENCY_LN for other, f in seen):
            continue
        seen.append((mode, float(q[0])))
        try:
            yield problem, tried_point(problem, point.values.with_mode(mode, q))
        except np.linalg.LinAlgError:
            continue
        if len(seen) == PROPOSAL_COUNT:
            return


def _scores(problem: JointSpectrum, point: JointPoint) -> Iterator[tuple[float, ModePlace, Array]]:
    """What a mode would gain by its mass to first order, nats, at all frequencies and dampings of a grid."""
    J, r = problem.score(point)
    spectra, s = problem.spectra, point.s
    R = problem.matrices(r - np.linalg.lstsq(products(J), J @ r, rcond=1e-10)[0] @ J)
    low, high = spectra.f_hz[0], spectra.f_hz[-1]
    f = np.geomspace(low, high, int(np.log2(high / low) * SCANNED_PER_OCTAVE) + 2)
    w0, zeta = (2.0 * np.pi * z.ravel()[:, None] for z in np.meshgrid(f, SCANNED_DAMPING, indexing="ij"))
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
            for k in np.argsort(-gain)[:BEST_SCORES]:
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
    more = np.sqrt(np.maximum(whole - known, 0.0)).reshape(2, caps)
    cells = problem.spectra.f_hz
    f = cells if problem.fall_power else np.geomspace(cells[0], cells[-1], SHAPE_KNOTS)
    for cap, i in enumerate(problem.spectra.places):
        ln_psd = np.interp(np.log(f), np.log(problem.spectra.f_hz), problem.basis @ values.force[cap])
        psd = np.exp(ln_psd - np.log(np.mean(np.exp(problem.basis @ values.force[cap]))))
        tangent = problem.laws[:, cap]
        yield (
            point.data.places[i],
            BearingBackground(
                modes=tuple(mode for at, mode in problem.modes(values) if at == cap),
                stiffness=float(np.exp(values.stiffness[cap]) + tangent.real.mean()),
                damping=float(np.exp(values.damping[cap]) + (tangent / found.s).real.mean()),
                f_hz=f,
                psd_rel=psd,
                knot_octaves=problem.octaves,
                fall_power=problem.fall_power,
                stiffness_sd_rel=float(more[0, cap]),
                damping_sd_rel=float(more[1, cap]),
            ),
        )
