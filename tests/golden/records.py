"""Twelve short simulated records at fixed seeds: four complete rigs and eight rigs with a hidden effect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.rig.rig import load_rig
from estimator import CATALOGUE, Channel, EffectUse, Model, Setting, simulate
from estimator.effects import places
from estimator.effects.engine import size, strengths, with_effect

CONFIGS = Path(__file__).parents[2] / "configs"
RATE_HZ = 25600.0
NOISE = 0.02  # m/s^2 rms, white, of each accelerometer
FULL_SCALE = 490.5  # m/s^2, of the 16-bit counts
FORCE_FULL_SCALE_N = 20.0


@dataclass(frozen=True, slots=True)
class GoldenRecord:
    """A record and the model that the commands are given.

    hidden : catalogue name of the effect that the model lacks; None for a complete rig.
    fraction : size of the hidden effect over the rms bearing force.
    gap_s : start and end of missing samples, s.
    known_wrong : what is wrong with the stored verdict, one sentence; empty where the verdict is right.
    """

    name: str
    rig: Callable[[], Model]
    seed: int
    hidden: str | None = None
    fraction: float = 0.06
    seconds: float = 6.0
    gap_s: tuple[float, float] | None = None
    noise: Mapping[str, float] | float = NOISE
    known_wrong: str = ""

    def make(self) -> tuple[Model, NDArray[np.float64], float]:
        """The model, (n, channels) samples in SI with NaN where missing, and the rate in Hz."""
        model = truth = self.rig()
        if self.hidden is not None:
            effect = CATALOGUE[self.hidden]
            values = strengths(effect, size(model, "bearing1.x", RATE_HZ), self.fraction, model, self.seconds)
            at = [place for place in places(effect, model) if place.startswith("bearing1")] or places(effect, model)
            truth = with_effect(model, effect, values, *at[: 1 if effect.kind == "sensor" else None])
        full_scale = {c.name: FORCE_FULL_SCALE_N if c.kind == "force" else FULL_SCALE for c in truth.channels}
        y = simulate(truth, RATE_HZ, self.seconds, seed=self.seed, noise=self.noise, full_scale=full_scale)
        if self.gap_s is not None:
            begin, end = (round(at * RATE_HZ) for at in self.gap_s)
            y[begin:end] = np.nan
        return model, y, RATE_HZ


def four_caps() -> Model:
    """The rig of Tiwari and Vyas (1997): two bearings, soft shaft, disc resonance below the band."""
    return load_rig(CONFIGS / "tiwari_vyas_1997.toml").model


def one_bearing() -> Model:
    """One bearing of that rig, not coupled to a shaft."""
    model = four_caps()
    return replace(
        model,
        channels=tuple(c for c in model.channels if c.node == "bearing1"),
        shaft="none",
        linear={place: value for place, value in model.linear.items() if place.startswith("bearing1")},
        effects=tuple(
            replace(u, parameters={p: v for p, v in u.parameters.items() if p.startswith("bearing1")})
            for u in model.effects
        ),
    )


def disc_in_band() -> Model:
    """The four caps with the band from 60 Hz, so that the disc resonates inside the band."""
    return replace(four_caps(), band=(60.0, 8000.0))


def stiff_shaft() -> Model:
    """A shaft as stiff as the bearings, masses known."""
    rig = load_rig(CONFIGS / "strong_shaft.toml").model
    linear = {place: {"kL": Setting(1e7), "c": Setting(40.0), "S": Setting(9e-5)} for place in rig.places}
    cubic = EffectUse("cubic", {place: {"kNL": Setting(1.3e18)} for place in rig.places})
    return replace(rig, mass={"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}, linear=linear, effects=(cubic,))


def measured_force() -> Model:
    """One bearing with a force sensor in both directions."""
    model = one_bearing()
    force = tuple(Channel(f"f1{d}", "bearing1", d, "force") for d in ("x", "y"))
    return replace(model, channels=(*model.channels, *force))


RECORDS = (
    GoldenRecord("complete", four_caps, seed=101),
    GoldenRecord("complete_gap", one_bearing, seed=102, gap_s=(2.0, 2.4)),
    GoldenRecord(
        "complete_disc_in_band",
        disc_in_band,
        seed=103,
    ),
    GoldenRecord("complete_stiff_shaft", stiff_shaft, seed=104),
    GoldenRecord("clearance", four_caps, seed=105, hidden="clearance"),
    GoldenRecord("quadratic", one_bearing, seed=106, hidden="quadratic"),
    GoldenRecord("coulomb", one_bearing, seed=107, hidden="coulomb"),
    GoldenRecord("bouc_wen", one_bearing, seed=108, hidden="bouc_wen"),
    GoldenRecord("line", one_bearing, seed=109, hidden="line"),
    GoldenRecord("local_defect", one_bearing, seed=110, hidden="local_defect"),
    GoldenRecord("coloured_excitation", one_bearing, seed=111, hidden="coloured_excitation"),
    GoldenRecord(
        "quadratic_measured_force",
        measured_force,
        seed=112,
        hidden="quadratic",
        noise={"b1x": NOISE, "b1y": NOISE, "f1x": 1e-3, "f1y": 1e-3},
    ),
)
