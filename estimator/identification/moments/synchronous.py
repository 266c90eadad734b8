"""Shaft orders in a record with random excitation, and their bias of the stiffness (J. Sound Vib. 208(1), 1997).

A line A cos(W t + phi) in the displacement adds A^2/2 to E[x^2] and W^2 A^2/2 to E[v^2], so the stiffness read from the
density of a linear cap, m E[v^2]/E[x^2], becomes

    kL' = m (s_v^2 + W^2 A^2/2) / (s_x^2 + A^2/2),    kL'/kL - 1 = -(A^2/2)(1 - W^2/w0^2) / (s_x^2 + A^2/2)

too soft for a line below the resonance, too stiff above it. The line is removed by least squares at the known shaft
speed, window by window, which follows a slow change of phase or speed. The random part loses the bandwidth 1/window at
each order. The removal is exact for a linear cap; a cubic one keeps 3 kNL A^2/2 in kL.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.arrays import Array
from estimator.effects import CATALOGUE
from estimator.model.rig import Model
from estimator.results import Message

ORDERS_BY_EFFECT = {  # of the shaft speed, up to the highest: what makes the second makes some of the first
    name: tuple(range(1, max(e.harmonics) + 1))
    for name, e in CATALOGUE.items()
    if isinstance(e.harmonics, tuple) and e.turns
}
WINDOW_S = 1.0  # of one least-squares fit


def synchronous_orders(model: Model) -> tuple[int, ...]:
    """Shaft orders that the model's effects put into a record; empty if none or if the speed is not known."""
    if model.speed_rpm is None or model.speed_rpm <= 0.0:
        return ()
    return tuple(sorted({k for e in model.effects for k in ORDERS_BY_EFFECT.get(e.name, ())}))


def synchronous_lines(
    x: Array, rate_hz: float, hz: float, orders: tuple[int, ...], window_s: float = WINDOW_S
) -> Array:
    """(n, channels) lines at orders of the shaft speed hz (Hz) in x (n, channels), to be subtracted; NaN rows ignored.

    Least squares on cosine and sine in windows of `window_s`; a shorter last window joins the one before.
    """
    out = np.zeros_like(x)
    n = len(x)
    size = max(int(round(window_s * rate_hz)), int(4.0 * rate_hz / hz))
    starts = list(range(0, max(n - size, 0) + 1, size)) or [0]
    t = np.arange(n) / rate_hz
    for start, stop in zip(starts, [*starts[1:], n], strict=True):
        phase = 2.0 * math.pi * hz * t[start:stop]
        basis = np.stack([f(k * phase) for k in orders for f in (np.cos, np.sin)], axis=1)
        good = np.isfinite(x[start:stop]).all(axis=1)
        if good.sum() < 8 * basis.shape[1]:
            continue
        coefficients, *_ = np.linalg.lstsq(basis[good], x[start:stop][good], rcond=None)
        out[start:stop] = basis @ coefficients
    return out


def line_amplitude(x: Array, rate_hz: float, hz: float) -> Array:
    """(channels,) zero-to-peak amplitude of the line at hz (Hz) in x (n, channels), without NaN."""
    n = len(x)
    carrier = np.exp(-2j * np.pi * hz * np.arange(n) / rate_hz)
    return np.asarray(2.0 * np.abs(carrier @ x) / n)


def stiffness_bias(line: float, rms: float, hz: float, resonance_hz: float) -> float:
    """kL'/kL - 1 by a line of amplitude `line` (m) at hz, together with random displacement of rms `rms` (m)."""
    extra = 0.5 * line**2
    return -extra * (1.0 - (hz / resonance_hz) ** 2) / (rms**2 + extra)


def synchronous_message(model: Model, place: str, x: Array, v: Array, rate_hz: float) -> list[Message]:
    """A line for the user if a 1X that the model does not have would move kL of this cap by over 1 %; x, v (n,)."""
    if model.speed_rpm is None or model.speed_rpm <= 0.0 or synchronous_orders(model):
        return []
    hz = model.speed_rpm / 60.0
    line = float(line_amplitude(x[:, None], rate_hz, hz)[0])
    total = float(np.mean(x**2))
    rms = math.sqrt(max(total - 0.5 * line**2, 1e-3 * total))
    resonance = math.sqrt(float(np.mean(v**2)) / total) / (2.0 * math.pi)
    bias = stiffness_bias(line, rms, hz, resonance)
    if abs(bias) < 0.01:
        return []
    text = (
        f"{place}: a line at shaft speed ({hz:g} Hz, {1e9 * line:.3g} nm) biases kL by about {100 * bias:+.1f} %: "
        "add the imbalance effect, which removes the line here, or raise band.low above the line"
    )
    return [Message("shaft_line_biases_stiffness", text, place)]
