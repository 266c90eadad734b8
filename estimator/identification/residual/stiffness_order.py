"""The shaft order at which stiffness varies, from the record: geometry may be missing, and bearings slip by a per cent.

For a missing force F = F0 + k cos(w t) x with F0 white and independent of x, the product F x has a line at w over a
smooth floor. The power of the line over this floor is the log-likelihood (nats) that k_cos and k_sin gain at that
frequency. A line is searched among the products as in a periodogram; the frequency is known to sqrt(6 / nats) / (2 pi
T), the bound for a sinusoid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects.places import at, kinematic, written
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import EffectUse, Model, Setting
from estimator.parallel import map_threads
from estimator.results import Message
from estimator.signals.line_spectrum import hann_spectrum, local_noise

from .thresholds import LIMITS


@dataclass(frozen=True, slots=True)
class StiffnessOrder:
    """A shaft order at which stiffness varies.

    order : multiples of the shaft speed. sd : its standard deviation.
    """

    order: float
    sd: float


def lacks_stiffness_order(model: Model) -> bool:
    """Whether the ball-pass order is to be searched: the speed is known, and neither model nor laws have an order."""
    orders = [
        own.get("order", Setting()).value
        for use in ball_pass_uses(model)
        for own in _parameters_by_location(model, use).values()
    ]
    return bool(model.speed_rpm) and model.ball_pass_order is None and (not orders or None in orders)


def ball_pass_uses(model: Model) -> tuple[EffectUse, ...]:
    """The model's effects of stiffness that varies at the ball-pass order."""
    return tuple(u for u in model.effects if u.name == BALL_PASS.name)


def _parameters_by_location(model: Model, use: EffectUse) -> dict[str, dict[str, Setting]]:
    """Parameters of a use by canonical location."""
    return {place: written(BALL_PASS, use, model, place) for place in at(BALL_PASS, use, model)}


def with_start_orders(model: Model) -> Model:
    """The model whose laws start at the ball-pass order of the record."""
    order = {"order": Setting(model.ball_pass_order)}
    return replace(
        model,
        effects=tuple(
            replace(u, parameters={place: order | own for place, own in _parameters_by_location(model, u).items()})
            if u in ball_pass_uses(model) else u
            for u in model.effects
        ),
    )  # fmt: skip


def with_found_order(model: Model, point: WorkingPoint) -> tuple[Model, tuple[Message, ...]]:
    """The model with the ball-pass order of the record, if the geometry does not give that order, and a message on it.

    point : working point of the model without ball-pass laws.
    """
    found = find_stiffness_order(point)
    if found is None:
        return model, ()
    known = kinematic("bpfo", model)
    if known is not None and abs(found.order - known) < 4.0 * found.sd:
        return model, ()
    beside = "" if known is None else f"; the geometry says {known:.4f}"
    text = f"the stiffness varies at shaft order {found.order:.4f} +- {found.sd:.1g}{beside}"
    said = (Message("ball_pass_order_found", text),)
    return replace(model, ball_pass_order=found.order, order_found=True), said


def find_stiffness_order(point: WorkingPoint) -> StiffnessOrder | None:
    """The clearest line of F x at any location; None without one. Orders 1 and 2 of the shaft belong to a crack."""
    from scipy.fft import next_fast_len, rfft

    data = point.data
    rotation = data.speed / (2 * np.pi)
    if rotation <= 0.0:
        return None
    thin = max(1, int(data.rate_hz / (4.0 * LIMITS.max_order * rotation)))
    turned = (data.phase - data.phase[0]) / data.speed  # s, at the mean speed: a line of the shaft's stays one
    rows = np.rint(turned * data.rate_hz).astype(np.int64) // thin
    size = next_fast_len(LIMITS.min_padding * (int(rows[-1]) + 1), real=True)
    looked = min(
        size // 2 + 1, int(LIMITS.max_order * rotation * size * thin / data.rate_hz) + 2 * LIMITS.floor_bins
    )  # bins
    f = np.arange(looked) / (size * thin / data.rate_hz)
    seconds = float(data.t[-1] - data.t[0])
    usable = (f > max(LIMITS.min_order * rotation, 10.0 / seconds)) & (f < LIMITS.max_order * rotation)
    for k in (1.0, 2.0):
        usable &= np.abs(f - k * rotation) > 3.0 / seconds
    if not usable.any():
        return None

    def clearest(i: int) -> tuple[float, float]:
        """Gain (nats) and frequency (Hz) of the highest line at location i."""
        has_lines = bool(data.lines) or data.measured_force_psd[i] > 0.0
        force = _without_lines(point.force[i]) if has_lines else point.force[i]
        product = np.bincount(rows, force * data.x[i]).astype(np.float32)
        line = np.asarray(rfft(product, size))[:looked]
        power = line.real**2 + line.imag**2
        nats = local_noise(power, LIMITS.floor_bins)
        np.divide(power, nats, out=nats)
        nats[~usable] = 0.0
        k = int(np.argmax(nats))
        return float(nats[k]), float(f[k] + _peak_offset_bins(power[k - 1 : k + 2]) * f[1])  # its floor may step

    places = range(len(data.places))
    found = (
        map_threads(clearest, places) if size <= LIMITS.max_bins_at_once else [clearest(i) for i in places]
    )  # memory
    nats, hz = max(found)
    if nats < LIMITS.noise_margin_rel * np.log(np.count_nonzero(usable) * len(data.places) / LIMITS.false_line_chance):
        return None
    return StiffnessOrder(hz / rotation, float(np.sqrt(6.0 / nats) / (2 * np.pi * seconds)) / rotation)


def order_trials(point: WorkingPoint) -> float:
    """Number of independent frequencies searched for an order: the trials behind an order of the record."""
    data = point.data
    return max(1.0, (LIMITS.max_order - LIMITS.min_order) * data.speed / (2 * np.pi) * float(data.t[-1] - data.t[0]))


def _without_lines(force: Array) -> Array:
    """A force (n,) N without its spectral lines.

    Lines of the force make lines in the motion and in every product F x. A varying stiffness makes no line in the
    force.
    """
    from scipy.fft import irfft

    Z = hann_spectrum(force.astype(np.float32)[None])[0]
    power = Z.real**2 + Z.imag**2
    lines = power > LIMITS.noise_margin_rel * np.log(Z.size / LIMITS.false_line_chance) * local_noise(
        power, LIMITS.floor_bins
    )
    if not lines.any():
        return force
    Z[np.convolve(lines, np.ones(5, bool), mode="same")] = 0.0
    return np.asarray(irfft(Z, force.size) * (force.size / 4.0))


def _peak_offset_bins(three: NDArray[np.floating[Any]]) -> float:
    """Offset of a peak from the middle of three bins, by the parabola through their logarithms, bins."""
    if three.size < 3 or three.min() <= 0.0:
        return 0.0
    a, b, c = np.log(three)
    return float(0.5 * (a - c) / (a - 2 * b + c)) if a - 2 * b + c < 0.0 else 0.0
