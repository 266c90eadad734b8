"""A rotor given by matrices: reduced to its bearings and discs, and as the measured bearing caps move it.

M a + C v + K x = force, over named degrees of freedom such as "bearing1.x", "disc.x" and others that are internal.
The bearings' own stiffness and damping are no part of it. The shafts `chain` and `beam` are such matrices too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, eigh

from estimator.arrays import Array, Complexes
from estimator.errors import ModelError

from .thresholds import LIMITS

Term = tuple[Array, Callable[[Array], Complexes]]


@dataclass(frozen=True, eq=False, kw_only=True)
class RotorMatrices:
    """Shaft with its discs, without its bearings.

    Parameters
    ----------
    dofs : tuple of str
        Names of the n degrees of freedom, such as "bearing1.x", "disc.x", "shaft1.x"; the last letter is the direction.
    bearings, discs : tuple of str
        Names of the nodes that have a bearing, and of those that a force of a disc acts on.
    M, C, K : (n, n) float64
        kg, N s/m and N/m; C with what gyroscopic moments make at the speed of the rotor.
    """

    dofs: tuple[str, ...]
    bearings: tuple[str, ...]
    discs: tuple[str, ...] = ("disc",)
    M: Array
    C: Array
    K: Array

    def of_nodes(self, nodes: Sequence[str]) -> list[int]:
        """Indices of the degrees of freedom at some nodes."""
        return [i for i, dof in enumerate(self.dofs) if dof.split(".")[0] in nodes]

    @cached_property
    def decoupling(self) -> Array:
        """(n, n) degrees of freedom per coordinate: the bearings' own, and others that no inertia couples to these."""
        at = self.of_nodes(self.bearings)
        inner = [i for i in range(len(self.dofs)) if i not in at]
        T = np.eye(len(self.dofs))
        T[np.ix_(inner, at)] = -np.linalg.solve(self.M[np.ix_(inner, inner)], self.M[np.ix_(inner, at)])
        return T

    def bearing_mass(self, place: str) -> float:
        """Mass in kg that moves with the shaft at a bearing, faster than all its modes; 0 at other places."""
        if place not in self.dofs:
            return 0.0
        motion = self.decoupling[:, self.dofs.index(place)]
        return float(motion @ self.M @ motion)

    def only(self, dofs: Sequence[int]) -> RotorMatrices:
        """The rotor with all other degrees of freedom held."""
        M, C, K = (A[np.ix_(dofs, dofs)] for A in (self.M, self.C, self.K))
        names = tuple(self.dofs[i] for i in dofs)
        return RotorMatrices(dofs=names, bearings=self.bearings, discs=self.discs, M=M, C=C, K=K)

    def at(self, places: tuple[str, ...]) -> Rotor | None:
        """The rotor as measured bearing caps move it, the other bearings held; None where no cap is on it."""
        directions = {place[-1] for place in places}
        others = set(self.of_nodes(self.bearings)) - {self.dofs.index(p) for p in places if p in self.dofs}
        free = self.only([i for i, dof in enumerate(self.dofs) if dof[-1] in directions and i not in others])
        caps = [free.dofs.index(p) if p in free.dofs else -1 for p in places]
        inner = [i for i in range(len(free.dofs)) if i not in caps]
        if max(caps, default=-1) < 0:
            return None
        T = np.zeros((len(free.dofs), len(places) + len(inner)))
        for k, i in enumerate([*caps, *inner]):
            T[:, k] = free.decoupling[:, i] if i >= 0 else 0.0
        M, C, K = (T.T @ A @ T for A in (free.M, free.C, free.K))
        P = len(places)
        M[np.arange(P), np.arange(P)] = M[:P, P:] = M[P:, :P] = 0.0
        discs = {free.dofs[i]: T[i] for i in free.of_nodes(self.discs)}
        return Rotor(places=places, M=M, C=C, K=K, discs=discs)


@dataclass(frozen=True, eq=False, kw_only=True)
class Rotor:
    """Shaft with its discs as the measured caps move it. Coordinates: the caps, then internal ones.

    Parameters
    ----------
    places : tuple of str
        Measured caps, the first P of the n coordinates.
    M, C, K : (n, n) float64
        kg, N s/m, N/m. M has no entry between a cap and an internal coordinate, and none on the diagonal of the caps:
        that mass is of the caps.
    discs : mapping of str to (n,) float64
        Displacement of a disc, such as "disc.x", per coordinate.
    """

    places: tuple[str, ...]
    M: Array
    C: Array
    K: Array
    discs: Mapping[str, Array]

    @cached_property
    def _modes(self) -> tuple[Complexes, Complexes, Complexes]:
        """Modes of the internal coordinates while the caps stand still.

        (r,) poles, rad/s, (n - P, r) their shapes, and (r, P) participation of each mode in a displacement of the caps.
        """
        P, n = len(self.places), len(self.M)
        coupled = (np.abs(self.M) + np.abs(self.C) + np.abs(self.K))[P:, P:] > 0.0
        poles, shapes, participation = ([np.empty(shape, complex)] for shape in ((0,), (n - P, 0), (0, P)))
        for group in _components(coupled):
            at, q = P + group, group.size
            Mi = np.linalg.inv(self.M[np.ix_(at, at)])
            free = np.zeros((2 * q, 2 * q))
            free[:q, q:] = np.eye(q)
            free[q:] = -np.hstack([Mi @ self.K[np.ix_(at, at)], Mi @ self.C[np.ix_(at, at)]])
            p, right = np.linalg.eig(free)
            left = np.linalg.inv(right)[:, q:] @ Mi
            shape = np.zeros((n - P, 2 * q), complex)
            shape[group] = right[:q]
            poles.append(p)
            shapes.append(shape)
            participation.append(-(left @ self.K[at, :P] + p[:, None] * (left @ self.C[at, :P])))
        return np.concatenate(poles), np.hstack(shapes), np.vstack(participation)

    @cached_property
    def _residues(self) -> Complexes:
        """(r, P, P) N/(m s) of the dynamic stiffness at each pole."""
        P = len(self.places)
        p, shapes, participation = self._modes
        left = self.K[:P, P:] @ shapes + p * (self.C[:P, P:] @ shapes)
        return np.asarray(left.T[:, :, None] * participation[:, None, :])

    @cached_property
    def direct(self) -> tuple[Array, Array, Array]:
        """(P, P) of M, C and K of the caps, without the response through the internal coordinates."""
        P = len(self.places)
        M, C, K = (A[:P, :P] for A in (self.M, self.C, self.K))
        return M, C, K - self.C[:P, P:] @ np.linalg.solve(self.M[P:, P:], self.C[P:, :P])

    @cached_property
    def resonances_hz(self) -> tuple[float, ...]:
        """Hz, each once: resonances of the shaft with its discs while the caps stand still."""
        found: list[float] = []
        for p in sorted(self._modes[0][self._modes[0].imag > 0.0], key=abs):
            hz = float(abs(p)) / (2 * np.pi)
            if not found or hz > (1.0 + LIMITS.same_pole_rel) * found[-1]:
                found.append(hz)
        return tuple(found)

    @cached_property
    def held(self) -> tuple[float, float]:
        """N/m and N s/m that the shaft holds a cap by at least, while its internal coordinates stand still."""
        least = []
        for A in (self.direct[2], self.direct[1]):
            by = [[i for i, p in enumerate(self.places) if p.endswith(d)] for d in "xy"]
            least.append(min(float(np.linalg.eigvalsh(A[np.ix_(at, at)])[0]) for at in by if at))
        return max(least[0], 0.0), max(least[1], 0.0)

    def dynamic(self, w: Array | Complexes) -> Complexes:
        """(f, P, P) N/m that shaft and discs add to the dynamic stiffness of the caps. w : rad/s."""
        s = 1j * np.asarray(w)
        M, C, K = self.direct
        P, R = len(self.places), self._residues
        through = (1.0 / (s[:, None] - self._modes[0])) @ R.reshape(len(R), P * P)
        s = s[:, None, None]
        return np.asarray(K + s * C + s * s * M + through.reshape(-1, P, P))

    def follows(self, disc: str, w: Array) -> Complexes:
        """(f, P) displacement of a disc, such as "disc.x", per displacement of each cap. w : rad/s."""
        p, shapes, participation = self._modes
        P, weights = len(self.places), self.discs[disc]
        return np.asarray(weights[:P] + (weights[P:] @ shapes / (1j * w[:, None] - p)) @ participation)

    def terms(self) -> tuple[Term, ...]:
        """Response through the internal coordinates as a sum of real matrices (P, P) times responses of f (Hz)."""
        p, R = self._modes[0], self._residues
        out: list[Term] = []
        done = p.imag < 0.0
        while not done.all():
            pole = p[np.argmin(done)]
            same = (np.abs(p - pole) <= LIMITS.same_pole_rel * abs(pole)) & ~done
            done |= same
            residue = R[same].sum(axis=0)
            parts = residue.real, 0.0 * residue.real
            if pole.imag > 0.0:
                parts = -2.0 * (residue * pole.conj()).real, 2.0 * abs(pole) * residue.real
            U, sizes, V = np.linalg.svd(np.stack([z.ravel() for z in parts], axis=1), full_matrices=False)
            for k in np.flatnonzero(sizes > LIMITS.min_term_rel * sizes[0]):
                out.append((sizes[k] * U[:, k].reshape(residue.shape), _second_order(complex(pole), V[k])))
        return tuple(out)


def _second_order(pole: complex, top: Array) -> Callable[[Array], Complexes]:
    """Response at f (Hz), (top 0 + top 1 s / |pole|) over the polynomial with a pole and its conjugate."""

    def response(f_hz: Array) -> Complexes:
        s = 2j * np.pi * np.asarray(f_hz)
        below = (s - pole) * (s - pole.conjugate()) if pole.imag else s - pole
        return np.asarray((top[0] + top[1] * s / abs(pole)) / below)

    return response


def _components(coupled: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of each set of coordinates that are coupled to one another."""
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(coupled, directed=False) if coupled.size else (0, np.empty(0))
    return [np.flatnonzero(label == k) for k in range(count)]


def reduced_rotor(
    M: Array, C: Array, K: Array, *, planes: Mapping[str, Sequence[int]], nodes: Mapping[str, Mapping[str, int]],
    bearings: tuple[str, ...], highest_hz: float, damping_ratio: float = 0.0,
) -> RotorMatrices:  # fmt: skip
    """A rotor of many degrees of freedom reduced to its bearings, its discs and the modes in between.

    Craig and Bampton (1968): exact at rest, and up to `highest_hz` within the usual rule for the modes that are kept.

    Parameters
    ----------
    M, C, K : (N, N) float64
        kg, N s/m, N/m; C with the gyroscopic matrix times the speed in rad/s. M and K join no two planes.
    planes : mapping of str to sequence of int
        "x", "y" -> indices of the degrees of freedom in that plane, rotations included; the others are left out.
    nodes : mapping of str to mapping of str to int
        Name of a bearing or a disc -> direction -> index of its displacement.
    bearings : tuple of str
        The names that are bearings; the others are discs.
    highest_hz : float
        Highest frequency of interest, Hz.
    damping_ratio : float
        Share of critical of every bending mode of the free shaft, beside C.

    Raises
    ------
    ModelError
        The rotor moves freely while its bearings are held.
    """
    bases, dofs = [], []
    for d, plane in planes.items():
        loose = [i for i in plane if i not in [nodes[name][d] for name in bearings]]
        p = eigh(K[np.ix_(loose, loose)], M[np.ix_(loose, loose)], eigvals_only=True) if loose else np.ones(1)
        if p[0] < LIMITS.min_mode_rel * p[-1]:
            raise ModelError("the rotor turns freely while its bearings are held: name two bearings at least")
        held = [nodes[name][d] for name in nodes]
        inner = [i for i in plane if i not in held]
        T = np.zeros((len(M), len(held)))
        T[held, range(len(held))] = 1.0
        names = [f"{name}.{d}" for name in nodes]
        if inner:
            Kii = K[np.ix_(inner, inner)]
            p, shapes = eigh(Kii, M[np.ix_(inner, inner)])
            T[inner] = -np.linalg.solve(Kii, K[np.ix_(inner, held)])
            kept = shapes[:, p < (2 * np.pi * LIMITS.modes_up_to_rel * highest_hz) ** 2]
            modes = np.zeros((len(M), kept.shape[1]))
            modes[inner] = kept
            T = np.hstack([T, modes])
            names += [f"shaft{k + 1}.{d}" for k in range(kept.shape[1])]
        bases.append(T)
        dofs += names
    T = np.hstack(bases)
    m, c, k = (T.T @ A @ T for A in (M, C, K))
    if damping_ratio:
        p, shapes = eigh(k, m)
        moved = m @ shapes
        c = c + (moved * (2.0 * damping_ratio * np.sqrt(np.maximum(p, 0.0)))) @ moved.T
    discs = tuple(name for name in nodes if name not in bearings)
    return RotorMatrices(dofs=tuple(dofs), bearings=bearings, discs=discs, M=m, C=c, K=k)


def lumped_rotor(
    bearings: Sequence[str], disc: float, damping: Array, stiffness: Array, directions: str = "xy"
) -> RotorMatrices:  # fmt: skip
    """A massless shaft that carries one disc, the same in each direction.

    disc : kg. damping, stiffness : (n, n) N s/m and N/m, nodes in the order of the bearings and then the disc.
    """
    M = np.diag([0.0] * len(bearings) + [disc])
    dofs = tuple(f"{node}.{d}" for d in directions for node in (*bearings, "disc"))
    M, C, K = (block_diag(*[A] * len(directions)) for A in (M, damping, stiffness))
    return RotorMatrices(dofs=dofs, bearings=tuple(bearings), M=M, C=C, K=K)
