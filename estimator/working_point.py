"""The model fitted to a record: inferred force by place, spectra of its columns, and the tangent A(w)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .bandlimit import left_out
from .calm import as_displacement, calm_of, is_little
from .contour import along, contour
from .determinant import Jacobian
from .effects.strength import search_range
from .features import Series
from .fluctuation import Fluctuation, fluctuations
from .force_level import alike, level_of
from .mean_response import mean_responses
from .model_uses import size, stiffness
from .motion_blocks import FOLDS, MotionBlocks, part_of, spectrum
from .noise_paths import LEAST_NOISE, noise_of, noise_paths
from .path_fit import Gram, PathFit, fit, gram
from .periodic import Wave
from .placed import Placed, evaluate, remembers
from .probe import Probe
from .shaft_law import without_comb
from .side_by_side import each
from .slow_motion import with_slow
from .terms import Spans, add_to, dressed, light, linear_terms, reach, terms
from .transfer import response_of
from .weighing import Columns, Spectrum, Term, Weighing

Array = NDArray[np.float64]
FIRST_SECONDS = 8.0  # of a long record that the first rounds of a fit look at
LEAP = 3.0  # from a part of a record to the next
ROUNDS, LAST_ROUNDS = 6, 3  # at most, and on the whole of it
NOISE_STEP = 0.3  # in nu, of its value: neighbours on the grid that it is sought on
LEAST_LEFT = 0.3  # of a stiffness, after a step, where the force is measured
STRIDE = 0.3  # of the reach of a searched parameter: one standard deviation of the step that is taken at once
SETTLED = 0.1  # standard deviations by which the last step of a fit moves
NEARLY = 0.5  # the same on a part of a record, which is not where the fit ends
SHAKEN = 0.3  # the same where laws are dressed by a probe, which moves with them
LOOKED_AT = 80  # blocks, for the spectrum of the motion
BESIDE = 0.05  # of what laws do not see outside of the band, or of what is folded into it, that it moves by
STILL = 1.0  # the same below which the slow displacement is left as it is


@dataclass(frozen=True, slots=True)
class WorkingPoint:
    """A fitted model on a record. kL, c, S : (places,); nu : (places,) sensor noise PSD, in its unit^2/Hz, over S.

    force, spectra and gram are those before the last step of the fit, which is a fraction of a standard deviation.
    """

    data: MotionBlocks
    kL: Array
    c: Array
    S: Array
    nu: Array
    placed: tuple[Placed, ...]
    force: Series  # (places, n) N, inferred excitation
    weighing: Weighing
    spectra: dict[int, Spectrum]  # of the force
    terms: tuple[Term, ...]
    columns: Columns
    gram: Gram
    jacobian: Jacobian
    fit: PathFit
    caution: Array  # (terms,) information that keeps searched parameters near, in every fit about this point
    A: NDArray[np.complex128]  # (bins, places, places)
    slopes: Array  # (places, places, 2) mean tangent
    fluctuations: tuple[Fluctuation | Probe | None, ...]  # by place, of the laws of the model
    spans: Spans  # of the model's own columns, by place

    @property
    def lin(self) -> Array:
        """(places, 3) m, kL, c."""
        return np.stack([self.data.mass, self.kL, self.c], axis=1)

    @property
    def bearing_force(self) -> Array:
        """(places,) N rms of the force in the bearing, k x + c v + effects, as the scale of what is missing, and
        weighed like it."""
        power = (self.force - self.data.known) ** 2
        if self.data.level is not None:
            power = power.reshape(len(power), self.data.blocks, -1).mean(axis=2) / self.data.level
        return np.asarray(np.sqrt(np.mean(power, axis=1)))

    def rowless(self) -> WorkingPoint:
        """Itself without rows, which are large: for a fit of another record to begin from."""
        none = np.zeros(self.data.x.shape[1], bool)
        data = self.data.at(none)
        return replace(self, data=data, force=self.force[:, none], weighing=replace(self.weighing, data=data))


def fit_model(
    data: MotionBlocks, uses: list[Placed], start: WorkingPoint | None = None, rounds: int = ROUNDS,
    moving: float = SETTLED,
) -> WorkingPoint:  # fmt: skip
    """Fit kL, c, S and every free parameter of the effects, from a start that needs no values of the linear part.

    moving : standard deviations by which the last of fewer than `rounds` steps may move.
    """
    P = len(data.places)
    data = without_comb(data, [use.effect for use in uses])
    if start is None:
        start = _approached(data, uses, rounds)
        uses, rounds = (uses, rounds) if start is None else (list(start.placed), LAST_ROUNDS)
    if start is None:
        kL, c, S = _first_linear(data)
        data = replace(data, left_out=left_out(data.mass, c, kL, S + data.driven, data.band, data.rate_hz, data.kinds))
        nu = np.zeros(P)
        data = _calmed(data, nu, S)
    else:
        kL, c, nu, S = start.kL.copy(), start.c.copy(), start.nu.copy(), start.S
        if start.data is not data:
            data = _calmed(replace(data, left_out=start.data.left_out), nu, start.S)
        if {u.key for u in uses} - {u.key for u in start.placed}:  # a strong law takes over much of kL and c
            kL, c, _ = _first_linear(data, uses, start.lin)
    moved = np.full(1, np.inf)
    while True:
        data = data if moved.max(initial=0.0) < STILL else with_slow(data, kL, c, uses)
        point = _at(data, kL, c, nu, S, uses)
        S_old, S = S, point.S
        moved = np.abs(point.fit.delta) / np.sqrt(np.diag(point.fit.covariance))
        moved = moved[: moved.size - 2 * len(data.shared) - len(data.waves)]
        kL, c, uses = _moved(point, kL, c)
        nu_old, (nu, weight) = nu, noise_of(point)
        settled = np.allclose(nu * weight, nu_old * weight, rtol=NOISE_STEP, atol=NOISE_STEP * LEAST_NOISE)
        settled &= not data.folded.any() or np.allclose(S, S_old, rtol=BESIDE)
        folded, force = _folded_beside(point)
        if not np.allclose(folded, data.folded_beside, rtol=BESIDE, atol=0.0):
            data, settled = replace(data, folded_beside=folded, alike_beside=force), False
        data = data if settled else _calmed(data, nu, point.S)
        beside = _left_out(point)
        if not np.allclose(beside, data.left_out, rtol=BESIDE, atol=0.0):
            data, settled = replace(data, left_out=beside), False
        level = _level(point)
        if not alike(level, data.level):
            data, settled = replace(data, level=level), False
        shaken = any(isinstance(f, Probe) for f in point.fluctuations)
        if rounds == 0 or (moved.max(initial=0.0) < (max(SHAKEN, moving) if shaken else moving) and settled):
            return replace(point, kL=kL, c=c, placed=tuple(uses))
        rounds -= 1
        del point  # its columns are large: let go before the next are made


def glanced(data: MotionBlocks, uses: list[Placed]) -> WorkingPoint:
    """The same with one step on the whole record where a part of it is enough to begin from: to look at its force."""
    data = without_comb(data, [use.effect for use in uses])
    start = _approached(data, uses)
    if start is None:
        return fit_model(data, uses)
    point = fit_model(data, list(start.placed), start, rounds=0)
    return replace(point, nu=noise_of(point)[0])


def _approached(data: MotionBlocks, uses: list[Placed], rounds: int = ROUNDS) -> WorkingPoint | None:
    """The model fitted to a part of a long record, and by a step each to longer ones where a step is dear; None for a
    short record."""
    lin = np.stack([data.mass, *np.ones((2, len(data.places)))], axis=1)
    dear = any(remembers(u, lin[u.at[0]]) for u in uses)
    start, seconds = None, FIRST_SECONDS
    while (start is None or dear) and (part := part_of(data, seconds)) is not data:
        start = fit_model(part, uses, start, rounds if start is None else 0, NEARLY)
        uses, seconds = list(start.placed), LEAP * seconds
    return start


def thinned(point: WorkingPoint, seconds: float) -> WorkingPoint:
    """The same model on part of the record: for searching, and for pictures."""
    part = part_of(point.data, seconds)
    return point if part is point.data else _at(part, point.kL, point.c, point.nu, point.S, list(point.placed), point)


def plain(point: WorkingPoint, seconds: float) -> WorkingPoint:
    """The same on part of the record for a quick search, far from where it ends: no law is dressed by the others, as
    what dresses it holds for small steps of theirs only."""
    remembering = {u.name(k) for u in point.placed if u.effect.kind == "memory" for k in range(u.p.size)}
    bare = tuple(t if t.name in remembering else replace(t, memory={}) for t in point.terms)
    longer = replace(point, terms=bare, fluctuations=(None,) * len(point.fluctuations))
    return _at(part_of(point.data, seconds), point.kL, point.c, point.nu, point.S, list(point.placed), longer)


def _first_linear(
    data: MotionBlocks, uses: Sequence[Placed] = (), lin: Array | None = None
) -> tuple[Array, Array, Array]:
    """kL by least squares (consistent: E[a v] = 0 leaves it alone), c from the power balance S = 4 c m E[v^2], S.

    uses : laws whose force, at (places, 3) m, kL, c, is known beside.
    """
    kL, c, powers = np.zeros((3, len(data.places)))
    for i in range(len(data.places)):
        x, v = data.x[i], data.v[i]
        known = data.known[i]
        for use in uses:
            if i in use.at and lin is not None:
                known = known + evaluate(use, data, i, lin)[0]
        kL[i] = -np.dot(x, known) / np.dot(x, x)
        f = (known + kL[i] * x).reshape(data.blocks, data.block)[:: max(1, data.blocks // 40)]
        power = np.mean(np.abs(np.fft.rfft(f * np.hanning(data.block), axis=1)) ** 2, axis=0)[data.bins]
        S = float(np.median(power)) * 2 / (data.rate_hz * data.block * 0.375)
        c[i] = (S + data.driven[i]) / (4 * data.mass[i] * np.mean(v * v))
        powers[i] = S
    return kL, c, powers


def _forces(
    data: MotionBlocks, kL: Array, c: Array, uses: list[Placed], made: list[list[Term]]
) -> tuple[Series, NDArray[np.complex128], Array]:
    """Inferred force (places, n), A (bins, places, places) and the mean tangent (places, places, 2).

    made : the terms of each use.
    """
    P = len(data.places)
    F = np.empty_like(data.x)
    M = np.zeros_like(data.shaft)
    D = np.zeros((P, P, 2))
    D[np.arange(P), np.arange(P), 0] = kL
    D[np.arange(P), np.arange(P), 1] = c
    lin = np.stack([data.mass, kL, c], axis=1)

    def add(i: int) -> None:
        F[i] = data.known[i]
        add_to(F[i], kL[i], data.x[i])
        add_to(F[i], c[i], data.v[i])
        for use, own in zip(uses, made, strict=True):
            if i not in use.at:
                continue
            amplitudes = [k for k, q in enumerate(use.effect.parameters) if q.linear]
            units = {t.name: t for t in own}
            if amplitudes and use.effect.kind != "shaft" and all(use.name(k) in units for k in amplitudes):
                for k in amplitudes:
                    unit = units[use.name(k)]
                    add_to(F[i], use.p[k], unit.series[i])
                    D[i] += use.p[k] * unit.tangent[i]
                    if i in unit.memory:
                        M[:, i] += use.p[k] * unit.memory[i].T
                continue
            f, slope, memory = evaluate(use, data, i, lin)
            add_to(F[i], 1.0, f)
            D[i] += data.over_folds(slope)
            if memory is not None:
                M[:, i] += memory.T

    each(add, range(P))
    w = 2 * np.pi * data.f_hz[:, None, None]
    return F, np.diag(data.mass)[None] - (data.shaft + M + D[..., 0]) / w**2 + D[..., 1] / (1j * w), D


def tangent_at(point: WorkingPoint, f_hz: Array, shaft: NDArray[np.complex128] | None = None) -> NDArray[np.complex128]:
    """(f, places, places) force per acceleration at any frequency, memory effects left out."""
    w = 2 * np.pi * f_hz[:, None, None]
    D = point.slopes
    reaction = 0.0 if shaft is None else shaft
    return np.asarray(np.diag(point.data.mass)[None] - (reaction + D[..., 0]) / w**2 + D[..., 1] / (1j * w))


def _at(
    data: MotionBlocks, kL: Array, c: Array, nu: Array, S: Array, uses: list[Placed],
    longer: WorkingPoint | None = None,
) -> WorkingPoint:  # fmt: skip
    """The point at these values. longer : the same model on more of the record: what its laws fluctuate is kept."""
    P = len(data.places)
    lin = np.stack([data.mass, kL, c], axis=1)
    own = each(lambda use: terms(use, data, lin), uses)
    F, A, D = _forces(data, kL, c, uses, own)
    line = contour(A, data.mass, D, data.f_hz)
    paths = noise_paths(data, A, nu, S)
    weighing = Weighing(data, paths, line.s, paths.measured(along(line.s, A, data.mass, D)))
    spectra = dict(enumerate(each(lambda i: weighing.spectrum(i, F[i]), range(P))))
    mean = mean_responses(data.mass, D, data.places, data.disc)
    around = fluctuations(data, uses, mean, lin) if longer is None else longer.fluctuations
    made = [t for i in range(P) for t in linear_terms(data, i, lin[i], uses)]
    if longer is None:
        own = each(lambda k: dressed(own[k], uses[k], around), range(len(uses)))
    else:
        own = each(lambda k: _as_longer(own[k], uses[k], longer), range(len(uses)))
    made += [t for ts in own for t in ts]
    made += each(lambda wave: _wave(data, wave), data.waves)
    made += [_follows(data, F, i, j) for pair in data.shared for i, j in (pair, pair[::-1])]
    columns = weighing.columns(made)
    G = gram(weighing, spectra, columns)
    dressing = np.zeros((len(A), P), complex)
    for i, here in enumerate(around):
        if here is not None:
            dressing[:, i] = here.whole / (2 * np.pi * data.f_hz) ** 2
            A[:, i, i] += dressing[:, i]
    there = (1j * line.s.imag / line.s) ** 2  # over -w^2 becomes over s^2
    kept = None if weighing.rings is None else weighing.rings.kept.mean(axis=0)
    jacobian = Jacobian(along(line.s, A, data.mass, D), line.offset, dressing * there[:, None], kept)
    caution = _caution(data, G, uses)
    result = _cautious(G, jacobian, data.fold_blocks, caution)
    kept = tuple(light(t) for t in made)
    return WorkingPoint(
        data,
        kL,
        c,
        _whole_power(data, result),
        nu,
        tuple(uses),
        F,
        weighing,
        spectra,
        kept,
        columns,
        G,
        jacobian,
        result,
        caution,
        A,
        D,
        tuple(here and here.coarse(data.rate_hz, about) for here, about in zip(around, mean, strict=True)),
        Spans(kept),
    )


def _as_longer(own: list[Term], use: Placed, longer: WorkingPoint) -> list[Term]:
    """The terms of a use on part of a record, dressed as on all of it.

    A law that remembers answers as it does here at these values: with the answer from before the last step, a fifth of
    a standard deviation off, force and determinant do not balance, and a complete model gained 27 nats by its level.
    """
    known = {t.name: t.memory for t in longer.terms}
    there = [t for t in own if t.name in known]
    if any(remembers(use, longer.lin[i]) and longer.fluctuations[i] is not None for i in use.at):
        return dressed(there, use, longer.fluctuations)
    return [replace(t, memory=known[t.name]) for t in there]


def _caution(data: MotionBlocks, G: Gram, uses: list[Placed]) -> Array:
    """(terms,) prior information, scaled: the columns of searched parameters are tangents, and hold near by. A weak
    law's are free to run far off; of a strong one's a tenth of a standard deviation is lost."""
    caution = np.zeros(len(G.names))
    for use in uses:
        for k, q in enumerate(use.effect.parameters):
            far = STRIDE * reach(use, k, data)
            if not q.linear and far > 0.0 and use.name(k) in G.names:
                j = G.names.index(use.name(k))
                caution[j] = (G.scales[j] / far) ** 2
    return caution


def _cautious(G: Gram, jacobian: Jacobian, blocks: Array, caution: Array) -> PathFit:
    """The fit with its step in searched parameters kept short, and what goes with them."""
    everything = np.arange(FOLDS)
    result = fit(G, jacobian, everything, blocks)
    if not caution.any():
        return result
    return replace(fit(G, jacobian, everything, blocks, ridge=caution), covariance=result.covariance)


def _follows(data: MotionBlocks, F: Series, i: int, j: int) -> Term:
    """What the unknown force at place i has in common with that at j, as a column. With it the rest of F_i is
    independent of F_j and of all motion that F_j makes; the determinant does not change."""
    P = len(data.places)
    rms = max(float(F[j].std()), 1e-300)
    return light(Term(f"{data.places[i]}.follows.{data.places[j]}", "1", {i: F[j]}, np.zeros((P, P, 2)), 1.0 / rms))


def _wave(data: MotionBlocks, wave: Wave) -> Term:
    """What the amplitude of a periodic force may be off by, as a column. Without it a wrong one moves k and c, which
    are then as wrong as the line about a resonance."""
    P = len(data.places)
    made = wave.series(data.t, data.phase)
    rms = max(float(np.std(z)) for z in made.values())
    return light(Term(wave.name, wave.unit, made, np.zeros((P, P, 2)), 1.0 / max(rms, 1e-300)))


def _whole_power(data: MotionBlocks, fit: PathFit) -> Array:
    """(places,) S of the whole unknown forces: the rest that the columns above leave is 1 - rho^2 of it."""
    S = fit.S.copy()
    for i, j in data.shared:
        there, back = (fit.value(f"{data.places[a]}.follows.{data.places[b]}")[0] for a, b in ((i, j), (j, i)))
        S[[i, j]] /= max(1.0 - there * back, 1e-6)
    return S


def _moved(point: WorkingPoint, kL: Array, c: Array) -> tuple[Array, Array, list[Placed]]:
    """Values after the increments of the fit, searched parameters kept inside their limits."""
    step = dict(zip(point.fit.names, point.fit.delta * point.fit.scales, strict=True))
    places = point.data.places
    least = np.where(point.data.driven > 0.0, LEAST_LEFT * kL, -np.inf)  # a known force forgives no step too far
    kL = np.maximum(kL + np.array([step[f"{p}.kL"] for p in places]), least)
    c = c + np.array([step[f"{p}.c"] for p in places])
    uses = []
    for use in point.placed:
        p, i = use.p.copy(), use.at[0]
        natural = size(point.data, i, kL[i] if kL[i] > 0.0 else stiffness(point.data, i))  # of a step too far
        for k, q in enumerate(use.effect.parameters):
            new = p[k] + step.get(use.name(k), 0.0)
            if not q.linear:
                low, high = search_range(q, natural)
                new = float(np.clip(new, min(low, p[k]), max(high, p[k])))
            p[k] = new
        uses.append(use.with_values(p))
    return kL, c, uses


def _level(point: WorkingPoint) -> Array | None:
    """(places, blocks) how strong the unknown forces are along the record: force_level.py."""
    data, weighing = point.data, point.weighing
    if data.measured_force:
        return None

    def power(i: int) -> Array:
        own, noise = weighing.power(i, point.spectra[i]), point.S[i] * weighing.paths.noise[i].sum()
        return np.asarray(np.maximum(own - noise, 0.1 * own))

    return level_of(np.array(each(power, range(len(data.places)))), data.start / data.rate_hz, data.bins.size)


def _left_out(point: WorkingPoint) -> Array:
    """(places, 2) sd of the displacement and velocity that laws do not see; as it was where the fit is far off."""
    data = point.data
    kL, c = np.einsum("iik->ki", point.slopes)
    if not (np.all(kL > 0.0) and np.all(c > 0.0)):
        return data.left_out
    return left_out(data.mass, c, kL, point.S + data.driven, data.band, data.rate_hz, data.kinds)


def _calmed(data: MotionBlocks, nu: Array, S: Array) -> MotionBlocks:
    """The record as laws see it beside the noise of sensors; where a force is measured, of what is folded beside it."""
    noise = as_displacement(data.kinds, data.f_hz, nu * S) * data.sharpened
    inside = np.array([kind != "displacement" for kind in data.kinds]) * S
    noise = noise + data.folded * inside[:, None] / (2 * np.pi * data.f_hz) ** 4
    if data.measured_force:
        noise = data.folded_beside / (2 * np.pi * data.f_hz) ** 4
    if is_little(data.f_hz, noise, data.rms[0] ** 2):
        return replace(data, calm=None, doubt=0.0)
    found = calm_of(data.f_hz, _spectrum(data), noise, 0)
    return replace(data, calm=found.of(data.x, data.rate_hz).astype(np.float32), doubt=found.doubt)


def _folded_beside(point: WorkingPoint) -> tuple[Array, NDArray[np.complex128]]:
    """(places, bins) PSD of the acceleration that is folded beside a measured force, and the force that goes with it:
    folded_force.py."""
    data = point.data
    out, force = np.zeros_like(data.colour), np.zeros(data.colour.shape, complex)
    for i in np.flatnonzero(data.driven):
        r = response_of(point, int(i), every=max(1, data.blocks // LOOKED_AT))
        if np.any(r.folded):
            hz = r.w / (2 * np.pi)
            out[i] = np.interp(data.f_hz, hz, r.folded)
            force[i] = np.interp(data.f_hz, hz, r.alike)
    return out, force


def _spectrum(data: MotionBlocks) -> Array:
    """(places, bins) one-sided PSD of the displacement, m^2/Hz, of some of the blocks."""
    some = data.x.reshape(len(data.places), data.blocks, -1)[:, :: max(1, data.blocks // LOOKED_AT)]
    return np.array([spectrum(x.ravel(), data.block, data.rate_hz)[1][data.bins] for x in some])
