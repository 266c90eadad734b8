"""Time stepping in compiled code: two schemes with the force held over the step, and the decimation.

State x, v (n,) and memory states z. Effects are called by address (effects/compiled.py). What comes out of a step is
its average: (v1 - v0) / h is the mean acceleration whatever the force did, so acceleration, velocity, displacement
and force are all seen through the same box of length h, centred on the step.

Schemes: RK4 is the paper's protocol. "exponential" propagates the linear rotor exactly and the effects with the
two-stage second-order exponential Runge-Kutta rule (Cox and Matthews, J. Comput. Phys. 176, 2002, 430-455, eq. 22).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .effects.compiled import call_force, call_memory, call_rates

FORCE, SHAFT, MEMORY = 0, 1, 2
ACCELERATION, VELOCITY, DISPLACEMENT, EXCITATION = 0, 1, 2, 3


@njit(cache=True, error_model="numpy", nogil=True)
def _relative(q, i, j1, j2):  # type: ignore[no-untyped-def]
    """Disc minus mean of the caps."""
    return q[i] - 0.5 * (q[j1] + q[j2])


@njit(cache=True, error_model="numpy", nogil=True)
def effect_forces(x, v, z, t, phase, law, law2, where, sign, P, lin, zat, f, dz):  # type: ignore[no-untyped-def]
    """Fill f (n,) with the restoring forces of all effects and dz with the rates of the memory states.

    where : (effects, 7) kind, dof, cap 1, cap 2, then those of the other direction (-1: none).
    """
    f[:] = 0.0
    for k in range(law.size):
        kind, i, io = where[k, 0], where[k, 1], where[k, 4]
        if kind == FORCE:
            xo, vo = (x[io], v[io]) if io >= 0 else (0.0, 0.0)
            f[i] += call_force(law[k], x[i], v[i], xo, vo, t, phase, sign[k], P[k])
        elif kind == SHAFT:
            j1, j2 = where[k, 2], where[k, 3]
            xo, vo = 0.0, 0.0
            if io >= 0:
                xo, vo = _relative(x, io, where[k, 5], where[k, 6]), _relative(v, io, where[k, 5], where[k, 6])
            r = call_force(law[k], _relative(x, i, j1, j2), _relative(v, i, j1, j2), xo, vo, t, phase, sign[k], P[k])
            f[i] += r
            f[j1] -= 0.5 * r
            f[j2] -= 0.5 * r
        else:
            zk, dk = z[zat[k] : zat[k + 1]], dz[zat[k] : zat[k + 1]]
            f[i] += call_memory(law[k], zk, x[i], v[i], P[k], lin[k])
            call_rates(law2[k], zk, x[i], v[i], P[k], lin[k], dk)


@njit(cache=True, error_model="numpy", nogil=True)
def _accelerate(x, v, F, f, block, K, C, m, a):  # type: ignore[no-untyped-def]
    for i in range(x.size):
        r = F[i] - f[i]
        for j in range(block[i, 0], block[i, 1]):
            r -= K[i, j] * x[j] + C[i, j] * v[j]
        a[i] = r / m[i]


@njit(cache=True, error_model="numpy", nogil=True)
def _emit(out, k, chan, x, v, x1, v1, F, h):  # type: ignore[no-untyped-def]
    for c in range(chan.shape[0]):
        i = chan[c, 1]
        if chan[c, 0] == ACCELERATION:
            out[c, k] = (v1[i] - v[i]) / h
        elif chan[c, 0] == VELOCITY:
            out[c, k] = (x1[i] - x[i]) / h
        elif chan[c, 0] == DISPLACEMENT:
            out[c, k] = 0.5 * (x[i] + x1[i]) - h / 12.0 * (v1[i] - v[i])
        else:
            out[c, k] = F[i]


@njit(cache=True, error_model="numpy", nogil=True)
def rk4(x, v, z, t0, h, phase, F, law, law2, where, sign, P, lin, zat, block, K, C, m, chan, out):  # type: ignore[no-untyped-def]
    """Advance x, v, z by len(F) steps; F (steps, n) N, phase (steps + 1,) rad, out (channels, steps)."""
    n = x.size
    f, a1, a2, a3, a4 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    xs, vs, x1, v1, v2, v3 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    nz = z.size
    zs, d1, d2, d3, d4 = np.zeros(nz), np.zeros(nz), np.zeros(nz), np.zeros(nz), np.zeros(nz)
    for k in range(F.shape[0]):
        t, Fk = t0 + k * h, F[k]
        middle = 0.5 * (phase[k] + phase[k + 1])
        effect_forces(x, v, z, t, phase[k], law, law2, where, sign, P, lin, zat, f, d1)
        _accelerate(x, v, Fk, f, block, K, C, m, a1)
        for i in range(n):
            xs[i], v2[i] = x[i] + 0.5 * h * v[i], v[i] + 0.5 * h * a1[i]
        for i in range(nz):
            zs[i] = z[i] + 0.5 * h * d1[i]
        effect_forces(xs, v2, zs, t + 0.5 * h, middle, law, law2, where, sign, P, lin, zat, f, d2)
        _accelerate(xs, v2, Fk, f, block, K, C, m, a2)
        for i in range(n):
            xs[i], v3[i] = x[i] + 0.5 * h * v2[i], v[i] + 0.5 * h * a2[i]
        for i in range(nz):
            zs[i] = z[i] + 0.5 * h * d2[i]
        effect_forces(xs, v3, zs, t + 0.5 * h, middle, law, law2, where, sign, P, lin, zat, f, d3)
        _accelerate(xs, v3, Fk, f, block, K, C, m, a3)
        for i in range(n):
            xs[i], vs[i] = x[i] + h * v3[i], v[i] + h * a3[i]
        for i in range(nz):
            zs[i] = z[i] + h * d3[i]
        effect_forces(xs, vs, zs, t + h, phase[k + 1], law, law2, where, sign, P, lin, zat, f, d4)
        _accelerate(xs, vs, Fk, f, block, K, C, m, a4)
        for i in range(n):
            x1[i] = x[i] + h / 6.0 * (v[i] + 2.0 * v2[i] + 2.0 * v3[i] + vs[i])
            v1[i] = v[i] + h / 6.0 * (a1[i] + 2.0 * a2[i] + 2.0 * a3[i] + a4[i])
        for i in range(nz):
            z[i] += h / 6.0 * (d1[i] + 2.0 * d2[i] + 2.0 * d3[i] + d4[i])
        _emit(out, k, chan, x, v, x1, v1, Fk, h)
        x[:] = x1
        v[:] = v1


@njit(cache=True, error_model="numpy", nogil=True)
def exponential(x, v, z, t0, h, phase, F, law, law2, where, sign, P, lin, zat, block, E, G0, G1, chan, out):  # type: ignore[no-untyped-def]
    """As `rk4`; E (2n, 2n), G0, G1 (2n, n) from rotor.propagator. Exact for the linear rotor at any step."""
    n = x.size
    f, f1, x1, v1 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    nz = z.size
    zs, d1, d2 = np.zeros(nz), np.zeros(nz), np.zeros(nz)
    for k in range(F.shape[0]):
        t, Fk = t0 + k * h, F[k]
        effect_forces(x, v, z, t, phase[k], law, law2, where, sign, P, lin, zat, f, d1)
        for i in range(n):
            xi, vi = 0.0, 0.0
            for j in range(block[i, 0], block[i, 1]):
                g = Fk[j] - f[j]
                xi += E[i, j] * x[j] + E[i, n + j] * v[j] + G0[i, j] * g
                vi += E[n + i, j] * x[j] + E[n + i, n + j] * v[j] + G0[n + i, j] * g
            x1[i], v1[i] = xi, vi
        if law.size:
            for i in range(nz):
                zs[i] = z[i] + h * d1[i]
            effect_forces(x1, v1, zs, t + h, phase[k + 1], law, law2, where, sign, P, lin, zat, f1, d2)
            for i in range(nz):
                z[i] += 0.5 * h * (d1[i] + d2[i])
            for i in range(n):
                xi, vi = 0.0, 0.0
                for j in range(block[i, 0], block[i, 1]):
                    g = f[j] - f1[j]
                    xi += G1[i, j] * g
                    vi += G1[n + i, j] * g
                x1[i] += xi
                v1[i] += vi
        _emit(out, k, chan, x, v, x1, v1, Fk, h)
        x[:] = x1
        v[:] = v1


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract", "nsz"})
def decimate(steps, taps, factor, out):  # type: ignore[no-untyped-def]
    """out (n, channels) = taps applied to steps (channels, n * factor + len(taps)) at every `factor`-th step."""
    for k in range(out.shape[0]):
        for c in range(out.shape[1]):
            at = k * factor
            total = 0.0
            for j in range(taps.size):
                total += taps[j] * steps[c, at + j]
            out[k, c] = total
