"""Simulated records with effects that the model lacks, and the errors of a result against that truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.effects import CATALOGUE, places
from estimator.effects.engine import size, strengths, with_effect
from estimator.model import Model, Setting
from estimator.results import Parameter
from estimator.simulation import simulate

RATE_HZ = 25600.0
FULL_SCALE = 490.5  # m/s^2, of the simulated counts
NOISE_RMS = 0.02  # m/s^2 rms, of the simulated sensors
FORCE_SHARES = {"weak": 0.02, "strong": 0.06}  # of the bearing force, rms
NO_HIDDEN_EFFECT = "complete"
HIDDEN_PLACES = ("bearing1", "both")


@dataclass(frozen=True, slots=True)
class Case:
    """One run: a hidden effect (or "complete"), its strength, where it acts, the seed."""

    effect: str
    strength: str
    at: str  # bearing1 | both
    seed: int

    @property
    def key(self) -> str:
        return f"{self.effect}/{self.strength}/{self.at}/{self.seed}"


def cases(
    effects: Iterable[str], strength_names: Iterable[str], at: Iterable[str], seeds: int, complete: int
) -> list[Case]:
    """Every run asked for; a complete model has only its seed."""
    out = [Case(NO_HIDDEN_EFFECT, "-", "-", s) for s in range(complete)]
    for seed in range(seeds):
        out += [Case(e, s, a, seed) for e in effects for s in strength_names for a in at if not has_one_place(e, a)]
    return out


def has_one_place(effect: str, at: str) -> bool:
    """Effects of the whole rig or of one sensor have one place only."""
    kind = CATALOGUE[effect].kind
    return at == "both" and (kind in ("disc", "shaft", "sensor") or effect == "correlated_force")


def varied(model: Model, seed: int) -> tuple[Model, float]:
    """A complete model that differs for every seed (damping, stiffness, forces, band), and the sensor noise, m/s^2."""
    rng = np.random.default_rng(1000 + seed)
    linear = {}
    for place, old in model.linear.items():
        new = dict(old)
        for name, low, high in (("kL", 0.8, 1.25), ("c", 0.4, 2.5), ("S", 0.6, 1.6)):
            new[name] = Setting((old[name].value or 0.0) * float(np.exp(rng.uniform(np.log(low), np.log(high)))))
        linear[place] = new
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
    band = float(rng.uniform(100.0, 300.0)), float(rng.uniform(5000.0, 9500.0))
    return replace(model, linear=linear, band=band), noise


def hidden(model: Model, case: Case, seconds: float) -> tuple[Model, Model, float]:
    """(what is simulated, what the diagnosis is given, sensor noise)."""
    if case.effect == NO_HIDDEN_EFFECT:
        truth, noise = varied(model, case.seed)
        return truth, replace(model, band=truth.band), noise
    return *with_hidden(model, {case.effect: case.at}, FORCE_SHARES[case.strength], seconds), NOISE_RMS


def with_hidden(model: Model, at: Mapping[str, str], fraction: float, seconds: float) -> tuple[Model, Model]:
    """(the model with effects (name -> bearing1 | both) of a fraction of the bearing force, the model without them)."""
    truth = known = replace(model, effects=tuple(u for u in model.effects if u.name not in at))
    for name, where in at.items():
        effect = CATALOGUE[name]
        can = places(effect, model)
        first = [p for p in can if p.startswith("bearing1")] or list(can)
        if effect.kind == "sensor":
            first = first[:1]
        values = strengths(effect, size(model, "bearing1.x", RATE_HZ), fraction, model, seconds)
        truth = with_effect(truth, effect, values, *(can if where == "both" else first))
    return truth, known


def record(truth: Model, seconds: float, seed: int, noise: float) -> NDArray[np.float64]:
    """(n, channels) samples, SI, as from a log: what is beyond the counts is NaN."""
    y = simulate(truth, RATE_HZ, seconds, seed=7000 + seed, noise=noise, full_scale=FULL_SCALE)
    y[np.abs(y) > (1.0 - 1e-6) * FULL_SCALE] = np.nan
    return y


def numbers(truth: Model, found: Mapping[str, Parameter]) -> dict[str, list[float]]:
    """Full name -> error of a fitted parameter over the true value, and over its standard deviation."""
    true = {
        f"{place}.{use.name}.{name}": setting.value
        for use in truth.effects for place, settings in use.parameters.items() for name, setting in settings.items()
    }  # fmt: skip
    out = {}
    for name, p in found.items():
        value = true.get(name)
        if value and p.value is not None and p.sd:
            out[name] = [(p.value - value) / abs(value), (p.value - value) / p.sd]
    return out
