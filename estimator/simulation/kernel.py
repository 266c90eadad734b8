"""Time stepping in compiled code: the force held over the step, and the decimation.

State x, v: a slot for each degree of freedom, and one more that is always zero, for "no such degree of freedom".
z: memory states. Effects are called by address. The output of a step is its average: (v1 - v0) / h is the mean
acceleration over the step for any force. So acceleration, velocity, displacement and force all pass the same box filter
of length h, centred on the step.

The linear rotor is propagated exactly, the effects with the two-stage second-order exponential Runge-Kutta rule (Cox
and Matthews, J. Comput. Phys. 176, 2002, 430-455, eq. 22).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimator.effects.engine.compiled import call_force_at, call_memory_at, call_rates_at

LAW_FORCE, LAW_SHAFT, LAW_MEMORY = 0, 1, 2  # kinds of laws in the effect table
CHANNEL_ACCELERATION, CHANNEL_VELOCITY, CHANNEL_DISPLACEMENT, CHANNEL_FORCE = 0, 1, 2, 3  # kinds of channels


@njit(cache=True, error_model="numpy", nogil=True)
def _effects(x, v, z, t, phase, table, f, dz):  # type: ignore[no-untyped-def]
    """Fill f with the restoring forces of all effects and dz with the rates of the memory states.

    table : law, law2, p, lin (effects,) addresses; where (effects, 8) kind, slot, cap 1, cap 2, the same three slots
    of the other direction, first memory state; sign (effects,).
    """
    law, law2, p, lin, where, sign = table
    f[:] = 0.0
    for k in range(law.size):
        kind, i, io = where[k, 0], where[k, 1], where[k, 4]
        if kind == LAW_FORCE:
            f[i] += call_force_at(law[k], x[i], v[i], x[io], v[io], t, phase, sign[k], p[k])
        elif kind == LAW_SHAFT:
            j1, j2, o1, o2 = where[k, 2], where[k, 3], where[k, 5], where[k, 6]
            xr, vr = x[i] - 0.5 * (x[j1] + x[j2]), v[i] - 0.5 * (v[j1] + v[j2])
            xo, vo = x[io] - 0.5 * (x[o1] + x[o2]), v[io] - 0.5 * (v[o1] + v[o2])
            r = call_force_at(law[k], xr, vr, xo, vo, t, phase, sign[k], p[k])
            f[i] += r
            f[j1] -= 0.5 * r
            f[j2] -= 0.5 * r
        else:
            zk = np.uintp(z.ctypes.data) + np.uintp(8) * where[k, 7]
            dk = np.uintp(dz.ctypes.data) + np.uintp(8) * where[k, 7]
            f[i] += call_memory_at(law[k], zk, x[i], v[i], p[k], lin[k])
            call_rates_at(law2[k], zk, x[i], v[i], p[k], lin[k], dk)


@njit(cache=True, error_model="numpy", nogil=True)
def _emit(out, k, chan, x, v, x1, v1, F, h):  # type: ignore[no-untyped-def]
    """Write the averages of step k into out (channels, steps)."""
    for c in range(chan.shape[0]):
        kind, i = chan[c, 0], chan[c, 1]
        if kind == CHANNEL_ACCELERATION:
            out[c, k] = (v1[i] - v[i]) / h
        elif kind == CHANNEL_VELOCITY:
            out[c, k] = (x1[i] - x[i]) / h
        elif kind == CHANNEL_DISPLACEMENT:
            out[c, k] = 0.5 * (x[i] + x1[i]) - h / 12.0 * (v1[i] - v[i])
        else:
            out[c, k] = F[i]


@njit(cache=True, error_model="numpy", nogil=True)
def exponential(x, v, z, t0, h, phase, F, table, matrices, chan, out):  # type: ignore[no-untyped-def]
    """Advance x (m), v (m/s) and z by len(F) steps of h s, exactly for the linear rotor at any step.

    t0 : s, time of the first step. phase : (steps + 1,) rad, shaft angle. F : (steps, slots) N, held over a step.
    table : of the effects. matrices : E (2 dofs, 2 dofs), G0, G1 (2 dofs, dofs), the propagator of the rotor.
    chan : (channels, 2) kind and slot. out : (channels, steps), filled with the averages of the steps.
    """
    E, G0, G1 = matrices
    dofs = G0.shape[1]
    n, nz = x.size, z.size
    f, f1, x1, v1 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    zs, d1, d2 = np.zeros(nz), np.zeros(nz), np.zeros(nz)
    for k in range(F.shape[0]):
        t, Fk = t0 + k * h, F[k]
        _effects(x, v, z, t, phase[k], table, f, d1)
        for i in range(dofs):
            xi, vi = 0.0, 0.0
            for j in range(dofs):
                g = Fk[j] - f[j]
                xi += E[i, j] * x[j] + E[i, dofs + j] * v[j] + G0[i, j] * g
                vi += E[dofs + i, j] * x[j] + E[dofs + i, dofs + j] * v[j]
                vi += G0[dofs + i, j] * g
            x1[i], v1[i] = xi, vi
        if table[0].size:
            for i in range(nz):
                zs[i] = z[i] + h * d1[i]
            _effects(x1, v1, zs, t + h, phase[k + 1], table, f1, d2)
            for i in range(nz):
                z[i] += 0.5 * h * (d1[i] + d2[i])
            for i in range(dofs):
                xi, vi = 0.0, 0.0
                for j in range(dofs):
                    g = f[j] - f1[j]
                    xi += G1[i, j] * g
                    vi += G1[dofs + i, j] * g
                x1[i] += xi
                v1[i] += vi
        _emit(out, k, chan, x, v, x1, v1, Fk, h)
        for i in range(n):
            x[i], v[i] = x1[i], v1[i]  # x[:] = x1 takes four seconds to compile, for the message of an error


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _dot(a, b):  # type: ignore[no-untyped-def]
    """Scalar product."""
    total = 0.0
    for j in range(a.size):
        total += a[j] * b[j]
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def decimate(steps, taps, factor, out):  # type: ignore[no-untyped-def]
    """Fill out (n, channels) with taps applied at every `factor`-th step to (channels, n * factor + len(taps))."""
    for k in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[k, c] = _dot(taps, steps[c, k * factor : k * factor + taps.size])
