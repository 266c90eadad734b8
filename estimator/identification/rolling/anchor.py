"""The working point that a rolling fit counts its increments from, thinned to what the determinant needs.

The likelihood is that of a fit (`likelihood.path.path_fit`). It is exact for any increment of a parameter that the
force is linear in, so one anchor serves until the mean tangents of the laws change much. Of another parameter, such as
a gap, it holds for small increments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.path.working_point import WorkingPoint, point_at
from estimator.likelihood.response.regressor_set import (
    Regressor,
    regressor_response,
    regressors,
    tangent_response,
    with_second_order,
)
from estimator.likelihood.whitening.contour import modes_at
from estimator.likelihood.whitening.determinant import Jacobian, line_weights, tangent_times
from estimator.likelihood.whitening.whitening import Whitening

from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """A working point with k parameters, without its time series.

    data : the record of the point without rows. kL, c, S : (places,) values. nu : (places,) sensor noise over S.
    placed : laws with values. watched : candidate laws at amplitude 0. names, units : (k,) of the parameters, then of
    the amplitudes of the candidates. own : k. scales : SI units per scaled unit, of all names. whitening : of the
    residual force. nodes : (nodes,) numbers of the bins that the determinant is evaluated at. first : (nodes,) first
    bin that each stands for. phase_weight : (nodes,) of the phase of the determinant in its sum. A, s : (nodes,
    places, places) kg and (nodes,) rad/s. second_order : (nodes, places) part of A. responses : (all names, places,
    places, nodes) response of each scaled regressor. tangents : (all names, places, places, 2) its mean tangent.
    mean_tangent : (places, places, 2) of all forces. cells : (cells,) first bin of each cell of frequency.
    """

    data: MotionRecord
    kL: Array
    c: Array
    S: Array
    nu: Array
    placed: tuple[LocatedLaw, ...]
    watched: tuple[LocatedLaw, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    own: int
    scales: Array
    whitening: Whitening
    nodes: NDArray[np.int64]
    first: NDArray[np.int64]
    phase_weight: Array
    A: Complexes
    s: Complexes
    second_order: Complexes
    responses: Complexes
    tangents: Array
    prior: Array
    mean_tangent: Array
    cells: NDArray[np.int64]

    @property
    def lin(self) -> Array:
        """(places, 3) mass kg, kL N/m, c N s/m."""
        return np.stack([self.data.mass, self.kL, self.c], axis=1)

    @property
    def bins(self) -> int:
        """Number of bins."""
        return int(self.data.bins.size)

    @property
    def cell_slices(self) -> list[slice]:
        """The bins of every cell."""
        ends = np.append(self.cells[1:], self.bins).tolist()
        return [slice(a, b) for a, b in zip(self.cells.tolist(), ends, strict=True)]

    @property
    def kept(self) -> Array:
        """(places, bins) share of each bin in the likelihood."""
        leakage = self.whitening.leakage
        return np.ones((len(self.data.places), self.bins)) if leakage is None else leakage.kept

    @property
    def value_of(self) -> dict[str, float]:
        """The value of every parameter by full name, SI."""
        out = {f"{p}.kL": float(z) for p, z in zip(self.data.places, self.kL, strict=True)}
        out |= {f"{p}.c": float(z) for p, z in zip(self.data.places, self.c, strict=True)}
        out |= {f"{p}.m": float(z) for p, z in zip(self.data.places, self.data.mass, strict=True)}
        return out | {use.name(k): float(z) for use in self.placed for k, z in enumerate(use.p)}

    def response(self, tangent: Array) -> Complexes:
        """(..., places, places, nodes) kg, what a mean tangent (..., places, places, 2) adds to A."""
        out = tangent_response(tangent, self.s)
        background = self.data.background
        return out if background is None else out * background.deflections(self.data.places, self.s).T

    def problem(self, mean_tangent: Array, tangents: Array, share: Array) -> tuple[Jacobian, Complexes]:
        """The determinant at mean tangents other than those of the anchor, and the responses of the regressors.

        mean_tangent : (places, places, 2). tangents : (m, places, places, 2) of the first m names, scaled. share :
        (bins,) of each bin.
        """
        m = len(tangents)
        moved, factor = tangents - self.tangents[:m], self.whitening.measured
        responses = self.responses[:m].copy()
        size = np.abs(self.tangents[:m]).max(axis=(1, 2, 3), initial=0.0)
        some = np.flatnonzero(np.abs(moved).max(axis=(1, 2, 3), initial=0.0) > LIMITS.rounding_rel * size)
        if some.size:
            more = tangent_response(moved[some], self.s)
            responses[some] += more if factor is None else tangent_times(more, factor[self.nodes])
        A = self.A + np.moveaxis(self.response(mean_tangent - self.mean_tangent), 2, 0)
        weight = np.add.reduceat(share, self.first)
        return Jacobian(A, 2.0 * weight + 1j * self.phase_weight, self.second_order), responses


def anchor_at(
    data: MotionRecord, kL: Array, c: Array, nu: Array, S: Array, placed: Sequence[LocatedLaw],
    watched: Sequence[LocatedLaw] = (), old: Anchor | None = None,
) -> Anchor:  # fmt: skip
    """The anchor of a model at given values on a record. Arguments as of `point_at`. Raises NotFiniteError.

    old : the anchor before this one. The responses of the candidates stay as they were there, as they are dear; only
    their mean tangents follow the motion.
    """
    point = point_at(replace(data, level=None), kL, c, nu, S, list(placed))
    whitening, own = point.whitening, point.regressors
    first, nodes = _nodes(point)
    if old is not None and np.array_equal(old.s, whitening.s[old.nodes]):
        first, nodes = old.first, old.nodes
        names, units, scales = old.names[old.own :], old.units[old.own :], old.scales[old.own :]
        tangents, more = old.tangents[old.own :], old.responses[old.own :]
    else:
        made = _candidate_regressors(point, watched)
        names, units = tuple(t.name for t in made), tuple(t.unit for t in made)
        scales = np.array([t.scale for t in made])
        P = len(data.places)
        tangents = np.array([t.tangent * t.scale for t in made]).reshape(-1, P, P, 2)
        whole = np.array([regressor_response(t, whitening.s) for t in made]).reshape(-1, P, P, whitening.s.size)
        more = whitening.tangents_to_measured(whole)[..., nodes]
    cells = np.unique(np.geomspace(1, point.data.bins.size, LIMITS.frequency_cells + 1).astype(np.int64) - 1)[:-1]
    none = np.zeros(point.data.x.shape[1], bool)
    bare = point.data.at(none)
    return Anchor(
        data=bare, kL=kL, c=c, S=S, nu=nu, placed=tuple(placed), watched=tuple(watched),
        names=tuple(t.name for t in own) + names, units=tuple(t.unit for t in own) + units, own=len(own),
        scales=np.concatenate([[t.scale for t in own], scales]),
        whitening=Whitening(data=bare, noise=whitening.noise, s=whitening.s, measured=whitening.measured), nodes=nodes,
        first=first, phase_weight=np.add.reduceat(line_weights(whitening.s).imag, first), A=point.jacobian.A0[nodes],
        s=whitening.s[nodes], second_order=point.jacobian.second_order[nodes],
        responses=np.concatenate([point.whitened.tangents[..., nodes], more]),
        tangents=np.concatenate([[t.tangent * t.scale for t in own], tangents]), prior=point.prior_information,
        mean_tangent=point.mean_tangent, cells=cells,
    )  # fmt: skip


def _candidate_regressors(point: WorkingPoint, watched: Sequence[LocatedLaw]) -> list[Regressor]:
    """The regressors of the amplitudes of candidate laws, with their second-order response."""
    out: list[Regressor] = []
    for use in watched:
        out += with_second_order(regressors(use, point.data, point.lin, True), use, point.fluctuations)
    return out


def _nodes(point: WorkingPoint) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First bin and middle bin of groups of bins: small where the determinant is steep, and of one bin where its line
    leaves the imaginary axis or returns."""
    data, f, real = point.data, point.data.f_hz, point.whitening.s.real[:, None]
    w, spacing = 2 * np.pi * f, data.rate_hz / data.block
    stiffness = np.einsum("iik->ik", point.mean_tangent)[:, 0]
    resonances = np.sqrt(np.maximum(stiffness / data.mass, w[0] ** 2))
    near = {int(np.argmin(np.abs(w - one))) for one in resonances}
    modes = np.concatenate([modes_at(point.A[k], data.mass, 1j * w[k], data.rotor) for k in sorted(near)])
    away = np.abs(f[:, None] - modes.imag / (2 * np.pi)) / LIMITS.nodes_per_distance
    allowed = np.maximum(away, np.abs(real - modes.real) / np.pi / LIMITS.nodes_per_width).min(axis=1) / spacing
    bend = np.flatnonzero(np.diff(real[:, 0]))
    allowed[np.concatenate([bend, bend + 1])] = 1.0
    if data.background is not None:  # structural modes are steep too
        allowed[:] = 1.0
    ends = np.append(np.flatnonzero(np.diff(data.bins) > 1) + 1, f.size)
    first, k = [], 0
    while k < f.size:
        end = int(ends[np.searchsorted(ends, k, side="right")])
        step = int(min(allowed[k : min(k + max(1, int(allowed[k])), end)].min(), end - k))
        step = max(1, step - (step + 1) % 2)  # odd: a bin is in the middle
        first.append(k)
        k += step
    starts = np.array(first, np.int64)
    return starts, (starts + np.append(starts[1:], f.size) - 1) // 2
