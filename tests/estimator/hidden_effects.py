"""Records with an effect that the rig given to the estimator does not have, and a small rig for them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.rig import load_rig
from estimator.effects import CATALOGUE
from estimator.effects.places import places
from estimator.effects.strength import size, strengths, with_effect
from estimator.model import Model
from estimator.simulate import simulate

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


def record(model: Model, effect: str, fraction: float, seed: int = 3, seconds: float = SECONDS) -> NDArray[np.float64]:
    e = CATALOGUE[effect]
    values = strengths(e, size(model, "bearing1.x", RATE), fraction, model, seconds)
    truth = with_effect(model, e, values, *[p for p in places(e, model) if p.startswith("bearing1")])
    return simulate(truth, RATE, seconds, seed=seed, noise=0.02, full_scale=490.5)
