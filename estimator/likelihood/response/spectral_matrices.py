"""The spectral matrices of a model and their derivatives, cell by cell, as machine code.

A direction has one to a few caps: for matrices of that size the calls of numpy take longer than the arithmetic.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes


@njit(cache=True, nogil=True)
def _inverted(a: Complexes, out: Complexes) -> bool:
    """Write the inverse of a square matrix, which is used up; False where it has none (Gauss and Jordan)."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 1.0 if i == j else 0.0
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[p, k]):
                p = i
        if not abs(a[p, k]) > 0.0:
            return False
        for j in range(n):
            a[k, j], a[p, j] = a[p, j], a[k, j]
            out[k, j], out[p, j] = out[p, j], out[k, j]
        pivot = 1.0 / a[k, k]
        for j in range(n):
            a[k, j] *= pivot
            out[k, j] *= pivot
        for i in range(n):
            if i != k:
                factor = a[i, k]
                for j in range(n):
                    a[i, j] -= factor * a[k, j]
                    out[i, j] -= factor * out[k, j]
    return True


@njit(cache=True, nogil=True)
def _whitener(a: Complexes, out: Complexes) -> float:
    """Write the inverse of the Cholesky factor of a matrix; ln of its determinant, NaN where it is not positive."""
    n = a.shape[0]
    ln_det = 0.0
    root = np.zeros((n, n), np.complex128)
    for j in range(n):
        for i in range(j, n):
            own = a[i, j]
            for k in range(j):
                own -= root[i, k] * root[j, k].conjugate()
            if i > j:
                root[i, j] = own / root[j, j]
            elif own.real > 0.0:
                root[j, j] = np.sqrt(own.real)
                ln_det += np.log(own.real)
            else:
                return np.nan
    for j in range(n):
        for i in range(n):
            own = 1.0 + 0.0j if i == j else 0.0j
            for k in range(j, i):
                own -= root[i, k] * out[k, j]
            out[i, j] = own / root[i, i] if i >= j else 0.0
    return ln_det


@njit(cache=True, nogil=True)
def _times_adjoint(a: Complexes, b: Complexes, out: Complexes) -> None:
    """Write the product of a square matrix and the conjugate transpose of another one."""
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            own = 0.0j
            for k in range(a.shape[0]):
                own += a[i, k] * b[j, k].conjugate()
            out[i, j] = own


@njit(cache=True, nogil=True)
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
        Log-likelihood; NaN where a matrix of the model is not positive.
    T, signal, W, R : (cells, caps, caps) complex128
        Acceleration per force, spectrum without noise, whitening matrix and whitened measured matrix.
    """
    cells, caps = S.shape
    T, signal, W, R = np.empty_like(Z), np.empty_like(Z), np.empty_like(Z), np.empty_like(Z)
    work, half = np.empty((caps, caps), np.complex128), np.empty((caps, caps), np.complex128)
    nats = 0.0
    for f in range(cells):
        work[:] = Z[f]
        if not _inverted(work, half):
            return np.nan, T, signal, W, R
        for i in range(caps):
            for j in range(caps):
                T[f, i, j] = s[f] * s[f] * half[i, j]
                work[i, j] = T[f, i, j] * S[f, j]
        _times_adjoint(work, T[f], signal[f])
        work[:] = signal[f]
        for i in range(caps):
            work[i, i] += N[f, i]
        ln_det = _whitener(work, W[f])
        if not np.isfinite(ln_det):
            return np.nan, T, signal, W, R
        _times_adjoint(W[f], psd[f], half)
        _times_adjoint(half, W[f], R[f])
        nats -= n[f] * ln_det
        for i in range(caps):
            nats -= n[f] * R[f, i, i].real
    return nats, T, signal, W, R


@njit(cache=True, nogil=True)
def response_ends(W: Complexes, T: Complexes, signal: Complexes, s: Complexes) -> tuple[Complexes, Complexes]:
    """Whitened response to a force at each cap, and whitened signal of each cap, of a small change of stiffness.

    W, T, signal : (cells, caps, caps), of `spectral_model`. s : (cells,) rad/s.

    Returns (cells, caps, caps) twice: columns [cell, row, cap] and rows [cell, cap, column]. The derivative of the
    whitened spectrum by the stiffness at (i, j) is column i times row j, and its conjugate transpose.
    """
    cells, caps = W.shape[:2]
    columns, rows = np.zeros_like(W), np.zeros_like(W)
    for f in range(cells):
        per = -1.0 / (s[f] * s[f])
        for i in range(caps):
            for j in range(caps):
                for k in range(i + 1):
                    columns[f, i, j] += per * W[f, i, k] * T[f, k, j]
                    rows[f, j, i] += W[f, i, k].conjugate() * signal[f, j, k]
    return columns, rows


@njit(cache=True, nogil=True)
def rows_of_matrices(matrices: Complexes, n: Array) -> Array:
    """(rows,) of Hermitian matrices (cells, caps, caps), so that products of rows are traces weighted by n (cells,).

    The diagonal, then real and imaginary parts of the upper triangle, each along the cells.
    """
    cells, caps = matrices.shape[:2]
    out = np.empty(caps * caps * cells)
    root, row = np.sqrt(n), 0
    for a in range(caps):
        for f in range(cells):
            out[row + f] = root[f] * matrices[f, a, a].real
        row += cells
    for a in range(caps):
        for b in range(a + 1, caps):
            for f in range(cells):
                own = np.sqrt(2.0) * root[f] * matrices[f, a, b]
                out[row + f], out[row + cells + f] = own.real, own.imag
            row += 2 * cells
    return out


@njit(cache=True, nogil=True)
def _rows_of_products(left: Complexes, right: Complexes, weight: Array, out: Array) -> None:
    """Write `rows_of_matrices` of l r + (l r)^H of columns l and rows r, both (cells, caps). weight : (cells,)."""
    cells, caps = left.shape
    row = 0
    for a in range(caps):
        for f in range(cells):
            own = left[f, a] * right[f, a]
            out[row + f] = 2.0 * weight[f] * own.real
        row += cells
    for a in range(caps):
        for b in range(a + 1, caps):
            for f in range(cells):
                own = np.sqrt(2.0) * weight[f] * (left[f, a] * right[f, b] + (left[f, b] * right[f, a]).conjugate())
                out[row + f], out[row + cells + f] = own.real, own.imag
            row += 2 * cells


@njit(cache=True, nogil=True)
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
    cells, caps = S.shape
    splines = basis.shape[1]
    first = caps * (splines + 1)
    root, square = np.sqrt(n), s.imag**2
    out = np.empty((first + cap_of.size, caps * caps * cells))
    own, right = np.empty(caps * caps * cells), np.empty((cells, caps), np.complex128)
    for i in range(caps):
        left = columns[:, :, i]
        _rows_of_products(left, left.conj(), 0.5 * root * square * square * S[:, i], own)
        for t in range(splines):
            for row in range(own.size):
                out[i * splines + t, row] = own[row] * basis[row % cells, t]
        left = W[:, :, i]
        _rows_of_products(left, left.conj(), 0.5 * root * N[:, i], out[caps * splines + i])
    for k in range(cap_of.size):
        for f in range(cells):
            for b in range(caps):
                right[f, b] = 0.0
                for j in range(caps):
                    right[f, b] += dZ[k, f, j] * rows[f, j, b]
        _rows_of_products(columns[:, :, cap_of[k]], right, root, out[first + k])
    return out
