"""A user's own law, with the same standing as one of the catalogue: simulated, fitted, compared, diagnosed."""

from __future__ import annotations

import dis
from dataclasses import replace

import numpy as np

from estimator.arrays import Array
from estimator.effects import NAMED
from estimator.errors import ModelError
from estimator.model.effect import Effect, EffectParameter, amplitude, searched
from estimator.model.rig import EffectUse, Setting

from .compiled import address
from .expression import compile_law
from .law_loop import force_array

SCALE_OF_UNIT = {"m": "x", "m/s": "v", "Hz": "hz_peak"}


def effect_of(use: EffectUse) -> Effect:
    """The effect that a use names: of the catalogue, or the user's own.

    Parameters
    ----------
    use : EffectUse
        An effect of a model, with its settings.

    Raises
    ------
    ModelError
        No effect has that name, or the user's law is none.
    """
    if use.custom is not None:
        return custom_effect(use)
    if use.name not in NAMED:
        raise ModelError(f"no effect {use.name!r} in the catalogue: see `rotorscope effects`, or use [[model.custom]]")
    return NAMED[use.name]


def custom_effect(use: EffectUse) -> Effect:
    """The effect of a user's own law.

    Parameters that the law is linear in are found by trying. The others are searched between their limits, or within a
    factor of 30 of their value.

    Parameters
    ----------
    use : EffectUse
        With `custom`. The effect of a module must have been loaded (`custom.effect`).

    Returns
    -------
    Effect
        Of kind force, for an expression; as the module defines it, otherwise.

    Raises
    ------
    ModelError
        In one line: the name, what is wrong, and the column of the expression.
    """
    custom = use.custom
    if custom is None:
        raise ModelError(f"effect {use.name} is not a custom one")
    if custom.effect is not None:
        return _loaded(use, custom.effect)
    if custom.expression is None:
        raise ModelError(f"custom effect {use.name}: the module {custom.module!r} has not been loaded")
    names = tuple(custom.units)
    try:
        law, used = compile_law(custom.expression, names)
    except ModelError as error:
        raise ModelError(f"custom effect {use.name}: {error}") from None
    settings = next(iter(use.parameters.values()), {})
    given = [settings.get(n, Setting()) for n in names]
    parameters = tuple(_parameter(n, custom.units[n], s) for n, s in zip(names, given, strict=True))
    effect = Effect(
        name=use.name,
        kind="force",
        parameters=parameters,
        equation=custom.expression,
        signature="the law of the user",
        confused_with=(),
        distinguish="the shape of the law itself",
        reference="the rig file",
        check="finite over the range of states that its lengths suggest",
        on_machine="what the user had in mind",
        stationary_density=used.isdisjoint({"v", "xo", "vo", "t", "phase"}),
        force=law,
    )
    p = np.array([_start(q, s) for q, s in zip(parameters, given, strict=True)])
    _refuse_not_finite(effect, p)
    linear = _linear(effect, p)
    marked = tuple(
        _with_limits(q, s) if k in linear else q for k, (q, s) in enumerate(zip(parameters, given, strict=True))
    )
    return replace(effect, parameters=marked)


def _loaded(use: EffectUse, effect: Effect) -> Effect:
    """A module's object, if it is an Effect that can work under its name."""
    name = use.name
    if not isinstance(effect, Effect):
        raise ModelError(f"custom effect {name}: the module's object is a {type(effect).__name__}, not an Effect")
    needs = {"memory": ("rates", "memory_force"), "sensor": ("apply",), "excitation": ("shape",)}.get(
        effect.kind, ("force",)
    )
    lacking = [n for n in needs if getattr(effect, n) is None]
    if lacking:
        raise ModelError(f"custom effect {name}: an Effect of kind {effect.kind} needs {' and '.join(lacking)}")
    for law, kind in ((effect.force, "force"), (effect.rates, "rates"), (effect.memory_force, "memory")):
        if law is not None:
            if any(step.opname == "RAISE_VARARGS" for step in dis.get_instructions(law)):
                raise ModelError(f"custom effect {name}: {law.__name__} raises or asserts; compiled laws cannot")
            address(law, kind)
    if effect.kind == "force":
        settings = next(iter(use.parameters.values()), {})
        given = [(q, settings.get(q.name, Setting())) for q in effect.parameters]
        _refuse_not_finite(effect, np.array([1.0 if q.linear and not s.value else _start(q, s) for q, s in given]))
    return effect


def _with_limits(q: EffectParameter, s: Setting) -> EffectParameter:
    """The parameter as an amplitude between the limits of its setting."""
    full = amplitude(q.name, q.unit, "amplitude", signed=True)
    return replace(full, low=full.low if s.low is None else s.low, high=full.high if s.high is None else s.high)


def _parameter(name: str, unit: str, s: Setting) -> EffectParameter:
    """Search range in SI from min, max and value; without any, in natural sizes by the unit."""
    if s.value is None and s.low is None and s.high is None:
        return searched(name, unit, "of the user's law", (-4.0, 4.0, 1.0), scale=SCALE_OF_UNIT.get(unit, "1"))
    value = s.value if s.value is not None else 0.5 * ((s.low or 0.0) + (s.high or 0.0))
    wide = sorted((value / 30.0, value * 30.0)) if value else [-1.0, 1.0]
    low = s.low if s.low is not None else min(wide[0], value)
    high = s.high if s.high is not None else max(wide[1], value)
    return searched(name, unit, "of the user's law", (low, high, value))


def _start(q: EffectParameter, s: Setting) -> float:
    """A value to try the law with, in SI."""
    if s.value is not None:
        return s.value
    return {"x": 1e-7, "v": 1e-3, "hz_peak": 1e3}.get(q.scale, 1.0) if q.scale != "1" else q.default


def _states(effect: Effect, p: Array, n: int) -> tuple[Array, Array, Array, Array, Array, Array]:
    lengths = [abs(a) for a, q in zip(p, effect.parameters, strict=True) if q.unit == "m" and a]
    speeds = [abs(a) for a, q in zip(p, effect.parameters, strict=True) if q.unit == "m/s" and a]
    x, v = 4.0 * max(lengths, default=2e-7), 4.0 * max(speeds, default=2e-3)
    rng = np.random.default_rng(0)
    z = rng.uniform(-1.0, 1.0, (4, n)) * np.array([x, v, x, v])[:, None]
    z[:, 0] = 0.0
    t, phase = rng.uniform(0.0, 60.0, n), rng.uniform(0.0, 1000.0, n)
    t[0] = phase[0] = 0.0
    return z[0], z[1], z[2], z[3], t, phase


def _refuse_not_finite(effect: Effect, p: Array) -> None:
    states = _states(effect, p, 2000)
    f = force_array(effect, p, *states)
    bad = np.flatnonzero(~np.isfinite(f))
    if bad.size:
        at = ", ".join(
            f"{n} = {a[bad[0]]:.3g}" for n, a in zip(("x", "v", "xo", "vo", "t", "phase"), states, strict=True)
        )
        given = ", ".join(f"{q.name} = {a:.3g}" for q, a in zip(effect.parameters, p, strict=True))
        raise ModelError(f"custom effect {effect.name}: the law is not finite at {at} with {given}")


def _linear(effect: Effect, p: Array) -> set[int]:
    """Indices of a largest set of parameters that the law is jointly linear in (homogeneous, no products)."""
    states = _states(effect, p, 400)
    rng = np.random.default_rng(1)

    def f(q: Array) -> Array:
        return force_array(effect, q, *states)

    def moved(k: int, by: float) -> Array:
        q = p.copy()
        q[k] += by * step[k]
        return q

    step = np.where(p != 0.0, np.abs(p), 1.0) * rng.uniform(0.3, 0.7, p.size)
    base = f(p)
    size = max(float(np.max(np.abs(base))), 1e-300)
    chosen: list[int] = []
    for k in range(p.size):
        one, two = f(moved(k, 1.0)) - base, f(moved(k, 2.0)) - base
        back = f(moved(k, -5.0)) - base  # across zero: |a| is not linear
        if not np.allclose(back, -5.0 * one, atol=1e-9 * max(size, float(np.max(np.abs(back))))):
            continue
        if not np.allclose(two, 2.0 * one, atol=1e-9 * max(size, float(np.max(np.abs(two))))):
            continue
        mixed = False
        for j in chosen:
            q = moved(k, 1.0)
            q[j] += step[j]
            both = f(q) - f(moved(j, 1.0))
            mixed |= not np.allclose(both, one, atol=1e-9 * max(size, float(np.max(np.abs(both)))))
        if not mixed:
            chosen.append(k)
    none = p.copy()
    none[chosen] = 0.0
    return set(chosen) if chosen and np.allclose(f(none), 0.0, atol=1e-12 * size) else set()
