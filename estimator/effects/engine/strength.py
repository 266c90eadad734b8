"""How large an effect naturally is on a given rig: search ranges, and parameters for a wanted strength."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.effects.places import kinematic, places
from estimator.model.effect import Effect, EffectParameter
from estimator.model.rig import EffectUse, Model, Setting
from estimator.model.rotor import assemble, linear_covariance

from .law_loop import force_array
from .memory_loop import memory_array

RMS_STATE_COUNT = 4096  # Gaussian states that the rms of a law is taken over

WEAK_SHARE = 0.02  # of the rms bearing force, of a hidden effect
WEAK_MAX_SHARE = 0.03  # a wanted fraction up to this is a weak case


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """Natural sizes at a location.

    x, v, a : rms displacement, velocity and acceleration, m, m/s, m/s^2. m : mass of the cap, kg. kL : stiffness, N/m.
    c : damping, N s/m. rate_hz : sampling rate, Hz. band_hz : upper edge of the band, Hz.
    """

    x: float
    v: float
    m: float
    kL: float
    a: float = 1.0
    c: float = 0.0
    rate_hz: float = 25600.0
    band_hz: float = 8000.0

    @property
    def force(self) -> float:
        """Rms of the linear bearing force, N."""
        return self.kL * self.x

    def of(self, parameter: EffectParameter) -> float:
        """Natural size, SI, of which low, high and default of a searched parameter are multiples."""
        known = {
            "x": self.x,
            "v": self.v,
            "a": self.a,
            "m": self.m,
            "hz_peak": np.sqrt(abs(self.kL) / self.m) / (2.0 * np.pi),  # below 0 in a fit far from the rotor
            "sample": 1.0 / self.rate_hz,
            "band": self.band_hz,
        }
        return float(known.get(parameter.scale, 1.0))


def size(model: Model, place: str, rate_hz: float = 25600.0) -> Size:
    """Natural sizes of the motion at a location, from the linear model alone.

    Parameters
    ----------
    model : Model
        The rig, all linear values and masses known.
    place : str
        "bearing1.x"; "bearing1" means its x, "disc" the first cap.
    rate_hz : float
        Sampling rate, Hz.

    Returns
    -------
    Size
        rms of displacement, velocity and acceleration, and the linear values, SI.

    Raises
    ------
    ModelError
        A linear value or a mass is unknown.
    """
    rig = assemble(model)
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2.0))
    direction = place.split(".")[1] if "." in place else "x"
    caps = [f"{place.split('.')[0]}.{direction}", *rig.dofs]
    i = rig.index(next(d for d in caps if d in rig.dofs and d.split(".")[0] in model.bearings))
    n, low, high = len(rig.dofs), *model.band
    a = float(np.sqrt(rig.S[i] * (high - low)) / rig.M[i, i])  # the force itself, in the band: most of an acceleration
    linear = model.linear[rig.dofs[i]]
    return Size(
        x=float(np.sqrt(P[i, i])),
        v=float(np.sqrt(P[n + i, n + i])),
        m=float(rig.M[i, i]),
        kL=float(linear["kL"].value or 0.0),
        a=a,
        c=float(linear["c"].value or 0.0),
        rate_hz=rate_hz,
        band_hz=high,
    )


def search_range(parameter: EffectParameter, at: Size) -> tuple[float, float]:
    """SI limits between which a nonlinear parameter is searched."""
    unit = at.of(parameter)
    return parameter.low * unit, parameter.high * unit


def defaults(effect: Effect, at: Size, model: Model | None = None) -> NDArray[np.float64]:
    """(k,) SI: 1 for linear parameters, the natural default of the others, kinematic numbers where the rig has them."""
    out = []
    for p in effect.parameters:
        known = kinematic(p.scale, model) if model is not None else None
        out.append(1.0 if p.linear else known if known is not None else p.default * at.of(p))
    return np.array(out, dtype=np.float64)


def rms(effect: Effect, p: NDArray[np.float64], at: Size, seconds: float = 60.0) -> float:
    """Rms of an effect's force, N, over Gaussian independent x, v of both directions, times and shaft angles.

    A memory effect is driven by a harmonic of the rig's own frequency and rms. An effect on disc or shaft is taken at
    the cap's motion: only its order of size is meant.
    """
    rng = np.random.default_rng(0)
    if effect.kind == "memory":
        w = np.sqrt(at.kL / at.m)
        rate = 100.0 * w / (2 * np.pi)
        t = np.arange(RMS_STATE_COUNT) / rate
        x, v = np.sqrt(2) * at.x * np.sin(w * t), np.sqrt(2) * at.x * w * np.cos(w * t)
        f = memory_array(effect, p, np.array([at.m, at.kL, at.c]), x, v, rate)
        return float(np.sqrt(np.mean(f[RMS_STATE_COUNT // 2 :] ** 2)))
    z = rng.standard_normal((4, RMS_STATE_COUNT)) * np.array([at.x, at.v, at.x, at.v])[:, None]
    t, phase = rng.uniform(0.0, seconds, RMS_STATE_COUNT), rng.uniform(0.0, 200.0 * np.pi, RMS_STATE_COUNT)
    f = force_array(effect, p, z[0], z[1], z[2], z[3], t, phase)
    return float(np.sqrt(np.mean(f**2)))


def strengths(
    effect: Effect, at: Size, fraction: float = WEAK_SHARE, model: Model | None = None, seconds: float = 60.0
) -> dict[str, float]:
    """Parameters of an effect of a wanted strength.

    Searched parameters take their natural default. An effect whose strength is no force has its `typical` values: a
    fraction up to 3 % gives the weak one, more the strong one.

    Parameters
    ----------
    effect : Effect
        Of the catalogue or the user.
    at : Size
        Natural sizes at its location.
    fraction : float
        rms force of the effect over the rms linear bearing force.
    model : Model or None
        The rig, for kinematic orders and the stiffness of the shaft. None: the effect's defaults.
    seconds : float
        Length of the record, s, for effects that change with time.

    Returns
    -------
    dict of str to float
        Parameter name -> value in SI.

    Raises
    ------
    ValueError
        No parameter sets the effect's strength.
    """
    p = defaults(effect, at, model)
    names = [q.name for q in effect.parameters]
    linear = [k for k, q in enumerate(effect.parameters) if q.linear]
    p[linear[1:]] *= [effect.parameters[k].share for k in linear[1:]]
    for name, (weak, strong) in effect.typical.items():
        k = names.index(name)
        value = weak if fraction <= WEAK_MAX_SHARE else strong
        if effect.parameters[k].scale != "shaft":
            p[k] = value * at.of(effect.parameters[k])
            return dict(zip(names, p.tolist(), strict=True))
        if model is not None:  # a shaft has no more than its own stiffness to lose
            p[linear] *= value * model.shaft_stiffness
            return dict(zip(names, p.tolist(), strict=True))
    if not linear:
        raise ValueError(f"{effect.name}: no parameter sets its strength")
    p[linear] *= fraction * at.force / rms(effect, p, at, seconds)
    return dict(zip(names, p.tolist(), strict=True))


def with_effect(model: Model, effect: Effect, parameters: Mapping[str, float], *at: str) -> Model:
    """A model with one more effect.

    Parameters
    ----------
    model : Model
        The rig; it is not changed.
    effect : Effect
        Of the catalogue.
    parameters : mapping of str to float
        Parameter name -> value in SI, one for all locations.
    *at : str
        Canonical locations. Without any: everywhere the effect can act.

    Returns
    -------
    Model
        A copy with the effect behind the others.
    """
    where = at or places(effect, model)
    settings = {place: {k: Setting(v) for k, v in parameters.items()} for place in where}
    return replace(model, effects=(*model.effects, EffectUse(effect.name, settings)))
