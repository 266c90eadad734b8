"""What fluctuating laws do to the mean response where one of them remembers: by a small random force on the path.

A law that remembers has no tangent at an instant but a response T to the displacement before. As in self_energy.py the
likelihood needs <T_j G>, G the response of the motion linearised along the path, and the mean of a product is not the
product of the means. With K = sum beta_k T_k - <T_k> of all laws at the place, G0 the mean response, and a white force
e on the path as it was measured,

    x0 = G0 e,   x' = -G0 K (x0 + x')  (by iteration),
    G = G0 (1 - < K x' e >),   Sigma_j = -< (T_j - <T_j>) x' e > / G.

What x0 itself adds has no mean, so it is left out, and with it most of the scatter of a random probe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from . import linear_memory
from .effects.compiled import remembered
from .hidden_states import MeanResponse, response_along
from .motion_blocks import MotionBlocks, coarser
from .placed import Placed, tangent_series
from .self_energy import Mean

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
ROUNDS = 2  # of the response: more change nothing
SIZE = 0.02  # of the probe's largest motion over the path's rms: enough to smooth kinks
ABOVE = 0.22  # of the finer rate: up to where the probe is white, below half the rate of the record
SHARE, LEAST = 0.25, 4.0  # of a record that a probe goes along, and s of it at least: its scatter beside the record's
STRONG = 2.0  # rms of x' over that of x0, above which the iteration may not end


@dataclass(frozen=True, slots=True)
class Probe:
    """Of one place. data : the part of the record it was sent along. motion : (2, n) x' and v' of it.

    sent : spectrum of e (n // 2 + 1,), of level 1; lags : rows after which an answer has died out. f_hz, G : (bins,)
    m/N. whole : (bins,) N/m, Sigma of all laws together. lin : (3,) m, kL, c.
    """

    data: MotionBlocks
    place: int
    lin: Array
    motion: Array
    sent: Complexes
    lags: int
    f_hz: Array
    G: Complexes
    whole: Complexes

    def of(self, tangents: NDArray[np.floating]) -> Complexes:
        """(bins,) N/m per unit: Sigma of a law with tangents (2, n) along x and v on `data`."""
        mean = tangents.mean(axis=1, dtype=np.float64)
        force = (tangents[0] - mean[0]) * self.motion[0] + (tangents[1] - mean[1]) * self.motion[1]
        return self._sigma(rfft(force))

    def of_memory(self, placed: Placed, p: Array) -> Complexes | float:
        """The same of a law that remembers."""
        if not remembers(placed, self.lin):
            return 0.0
        law = _Law.along(placed, p, self.data, self.place, self.lin)
        f: Array = np.asarray(np.fft.rfftfreq(self.motion.shape[1], 1.0 / self.data.rate_hz), dtype=np.float64)
        return self._sigma(rfft(law.moved(self.motion)) - law.mean.at(f) * rfft(self.motion[0]))

    def coarse(self, rate_hz: float) -> Probe:
        """The same at the rate of the record: enough for laws without jumps."""
        by = round(self.data.rate_hz / rate_hz)
        if by == 1:
            return self
        motion = np.ascontiguousarray(self.motion[:, ::by])
        sent = self.sent[: motion.shape[1] // 2 + 1] / by
        return replace(self, data=coarser(self.data, by), motion=motion, sent=sent, lags=self.lags // by)

    def _sigma(self, force: Complexes) -> Complexes:
        return np.asarray(-_answer(force, self.sent, self.data.rate_hz, self.lags, self.f_hz) / self.G)


def remembers(placed: Placed, lin: Array) -> bool:
    """Whether a law has a memory that obeys no linear equations."""
    return placed.effect.kind == "memory" and linear_memory.response(placed.effect, placed.p, lin) is None


@dataclass(frozen=True, slots=True)
class _Law:
    """A law that remembers, along a path: its force (n,) there and its mean response. size : m, rms of the path."""

    placed: Placed
    p: Array
    lin: Array
    path: tuple[Array, Array]
    rate_hz: float
    size: float
    force: Array
    mean: MeanResponse

    @classmethod
    def along(cls, placed: Placed, p: Array, data: MotionBlocks, i: int, lin: Array) -> Self:
        path = data.x[i], data.v[i]
        known = remembered(placed.effect, p, lin, *path, data.rate_hz)
        mean = response_along(placed.effect, p, lin, *path, data.rate_hz, known)
        return cls(placed, p, lin, path, data.rate_hz, float(data.rms[0, i]), known[0], mean)

    def moved(self, motion: Array) -> Array:
        """(n,) N: what a small motion (2, n) beside the path does to the force."""
        most = float(np.abs(motion[0]).max())
        if most == 0.0:
            return np.zeros_like(self.force)
        size = SIZE * self.size / most
        x, v = (a + size * b for a, b in zip(self.path, motion, strict=True))
        return np.asarray((remembered(self.placed.effect, self.p, self.lin, x, v, self.rate_hz)[0] - self.force) / size)


def probed(
    data: MotionBlocks, f_hz: Array, i: int, uses: Sequence[Placed], mean: Mean, lin: Array
) -> Probe | None:  # fmt: skip
    """Of place i with the laws `uses` on finer data; None where they are too strong. f_hz : what is asked for.

    mean : mean response, the laws included that remember nothing.
    """
    n, rate = data.x.shape[1], data.rate_hz
    laws = [_Law.along(u, u.p, data, i, lin) for u in uses if remembers(u, lin)]
    others = [u for u in uses if u.effect.kind == "memory" and not remembers(u, lin)]
    linear = [r for u in others if (r := linear_memory.response(u.effect, u.p, lin)) is not None]
    tangents = np.zeros((2, n))
    for use in uses:
        if use.effect.kind == "force":
            tangents += tangent_series(use, data, i, use.p)
    tangents -= tangents.mean(axis=1, keepdims=True)

    def remembering(w: Array) -> Complexes:
        return np.asarray(sum(q.mean.at(w / (2 * np.pi)) for q in laws))

    def stiffness(w: Array) -> Complexes:
        return np.asarray(mean.k + 1j * w * mean.c - mean.m * w**2 + sum(r(w) for r in linear) + remembering(w))

    peak = np.array([np.sqrt(mean.k / mean.m)])
    damping = float(stiffness(peak)[0].imag / peak[0])
    if not 0.0 < damping < np.sqrt(mean.k * mean.m):
        return None
    lags = Mean(mean.m, damping, mean.k).lags(1.0 / rate, data.block)
    w: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(n, 1.0 / rate), dtype=np.float64)
    iw, D, T = 1j * w, stiffness(w), remembering(w)

    def motion(X: Complexes) -> Array:
        return np.asarray(irfft(np.stack([X, iw * X]), n, axis=1))

    def pushed(X: Complexes) -> Complexes:
        """Spectrum of K on a motion with spectrum X of its displacement."""
        small = motion(X)
        return np.asarray(rfft(np.sum([q.moved(small) for q in laws], axis=0) + (tangents * small).sum(axis=0)) - T * X)

    E = np.sqrt(n) * np.exp(2j * np.pi * np.random.default_rng(i).random(w.size))
    E[w > 2 * np.pi * ABOVE * rate] = 0.0
    first, more = E / D, np.zeros(w.size, complex)
    for _ in range(ROUNDS):
        more = -pushed(first + more) / D
    if not np.linalg.norm(more) < STRONG * np.linalg.norm(first):
        return None
    answer = _answer(pushed(more), E, rate, lags, f_hz)
    G = (1.0 - answer) / stiffness(2 * np.pi * f_hz)
    return Probe(data, i, lin, motion(more), E, lags, f_hz, G, np.asarray(-answer / G))


def _answer(force: Complexes, sent: Complexes, rate_hz: float, lags: int, f_hz: Array) -> Complexes:
    """(bins,) mean response of a force to what was sent, both spectra of a whole series, up to so many lags."""
    white = np.vdot(sent, sent).real / np.count_nonzero(sent)
    weight = np.exp(-((np.arange(lags) / (0.8 * lags)) ** 8))
    answer = irfft(force * sent.conj() / white)[:lags] * weight
    f, z = np.fft.rfftfreq(2 * lags, 1.0 / rate_hz), np.fft.rfft(answer, 2 * lags)
    return np.asarray(np.interp(f_hz, f, z.real) + 1j * np.interp(f_hz, f, z.imag))
