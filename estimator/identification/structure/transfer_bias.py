"""Causes of a biased transfer function from force to motion, and their likeliest parameters beside k and c."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.effects.excitation.pedestal import PEDESTAL
from estimator.effects.places import at, written
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.effects.sensor.sensor_resonance import SENSOR_RESONANCE
from estimator.effects.sensor.sensor_skew import SENSOR_SKEW
from estimator.likelihood.fitting.transfer_function import (
    PathSpectra,
    Peak,
    fit_linear_path,
    linear_tangent,
    maximise_path,
    noise_starts,
    path_spectra_of,
)
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.channel_response import RESPONSE_EFFECTS, fault_response, measured_force_places

from . import pedestal_form
from .spectral_models import resonance_hz

CAUSE_NUMBERS = slice(4, None)  # of the numbers of a peak, those of a cause
GAIN_STARTS = ((0.0,), (0.1,), (-0.1,), (1.0,), (-0.5,), (-2.0,))  # errors of a gain, from which searches start
SKEW_STARTS = ((0.0,), (-3.0,), (-1.0,), (1.0,), (3.0,))  # delays, samples


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TransferCause:
    """A cause that biases a transfer function, with its parameters z in coordinates of the search.

    Attributes
    ----------
    effect : str
        Name in the catalogue.
    starts : tuple of tuple of float
        Points z from which searches start.
    values : callable
        z -> parameters in SI.
    free : callable
        Parameters in SI -> z.
    bend : callable
        (path spectra, tangent (cells,) without the cause, kL, c, parameters) -> biased tangent (cells,).
    """

    effect: str
    starts: tuple[tuple[float, ...], ...]
    values: Callable[[Array], Array]
    free: Callable[[Array], Array]
    bend: Callable[[PathSpectra, Complexes, float, float, Array], Complexes]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return tuple(q.name for q in CATALOGUE[self.effect].parameters)


def _pedestal_cause(mass: float, peak: float) -> TransferCause:
    """A pedestal. mass : kg of the cap. peak : Hz, its resonance."""

    def bend(r: PathSpectra, A: Complexes, k: float, c: float, p: Array) -> Complexes:
        return np.asarray(A + pedestal_form.stiffness_lost(r.w, k, c, p) / r.w**2)

    values, free = (
        partial(pedestal_form.pedestal_values, cap_mass=mass),
        partial(pedestal_form.pedestal_coordinates, cap_mass=mass),
    )
    return TransferCause(
        effect=PEDESTAL.name, starts=pedestal_form.pedestal_starts(peak), values=values, free=free, bend=bend
    )


def _sensor_cause(
    effect: str, starts: tuple[tuple[float, ...], ...], unit: float, now: Mapping[str, float | None]
) -> TransferCause:
    """A sensor fault. now : its parameters as undone in the record. unit : SI per unit of z; 0 for z = ln(value)."""
    names = [q.name for q in CATALOGUE[effect].parameters]
    limits = np.array([(3.0, 13.0), (-1.5, 6.0)]).T

    def bend(r: PathSpectra, A: Complexes, k: float, c: float, p: Array) -> Complexes:
        own = fault_response(effect, dict(zip(names, p, strict=True)), r.w)
        return np.asarray(A * fault_response(effect, now, r.w) / own)

    if unit == 0.0:
        return TransferCause(
            effect=effect,
            starts=starts,
            values=lambda z: np.exp(np.clip(z, *limits)),
            free=np.log,
            bend=bend,
        )
    return TransferCause(effect=effect, starts=starts, values=lambda z: unit * z, free=lambda p: p / unit, bend=bend)


def transfer_causes(point: WorkingPoint, i: int, have: Mapping[str, Mapping[str, float | None]]) -> list[TransferCause]:
    """Causes that location i may have. have : by effect, parameters of those that the model has there."""
    data = point.data
    peak = resonance_hz(point, i)
    top = data.band[1]
    resonances = tuple(
        (float(np.log(top * f)), float(np.log(q))) for f in (0.25, 0.45, 0.7, 1.0, 1.4, 2.5) for q in (4, 25)
    ) + ((float(np.log(30 * top)), 0.0),)
    return [
        _pedestal_cause(float(data.mass[i]), peak),
        _sensor_cause(SENSOR_GAIN.name, GAIN_STARTS, 1.0, have.get(SENSOR_GAIN.name, {})),
        _sensor_cause(SENSOR_SKEW.name, SKEW_STARTS, 1.0 / data.rate_hz, have.get(SENSOR_SKEW.name, {})),
        _sensor_cause(SENSOR_RESONANCE.name, resonances, 0.0, have.get(SENSOR_RESONANCE.name, {})),
    ]


def fit_cause(
    point: WorkingPoint, i: int, r: PathSpectra, cause: TransferCause, base: Peak, scale: Array, starts: list[Array]
) -> Peak:  # fmt: skip
    """The likeliest fit with a cause at location i.

    base : fit without the cause. scale : of its numbers. starts : points z of the cause.
    """
    k, c = float(point.kL[i]), float(point.c[i])

    def bend(d: Array) -> Complexes:
        return cause.bend(r, linear_tangent(r, d), k + d[0], c + d[1], cause.values(d[2:]))

    wide = np.concatenate([scale, np.full(starts[0].size, 0.1)])
    peaks = [maximise_path(r, bend, np.concatenate([base.u[:4], z]), wide) for z in starts]
    best = max(peaks, key=lambda peak: peak.nats)
    again = [maximise_path(r, bend, np.concatenate([noise, best.u[2:]]), wide) for noise in noise_starts(r, best.A)]
    return max([best, *again], key=lambda peak: peak.nats)


def cause_parameters(cause: TransferCause, peak: Peak) -> dict[str, Parameter]:
    """Parameters of a cause with their standard deviations, by name."""
    z, q = peak.u[CAUSE_NUMBERS], len(cause.names)
    values = cause.values(z)
    slopes = np.stack([(cause.values(z + 1e-5 * e) - values) / 1e-5 for e in np.eye(q)])
    sd = np.sqrt(np.maximum(np.diag(slopes.T @ peak.covariance[CAUSE_NUMBERS, CAUSE_NUMBERS] @ slopes), 0.0))
    return {
        p.name: Parameter(float(v), float(s), p.unit)
        for p, v, s in zip(CATALOGUE[cause.effect].parameters, values, sd, strict=True)
    }


def pedestal_from_transfer(point: WorkingPoint, i: int) -> tuple[Array, float, float]:
    """(3,) mass, frequency and damping of the pedestal that fits the response best, and kL and c beside it."""
    r = path_spectra_of(point, i)
    base, scale = fit_linear_path(point, i, r)
    cause = transfer_causes(point, i, {})[0]
    u = fit_cause(point, i, r, cause, base, scale, [np.array(z) for z in cause.starts]).u
    return cause.values(u[4:]), float(point.kL[i] + u[2]), float(point.c[i] + u[3])


def refine_sensor_faults(model: Model, point: WorkingPoint) -> tuple[Model, dict[str, Parameter]]:
    """The model with its sensor faults one step nearer, and these parameters keyed "location.effect.name".

    The record of the point has the faults undone at their present values. Two faults of a sensor take turns.
    """
    found: dict[str, Parameter] = {}
    lines = known_lines(model)
    uses = []
    for use in model.effects:
        new = {key: dict(own) for key, own in use.parameters.items()}
        for key in at(CATALOGUE[use.name], use, model) if use.name in RESPONSE_EFFECTS else ():
            own = written(CATALOGUE[use.name], use, model, key)
            now = {n: s.value for n, s in own.items()}
            i = point.data.places.index(key)
            if key not in measured_force_places(model) or all(s.fixed for s in own.values()) or None in now.values():
                continue
            if point.kL[i] <= 0.0:
                continue
            (cause,) = (c for c in transfer_causes(point, i, {use.name: now}) if c.effect == use.name)
            starts = [cause.free(np.array([now[n] for n in cause.names])), *map(np.array, cause.starts)]
            r = path_spectra_of(point, i, lines)
            best = cause_parameters(cause, fit_cause(point, i, r, cause, *fit_linear_path(point, i, r), starts))
            new.pop(key.split(".")[0], None)
            new[key] = {n: s if s.fixed else replace(s, value=best[n].value) for n, s in own.items()}
            for n, q in best.items():
                judged = Parameter.from_estimate(q.value or 0.0, q.sd or 0.0, q.unit)
                found[f"{key}.{use.name}.{n}"] = Parameter(own[n].value, 0.0, q.unit) if own[n].fixed else judged
        uses.append(replace(use, parameters=new))
    return replace(model, effects=tuple(uses)), found
