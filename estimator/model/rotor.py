"""Linear rotor: shaft, disc and bearing matrices, disc elimination, stationary response.

One transverse direction at a time; the other is identical. Nodes in the order of the bearings and then "disc".
Restoring convention M a + C v + K x = F. Paper: Tiwari and Vyas, J. Sound Vib. 203(3), 1997, 389-408 (equation numbers
below).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from estimator.arrays import Array
from estimator.errors import ModelError

from .rig import CAP_DIRECTIONS, Model, Shaft
from .rotor_matrices import Rotor, RotorMatrices, lumped_rotor

CHAIN_MATRIX: Array = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0], [-1.0, -1.0, 2.0]])
BEAM_MATRIX: Array = np.array([[1.0, 1.0, -2.0], [1.0, 1.0, -2.0], [-2.0, -2.0, 4.0]])
SHAFT_MATRICES: dict[Shaft, Array] = {"chain": CHAIN_MATRIX, "beam": BEAM_MATRIX, "none": np.zeros((3, 3))}


def shaft_matrix(shaft: Shaft, stiffness: float) -> Array:
    """(3, 3) stiffness of the massless shaft, N/m, nodes (bearing1, bearing2, disc); eq. (37) is `chain`.

    stiffness : N/m. `chain`: 12 EI / l^3 of an element of length l whose end slopes are held. `beam`: 12 EI / L^3 of
        the whole span L with free ends; a rigid tilt then costs nothing. The same matrix with a damping in N s/m is
        the shaft's own damping.
    """
    return stiffness * SHAFT_MATRICES[shaft]


def rotor_matrices(model: Model) -> RotorMatrices | None:
    """The shaft of a model with its discs, whatever its form; None without one, or where its disc has no mass."""
    disc = model.mass.get("disc", 0.0)
    if model.shaft in ("none", "matrices") or model.shaft_stiffness <= 0.0 or disc <= 0.0:
        return model.rotor if model.shaft == "matrices" else None
    C, K = shaft_matrix(model.shaft, model.shaft_damping), shaft_matrix(model.shaft, model.shaft_stiffness)
    return lumped_rotor(model.bearings, disc, C, K)


def rotor_of(model: Model) -> Rotor | None:
    """Shaft and discs as the measured caps of a model move them; None without a shaft."""
    rotor = rotor_matrices(model)
    return None if rotor is None else rotor.at(model.places)


@dataclass(frozen=True, slots=True, kw_only=True)
class Assembly:
    """The linear rig as matrices over all degrees of freedom, direction by direction.

    dofs : names such as "bearing1.x", "disc.x"; M, C, K : (n, n) SI; S : (n,) one-sided force PSD, N^2/Hz.
    """

    dofs: tuple[str, ...]
    M: Array
    C: Array
    K: Array
    S: Array

    def index(self, place: str) -> int:
        """Number of a degree of freedom. Raises KeyError with the names there are."""
        try:
            return self.dofs.index(place)
        except ValueError:
            raise KeyError(f"no degree of freedom {place!r}: there are {', '.join(self.dofs)}") from None


def assemble(model: Model) -> Assembly:
    """Matrices of a model whose linear part is complete. Raises ModelError naming every value that is missing."""
    wanted, rotor = {*model.places, *model.linear}, rotor_matrices(model)
    of_rotor = () if rotor is None else rotor.dofs
    dofs: list[str] = []
    missing = ["mass of disc"] if model.shaft in SHAFT_MATRICES and model.discs and "disc" not in model.mass else []
    for d in CAP_DIRECTIONS:
        caps = [dof for n in model.bearings if (dof := f"{n}.{d}") in wanted]
        if len(caps) == 1 and model.shaft in ("chain", "beam"):
            raise ModelError(f'shaft "{model.shaft}" joins two bearings, direction {d} has one; use shaft = "none"')
        if caps:
            dofs += dict.fromkeys([*caps, *(dof for dof in of_rotor if dof.endswith("." + d))])
    if not dofs:
        raise ModelError("no bearing cap in the model: name at least one acceleration channel")
    n = len(dofs)
    M, C, K, S = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    if rotor is not None:
        numbers = [of_rotor.index(dof) if dof in of_rotor else -1 for dof in dofs]
        at = [i for i, k in enumerate(numbers) if k >= 0]
        part = rotor.only([numbers[i] for i in at])
        for target, given in ((M, part.M), (C, part.C), (K, part.K)):
            target[np.ix_(at, at)] = given
    for i, dof in enumerate(dofs):
        node = dof.split(".")[0]
        if node not in model.bearings:
            continue
        mass = model.mass.get(dof, model.mass.get(node, None if model.rotor is None else 0.0))
        if mass is None:
            missing.append(f"mass of {dof}")
        M[i, i] += mass or 0.0
        settings = model.linear.get(dof, {})
        for key, target in (("kL", K[i, i : i + 1]), ("c", C[i, i : i + 1]), ("S", S[i : i + 1])):
            value = settings[key].value if key in settings else None
            if value is None:
                missing.append(f"{dof}.{key}")
            else:
                target += value
    if missing:
        raise ModelError(f"the model has no value for {', '.join(missing)}: give them in the rig file, or fit first")
    return Assembly(dofs=tuple(dofs), M=M, C=C, K=K, S=S)


def linear_covariance(M: Array, C: Array, K: Array, Q: Array) -> Array:
    """(2n, 2n) exact stationary covariance of (x, v) under white forces of intensity Q (n, n), N^2 s: Lyapunov.

    Raises ModelError if the linear system does not decay.
    """
    n = len(M)
    unsteady = ModelError("the linear rotor does not decay, so it has no stationary response: check kL and c")
    if np.any(np.diag(K) <= 0.0):
        raise unsteady
    scale = np.sqrt(np.diag(K) / np.diag(M))  # state (w x, v): all entries of one size
    Mi = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.diag(scale)], [-Mi @ K / scale, -Mi @ C]])
    if np.max(np.linalg.eigvals(A).real) >= 0.0:
        raise unsteady
    B = np.zeros((2 * n, 2 * n))
    B[n:, n:] = Mi @ Q @ Mi.T
    P = solve_continuous_lyapunov(A, -B)
    back = np.concatenate([1.0 / scale, np.ones(n)])
    P = P * back[:, None] * back
    return np.asarray(0.5 * (P + P.T))


def propagator(M: Array, C: Array, K: Array, dt: float) -> tuple[Array, Array, Array]:
    """Exact step of the linear rotor under a force g0 + (g1 - g0) s / dt, 0 <= s <= dt.

    Returns E (2n, 2n), G0 (2n, n), G1 (2n, n) with u(dt) = E u(0) + G0 g0 + G1 (g1 - g0), u = (x, v).
    """
    n = len(M)
    A = np.zeros((4 * n, 4 * n))
    Mi = np.linalg.inv(M)
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n, :n], A[n : 2 * n, n : 2 * n], A[n : 2 * n, 2 * n : 3 * n] = -Mi @ K, -Mi @ C, Mi
    A[2 * n : 3 * n, 3 * n :] = np.eye(n) / dt
    X = expm(A * dt)
    return X[: 2 * n, : 2 * n], X[: 2 * n, 2 * n : 3 * n], X[: 2 * n, 3 * n :]
