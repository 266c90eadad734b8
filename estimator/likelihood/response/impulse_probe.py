"""What fluctuating laws do to the mean response where one of them remembers: by impulses of force along the path.

A law that remembers has no tangent at an instant but a response T to the displacement before. As in self_energy.py the
likelihood needs <T_j G>, G the response of the motion linearised along the path, and the mean of a product is not the
product of the means. Impulses of force are launched all along the path as it was measured, and what each does to the
motion is followed through the tangents of all laws at the place. With x the answer to one of them, a time tau after it,
and x' = x - <x>, the mean over the impulses,

    G = FT <x>,   <T_j G> = <T_j> G + FT < T_j x' >,   so that   Sigma_j = - FT < T_j x' > / G.

What T_j makes of <x> scatters about <T_j> <x>, which memory_law.py and located_law.py know from the whole path: it is
left out, and with it most of the scatter. On a stiff shaft the disc may ring twenty times as long as the cap, and an
answer is followed as long: impulses are apart by what the cap forgets in all the same. With sixteen series, 31 of them,
4 % of the bearing force was missing of a complete model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.located_law import LocatedLaw, has_nonlinear_memory, tangent_series
from estimator.likelihood.motion.memory_law import LinearisedMemory, force_along_path, stacked_states
from estimator.likelihood.motion.motion_record import MotionRecord, decimated_record

from .modal_response import ModalResponse

RECORD_SHARE, MIN_RECORD_S = 0.08, 2.0  # of a record along which impulses are launched
IMPULSE_DISTANCE_DECAYS, IMPULSE_SERIES = (
    0.375,
    (16, 48),
)  # decays between impulses; series launched one after the other
TO_COME = np.exp(-10.0)  # of the power of an answer, to where it is followed: five decays
MAX_POWER_LEFT = 0.1  # power of the last eighth of a response over that of the first, above which it does not decay
ROWS_PER_PIECE = 1 << 14


@dataclass(frozen=True, slots=True)
class Probe:
    """Of one place. data : the part of the record that impulses were sent along. motion : (2, series, n) x' and v'.

    lags : rows after which an answer is let go. f_hz, G : (bins,) m/N. whole : (bins,) N/m, Sigma of all laws together.
    lin : (3,) m, kL, c.
    """

    data: MotionRecord
    place: int
    lin: Array
    motion: NDArray[np.float32]
    lags: int
    f_hz: Array
    G: Complexes
    whole: Complexes

    def of(self, tangents: NDArray[np.floating]) -> Complexes:
        """(bins,) N/m per unit: Sigma of a law with tangents (2, n) along x and v on `data`."""
        return self._sigma(_moved(tangents, self.motion, self.lags))

    def of_memory(self, placed: LocatedLaw, p: Array) -> Complexes | float:
        """The same of a law that remembers."""
        if not has_nonlinear_memory(placed, self.lin):
            return 0.0
        sums, carried = np.zeros(self.lags), np.zeros((self.motion.shape[1], placed.effect.states))
        for a, law in _pieces([(placed, p)], self.data, self.place, self.lin):
            _remembered(law.step, law.force, self.motion, self.lags, a, carried, sums)
        return self._sigma(sums / _impulses(self.motion, self.lags))

    def shorter(self, seconds: float) -> Probe:
        """The same: impulses were sent along all of it."""
        return self

    def coarse(self, rate_hz: float, mean: ModalResponse) -> Probe:
        """The same at the rate of the record: enough for laws without jumps."""
        by = round(self.data.rate_hz / rate_hz)
        if by == 1:
            return self
        motion = np.ascontiguousarray(self.motion[..., ::by])
        return replace(self, data=decimated_record(self.data, by), motion=motion, lags=self.lags // by)

    def _sigma(self, force: Array) -> Complexes:
        return np.asarray(-_transform(force, self.data.rate_hz, self.f_hz) / self.G)


def probed(
    data: MotionRecord, f_hz: Array, i: int, uses: Sequence[LocatedLaw], mean: ModalResponse, lin: Array
) -> Probe | None:  # fmt: skip
    """Of place i with the laws `uses` on finer data; None where an answer does not die out. f_hz : what is asked for.

    mean : mean response, the laws included that remember nothing.
    """
    n, rate = data.x.shape[1], data.rate_hz
    tangents = np.zeros((2, n))
    for use in uses:
        if use.effect.kind == "force":
            tangents += tangent_series(use, data, i, use.p)
    tangents -= tangents.mean(axis=1, keepdims=True)
    laws = [(u, u.p) for u in uses if u.effect.kind == "memory"]
    lags = min(int(mean.over(TO_COME) * rate), n // 2)
    series = int(np.clip(np.ceil(lags / (IMPULSE_DISTANCE_DECAYS * mean.quick * rate)), *IMPULSE_SERIES))
    lags = lags // (2 * series) * 2 * series
    motion = np.zeros((2, series, n), np.float32)
    modes = np.zeros((series, mean.poles.size), complex)
    states = np.zeros((series, sum(u.effect.states for u, _ in laws)))
    free = mean.poles, mean.residues, np.exp(mean.poles / rate)
    for a, law in _pieces(laws, data, i, lin):
        _send(law.step, law.force, tangents, *free, 1.0 / rate, lags, a, modes, states, motion)
    answer = _centred(motion, lags)
    eighth = lags // 8
    if not np.sum(answer[-eighth:] ** 2) < MAX_POWER_LEFT * np.sum(answer[:eighth] ** 2):
        return None
    G = _transform(answer, rate, f_hz)
    probe = Probe(data, i, lin, motion, lags, f_hz, G, np.zeros_like(G))
    whole = probe.of(tangents) + sum(probe.of_memory(u, u.p) for u in uses)
    return replace(probe, whole=np.asarray(whole))


def _pieces(
    laws: Sequence[tuple[LocatedLaw, Array]], data: MotionRecord, i: int, lin: Array
) -> Iterator[tuple[int, LinearisedMemory]]:  # fmt: skip
    """First row and laws that remember, at parameters, linearised along the motion of place i, piece by piece.

    Where the path has a break they keep what they have come to: it is no motion.
    """
    dt = 1.0 / data.rate_hz
    starts, seen = [np.zeros(u.effect.states) for u, _ in laws], data.displacement(i)
    for stretch in data.stretches:
        for a in range(stretch.start, stretch.stop, ROWS_PER_PIECE):
            size = min(ROWS_PER_PIECE, stretch.stop - a)
            rows = np.minimum(np.arange(a, a + size + 1), stretch.stop - 1)  # one more: where the next piece begins
            found = []
            for q, (u, p) in enumerate(laws):
                _, states, about = force_along_path(u.effect, p, lin, seen[rows], data.v[i, rows], dt, starts[q])
                starts[q] = states[-1]
                found.append(about)
            law = stacked_states([q for q in found if q is not None])
            yield a, LinearisedMemory(law.step[:size], law.force[:size])


def _transform(answer: Array, rate_hz: float, f_hz: Array) -> Complexes:
    """(bins,) of an answer (lags,)."""
    lags = answer.size
    weight = np.exp(-((np.arange(lags) / (0.8 * lags)) ** 8)) / rate_hz
    f, z = np.fft.rfftfreq(4 * lags, 1.0 / rate_hz), np.fft.rfft(answer * weight, 4 * lags)
    return np.asarray(np.interp(f_hz, f, z.real) + 1j * np.interp(f_hz, f, z.imag))


def _impulses(motion: NDArray[np.float32], lags: int) -> int:
    """How many were launched, in all series, and followed to the end."""
    _, series, n = motion.shape
    return sum((n - s * lags // series) // lags for s in range(series))


@njit(cache=True, error_model="numpy", nogil=True)
def _send(step, force, tangents, poles, residues, flight, dt, lags, first, modes, states, motion):  # type: ignore[no-untyped-def]  # noqa: E501
    """Fill motion (2, series, rows) with the answers of a cap to impulses of force, one every `lags` rows in a series.

    Along rows `first` ... of the path, those of step and force. flight : (modes,) what a step makes of the modes
    without the laws that fluctuate or remember; these push once a step.
    """
    series, S = states.shape
    yields = 0.0  # 1 / kg
    for k in range(poles.size):
        yields += (poles[k] * residues[k]).real
    z, after, y = np.zeros(S), np.zeros(S), np.zeros(poles.size, np.complex128)
    for s in range(series):
        y[:] = modes[s]
        x = y.sum().real
        for j in range(S):
            z[j] = states[s, j]
        begun = s * lags // series
        phase = (first - begun - 1) % lags + 1  # rows since the last impulse: `lags` where one is due
        for r in range(len(force)):
            i = first + r
            if i < begun:
                continue
            if phase == lags or i == begun:
                phase, x = 0, 0.0
                y[:] = residues
                for j in range(S):
                    z[j] = 0.0
            v = 0.0
            for k in range(poles.size):
                v += poles[k].real * y[k].real - poles[k].imag * y[k].imag
            push = (tangents[0, i] + force[r, S]) * x + (tangents[1, i] + force[r, S + 1]) * v
            for j in range(S):
                push += force[r, j] * z[j]
            push *= dt
            motion[0, s, i] = x
            motion[1, s, i] = v - 0.5 * push * yields
            x1 = 0.0
            for k in range(poles.size):
                y[k] = flight[k] * (y[k] - push * residues[k])
                x1 += y[k].real
            mid, rise = 0.5 * (x + x1), x1 - x
            for j in range(S):
                after[j] = step[r, j, S] * mid + step[r, j, S + 1] * rise
                for k in range(S):
                    after[j] += step[r, j, k] * z[k]
            for j in range(S):
                z[j] = after[j]
            x = x1
            phase += 1
        modes[s] = y
        for j in range(S):
            states[s, j] = z[j]


@njit(cache=True, error_model="numpy", nogil=True)
def _centred(motion, lags):  # type: ignore[no-untyped-def]
    """Take the mean answer out of every one; it is returned, (lags,) m. What is not followed to its end is nothing."""
    _, series, n = motion.shape
    mean = np.zeros((2, lags))
    count = 0
    for s in range(series):
        begun = s * lags // series
        many = (n - begun) // lags
        count += many
        for c in range(2):
            motion[c, s, begun + many * lags :] = 0.0
            for q in range(many):
                for k in range(lags):
                    mean[c, k] += motion[c, s, begun + q * lags + k]
    mean /= count
    for s in range(series):
        begun = s * lags // series
        for c in range(2):
            for q in range((n - begun) // lags):
                for k in range(lags):
                    motion[c, s, begun + q * lags + k] -= mean[c, k]
    return mean[0]


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
def _moved(tangents, motion, lags):  # type: ignore[no-untyped-def]
    """(lags,) mean force of tangents (2, n) on the answers, by the time after their impulses."""
    _, series, n = motion.shape
    sums = np.zeros(lags)
    count = 0
    for s in range(series):
        begun = s * lags // series
        for q in range((n - begun) // lags):
            count += 1
            i = begun + q * lags
            for k in range(lags):
                sums[k] += tangents[0, i + k] * motion[0, s, i + k] + tangents[1, i + k] * motion[1, s, i + k]
    return sums / count


@njit(cache=True, error_model="numpy", nogil=True)
def _remembered(step, force, motion, lags, first, states, sums):  # type: ignore[no-untyped-def]
    """Add to sums (lags,) the force of states that were at rest when the impulses came, by the time after them."""
    series, S = states.shape
    z, after = np.zeros(S), np.zeros(S)
    n = motion.shape[2]
    for s in range(series):
        begun = s * lags // series
        end = begun + (n - begun) // lags * lags
        for j in range(S):
            z[j] = states[s, j]
        phase = (first - begun - 1) % lags + 1
        for r in range(len(force)):
            i = first + r
            if i < begun or i >= end:
                continue
            if phase == lags or i == begun:
                phase = 0
                for j in range(S):
                    z[j] = 0.0
            x, v = motion[0, s, i], motion[1, s, i]
            push = force[r, S] * x + force[r, S + 1] * v
            for j in range(S):
                push += force[r, j] * z[j]
            sums[phase] += push
            phase += 1
            if i + 1 < end:
                x1 = motion[0, s, i + 1]
                mid, rise = 0.5 * (x + x1), x1 - x
                for j in range(S):
                    after[j] = step[r, j, S] * mid + step[r, j, S + 1] * rise
                    for k in range(S):
                        after[j] += step[r, j, k] * z[k]
                for j in range(S):
                    z[j] = after[j]
        for j in range(S):
            states[s, j] = z[j]
