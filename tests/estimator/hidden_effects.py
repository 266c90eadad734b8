"""Records with an effect that the rig given to the estimator does not have, and a small rig for them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.rig.rig import load_rig
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.effects.places import places
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

ROOT = Path(__file__).parents[2]
RATE = 25600.0
SECONDS = 10.0


def schema(name: str) -> dict[str, object]:
    found = next(ROOT.glob(f"tests/data/**/{name}.json"))
    return json.loads(found.read_text())


def one_bearing() -> Model:
    """One bearing of the paper's rig, uncoupled: half the work, the same statistics."""
    model = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    keep = tuple(c for c in model.channels if c.node == "bearing1")
    return replace(
        model,
        channels=keep,
        shaft="none",
        linear={k: v for k, v in model.linear.items() if k.startswith("bearing1")},
        effects=tuple(
            replace(u, parameters={k: v for k, v in u.parameters.items() if k.startswith("bearing1")})
            for u in model.effects
        ),
    )


def coupled_on_a_stiff_shaft() -> Model:
    """The rig whose shaft is as stiff as a bearing, all its numbers known, with cross-coupling at both bearings."""
    rig = load_rig(ROOT / "configs/strong_shaft.toml").model
    truth = {p: {"kL": Setting(1e7), "c": Setting(40.0), "S": Setting(9e-5)} for p in rig.places}
    coupling = EffectUse("cross_coupling", {n: {"k": Setting(1e5)} for n in ("bearing1", "bearing2")})
    return replace(rig, mass={"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}, linear=truth, effects=(coupling,))


def record(model: Model, effect: str, fraction: float, seed: int = 3, seconds: float = SECONDS) -> NDArray[np.float64]:
    e = CATALOGUE[effect]
    values = strengths(e, size(model, "bearing1.x", RATE), fraction, model, seconds)
    truth = with_effect(model, e, values, *[p for p in places(e, model) if p.startswith("bearing1")])
    return simulate(truth, RATE, seconds, seed=seed, noise=0.02, full_scale=490.5)
