"""The spectral matrices of a model and their derivatives, cell by cell."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes


def _adjoint(matrices: Complexes) -> Complexes:
    """(cells, caps, caps) conjugate transposes."""
    return np.asarray(matrices.conj().swapaxes(1, 2))


def spectral_model(
    Z: Complexes, s: Complexes, S: Array, N: Array, psd: Complexes, n: Array
) -> tuple[float, Complexes, Complexes, Complexes, Complexes]:
    """The spectral matrices of a model against the measured ones; caps are places of one direction.

    Parameters
    ----------
    Z : (cells, caps, caps) complex128
        Dynamic stiffness, N/m.
    s : (cells,) complex128
        rad/s.
    S, N : (cells, caps) float64
        PSD of force and noise.
    psd : (cells, caps, caps) complex128
        Measured.
    n : (cells,) float64
        Complex degrees of freedom of each measured matrix.

    Returns
    -------
    nats : float
        Log-likelihood.
    T, signal, W, R : (cells, caps, caps) complex128
        Acceleration per force, spectrum without noise, whitening matrix and whitened measured matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        A matrix of the model is not positive.
    """
    T = np.asarray((s * s)[:, None, None] * np.linalg.inv(Z))
    signal = (T * S[:, None, :]) @ _adjoint(T)
    model = signal.copy()
    np.einsum("fii->fi", model)[...] += N
    root = np.linalg.cholesky(model)
    W = np.asarray(np.linalg.inv(root), np.complex128)
    R = W @ psd @ _adjoint(W)
    lost = 2.0 * np.log(np.einsum("fii->fi", root).real) + np.einsum("fii->fi", R).real
    return -float(n @ lost.sum(axis=1)), T, signal, W, R


def response_ends(W: Complexes, T: Complexes, signal: Complexes, s: Complexes) -> tuple[Complexes, Complexes]:
    """Whitened response to a force at each cap, and whitened signal of each cap, of a small change of stiffness.

    W, T, signal : (cells, caps, caps), of `spectral_model`. s : (cells,) rad/s.

    Returns (cells, caps, caps) twice: columns [cell, row, cap] and rows [cell, cap, column]. The derivative of the
    whitened spectrum by the stiffness at (i, j) is column i times row j, and its conjugate transpose.
    """
    return (-1.0 / (s * s))[:, None, None] * (W @ T), signal @ _adjoint(W)


def rows_of_matrices(matrices: Complexes, n: Array) -> Array:
    """(rows,) of Hermitian matrices (cells, caps, caps), so that products of rows are traces weighted by n (cells,).

    The diagonal, then real and imaginary parts of the upper triangle, each along the cells.
    """
    caps, root = range(matrices.shape[1]), np.sqrt(n)
    out = [root * matrices[:, a, a].real for a in caps]
    for a, b in combinations(caps, 2):
        own = np.sqrt(2.0) * root * matrices[:, a, b]
        out += [own.real, own.imag]
    return np.concatenate(out)


def _rows_of_products(left: Complexes, right: Complexes, weight: Array) -> Array:
    """(k, rows) `rows_of_matrices` of l r + (l r)^H of columns l and rows r, both (caps, k, cells).

    weight : (cells,) or (k, cells).
    """
    caps = range(len(left))
    out = [2.0 * weight * (left[a] * right[a]).real for a in caps]
    for a, b in combinations(caps, 2):
        own = np.sqrt(2.0) * weight * (left[a] * right[b] + (left[b] * right[a]).conj())
        out += [own.real, own.imag]
    return np.concatenate(out, axis=1)


def derivative_rows(
    W: Complexes, s: Complexes, S: Array, N: Array, basis: Array, n: Array,
    columns: Complexes, rows: Complexes, cap_of: NDArray[np.int64], dZ: Complexes,
) -> Array:  # fmt: skip
    """Rows of the derivatives of the whitened spectral matrices.

    By the coefficients of ln S of each cap, by ln N of each cap, and by parameters that change a row of the dynamic
    stiffness.

    Parameters
    ----------
    W, s, S, N, n
        Of `spectral_model`.
    basis : (cells, splines) float64
        Of ln S.
    columns, rows : (cells, caps, caps) complex128
        Of `response_ends`.
    cap_of : (k,) int64
        Row of the dynamic stiffness that each further parameter changes.
    dZ : (k, cells, caps) complex128
        Derivative of this row.

    Returns
    -------
    (caps * splines + caps + k, rows) float64
        As of `rows_of_matrices`.
    """
    root, caps = np.sqrt(n), S.shape[1]
    force, noise = (np.ascontiguousarray(z.transpose(1, 2, 0)) for z in (columns, W))
    by_force = _rows_of_products(force, force.conj(), 0.5 * root * s.imag**4 * S.T)
    by_knot = by_force[:, None, :] * np.tile(basis.T, caps * caps)
    by_noise = _rows_of_products(noise, noise.conj(), 0.5 * root * N.T)
    right = (dZ.swapaxes(0, 1) @ rows).transpose(2, 1, 0)
    by_stiffness = _rows_of_products(force[:, cap_of], right, root)
    return np.concatenate([by_knot.reshape(-1, by_force.shape[1]), by_noise, by_stiffness])
