"""Score matching of a model: a rolling estimator, and the fit of a record.

The channels are band-limited to displacement, velocity and acceleration, and the stiffness of each direction follows
from their moments.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at
from estimator.errors import DataError
from estimator.likelihood.motion.force_balance import motion_channels
from estimator.likelihood.motion.prepare import check_moves, check_shape
from estimator.model.rig import Model
from estimator.results import Estimate, Fit, Message, Parameter
from estimator.signals.band_limit import BandLimit
from estimator.signals.band_limited_record import band_limit
from estimator.signals.channel_response import anti_alias_response

from .plane_moments import Form, PlaneMoments
from .planes import Plane, density_band, ignored_effects, planes_of
from .stationary import check_resonance, density_messages, softening_message
from .synchronous import synchronous_lines, synchronous_message, synchronous_orders
from .thresholds import LIMITS

LEFT_OUT_REASON = "score matching leaves it out: use the spectral method"


class RollingScoreMatching:
    """Linear and cubic stiffness of a rig while samples arrive, by score matching.

    Old samples are forgotten exponentially. Inside, the motion is cut into blocks of a hundredth of the time constant
    at fixed absolute positions; the estimate changes once per such block, and does not depend on how the rows arrived.
    Rows near a gap (NaN) are left out, and time still passes.

    Parameters
    ----------
    model : Model
        The rig. The effects quadratic, cubic and quintic are estimated, the others are left out.
    rate_hz : float
        Sampling rate, Hz.
    time_constant_s : float
        Time after which a sample counts 1/e, s.

    Raises
    ------
    ValueError
        The time constant is not positive.

    Notes
    -----
    ``update(block)`` takes the next rows, (n, channels) float64 in SI units, columns in the order of
    ``model.channels``, NaN where a sample is missing or clipped. It never raises on data, does not change the block and
    keeps no reference to it. ``snapshot()`` returns an `Estimate` and has no side effect.

    References
    ----------
    Hyvarinen, J. Mach. Learn. Res. 6 (2005) 695.
    """

    def __init__(self, model: Model, rate_hz: float, time_constant_s: float) -> None:
        if not time_constant_s > 0.0:
            raise ValueError(f"time constant {time_constant_s} s must be positive")
        self.model = model
        self._columns = motion_channels(model)
        kinds = [model.channels[i].kind for i in self._columns]
        undone = anti_alias_response(model, rate_hz)
        self._stream = BandLimit(kinds, rate_hz, density_band(model)[0], undone=undone)
        self._planes = [(PlaneMoments(p), place_columns(model, p.direction)) for p in planes_of(model)]
        self._rows = max(256, round(time_constant_s * rate_hz / 100.0))
        self._forget = math.exp(-self._rows / (time_constant_s * rate_hz))
        self._held = np.empty((2, len(kinds), 0))
        self._recent: deque[Array] = deque(maxlen=max(1, round(LIMITS.resonance_check_s * rate_hz / self._rows)))
        self._missing = "warming up"  # status while no resonance has been found; empty afterwards
        self._rate_hz, self._orders = rate_hz, synchronous_orders(model)
        self._index = 0
        self._beside = _ignored_parameters(model)

    def update(self, block: Array) -> None:
        """Take the next rows, (n, channels), SI; NaN where a sample is missing or clipped."""
        motion = self._stream.push(block[:, self._columns])
        if not motion.rows:
            return
        fresh = np.stack([motion.x, motion.v])
        if not motion.valid.all():
            fresh[:, :, ~motion.valid] = np.nan
        self._held = np.concatenate([self._held, fresh], axis=2)
        used = 0
        while self._held.shape[2] - used >= self._rows:
            x, v = self._motion(self._held[:, :, used : used + self._rows])
            for moments, columns in self._planes:
                moments.add(x[columns].T, v[columns].T, self._forget)
            if self._missing:
                self._look_for_resonance(v)
            used += self._rows
        self._held = self._held[:, :, used:].copy()
        self._index += used

    def _look_for_resonance(self, v: Array) -> None:
        """Check for a resonance once resonance_check_s of motion is there. v : (places, rows) of one block, m/s."""
        if not np.isfinite(v).all():
            return
        self._recent.append(v)
        if len(self._recent) < (self._recent.maxlen or 1):
            return
        recent, band = np.concatenate(self._recent, axis=1), density_band(self.model)[0]
        self._recent.clear()
        try:
            for speed, column in zip(recent, self._columns, strict=True):
                if speed.any():  # a channel that does not move gets a status of its own
                    check_resonance(speed, self._rate_hz, band, self.model.channels[column].name)
            self._missing = ""
        except DataError as e:
            self._missing = str(e)

    def _motion(self, block: Array) -> Array:
        """x, v of one block, (2, places, rows), without the shaft orders of the model's effects."""
        if not self._orders or self.model.speed_rpm is None:
            return block
        flat = block.reshape(-1, block.shape[-1]).T
        hz = self.model.speed_rpm / 60.0
        flat = flat - synchronous_lines(flat, self._rate_hz, hz, self._orders, len(flat) / self._rate_hz)
        return flat.T.reshape(block.shape)

    def snapshot(self) -> Estimate:
        """The estimate up to the last complete internal block."""
        parameters: dict[str, Parameter] = {}
        rows = min((m.moments.rows for m, _ in self._planes), default=0.0)
        if min((m.moments.blocks for m, _ in self._planes), default=0.0) < 8.0 or rows < LIMITS.min_rows / 4:
            return Estimate(self._index, parameters, rows, status="warming up")
        if self._missing:
            return Estimate(self._index, parameters, rows, status=self._missing)
        for moments, _ in self._planes:
            parameters |= moments.parameters()
        parameters |= self._beside
        still = next(filter(None, (moments.still() for moments, _ in self._planes)), "")
        return Estimate(self._index, parameters, rows, status=still or "ok")


def _ignored_parameters(model: Model) -> dict[str, Parameter]:
    """Parameters of the effects that the method leaves out, by full name, each with the reason."""
    out: dict[str, Parameter] = {}
    for use in (u for u in model.effects if u.name in ignored_effects(model)):
        effect = effect_of(use)
        for key in at(effect, use, model):
            for q in effect.parameters:
                name = f"{key}.{use.name}.{q.name}"
                out[name] = Parameter(None, None, q.unit, identifiable=False, reason=LEFT_OUT_REASON)
    return out


def fit_score_matching(model: Model, y: Array, rate_hz: float, form: Form = "velocity") -> Fit:
    """Linear, quadratic, cubic and quintic stiffness of a record y (n, channels), SI, NaN where a sample is missing.

    form : estimating equation: "velocity" for records, "density" for independent samples.
    Raises DataError if too few rows are valid, a channel does not move, or no resonance is in the band.
    """

    def parameters(plane: Plane, x: Array, v: Array) -> tuple[dict[str, Parameter], list[Message]]:
        moments, size = PlaneMoments(plane, form), max(1, len(x) // LIMITS.fit_blocks)
        for first in range(0, len(x), size):
            moments.add(x[first : first + size], v[first : first + size])
        return moments.parameters(), []

    return density_fit(model, y, rate_hz, "score-matching", parameters)


def density_fit(
    model: Model, y: Array, rate_hz: float, method: str,
    parameters: Callable[[Plane, Array, Array], tuple[dict[str, Parameter], list[Message]]],
) -> Fit:  # fmt: skip
    """The fit of a record by the stationary density, direction by direction, with its messages.

    parameters : of a plane, from its displacements and velocities (n, caps), m and m/s, and messages.
    """
    x, v, valid = density_motion(model, y, rate_hz)
    found: dict[str, Parameter] = {}
    notes: list[Message] = []
    for plane in planes_of(model):
        columns = place_columns(model, plane.direction)
        here, speed = (z[valid][:, columns] for z in (x, v))
        fitted, said = parameters(plane, here, speed)
        found |= fitted
        notes += density_messages(plane, here, speed) + softening_message(plane, found, speed) + said
    for k, place in enumerate(model.places):
        notes += synchronous_message(model, place, x[valid, k], v[valid, k], rate_hz)
    if ignored := ignored_effects(model):
        text = f"{method} fits only powers of the displacement; left out: {', '.join(ignored)}"
        notes.append(Message("effects_ignored", text))
    messages = tuple(dict.fromkeys(notes))
    return Fit(parameters=found, log_likelihood=None, samples=int(valid.sum()), method=method, messages=messages)


def density_motion(model: Model, y: Array, rate_hz: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Band-limited displacement and velocity, (n, places) each, SI, and (n,) which rows are valid.

    Raises DataError if the record does not fit the model, a channel does not move, too few rows are valid, or no
    resonance is in the band.
    """
    y = check_shape(model, y)
    columns = motion_channels(model)
    kinds = [model.channels[i].kind for i in columns]
    for i in columns:
        check_moves(model.channels[i].name, y[np.isfinite(y[:, i]), i])
    band, _ = density_band(model)
    motion = band_limit(y[:, columns], kinds, rate_hz, band, undone=anti_alias_response(model, rate_hz))
    usable = int(motion.valid.sum())
    if usable < LIMITS.min_rows:
        raise DataError(
            f"{usable} usable samples of {len(y)} (band filter and gaps take the rest), {LIMITS.min_rows} needed: "
            "record longer, or widen the band at its low end"
        )
    parts = np.concatenate([motion.x, motion.v]).T
    orders = synchronous_orders(model)
    if orders and model.speed_rpm is not None:
        parts = np.where(motion.valid[:, None], parts, np.nan)
        parts = parts - synchronous_lines(parts, rate_hz, model.speed_rpm / 60.0, orders)
    x, v = np.split(parts, 2, axis=1)
    for k, i in enumerate(columns):
        check_resonance(v[motion.valid, k], rate_hz, band, model.channels[i].name)
    return x, v, motion.valid


def place_columns(model: Model, direction: str) -> list[int]:
    """Positions in `model.places` of the caps of one direction."""
    return [k for k, place in enumerate(model.places) if place.endswith("." + direction)]
