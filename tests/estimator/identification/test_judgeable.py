"""Which places of a record are judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator import Channel, DataError, Model, Setting, simulate
from estimator.errors import NoResonanceError
from estimator.identification.judgeable import judging_layers, on_judgeable_record, survey_layers
from estimator.identification.record import UsableRecord

RATE_HZ = 8192.0
LINEAR = {"kL": Setting(1e7), "c": Setting(60.0), "S": Setting(1e-4)}
RIG = Model(
    (Channel("b1x", "bearing1", "x"), Channel("b1y", "bearing1", "y")),
    band=(150.0, 3000.0),
    mass={"bearing1": 0.5},
    linear={"bearing1.x": LINEAR, "bearing1.y": LINEAR},
)


def test_a_place_without_a_resonance_is_left_out_and_the_others_are_judged() -> None:
    y = simulate(RIG, RATE_HZ, 4.0, seed=1)
    layers = survey_layers(RIG, y, RATE_HZ)
    seen: list[tuple[str, ...]] = []

    def use(usable: UsableRecord) -> str:
        seen.append(tuple(usable.model.places))
        if "bearing1.y" in usable.model.places:
            raise NoResonanceError("no resonance of bearing1.y", "bearing1.y")
        return "; ".join(m.text for m in usable.messages)

    assert "no resonance of bearing1.y" in on_judgeable_record(RIG, y, layers, use)
    assert seen == [("bearing1.x", "bearing1.y"), ("bearing1.x",)]

    def refuse(usable: UsableRecord) -> str:
        place = usable.model.places[0]
        raise NoResonanceError(f"no resonance of {place}", place)

    with pytest.raises(DataError, match=r"no resonance of bearing1\.x"):
        on_judgeable_record(RIG, y, layers, refuse)


def test_strikes_are_sought_where_a_place_would_be_refused() -> None:
    y = simulate(RIG, RATE_HZ, 4.0, seed=1)
    t = np.arange(len(y)) / RATE_HZ
    since = t % (1.0 / 37.3)
    y += (20.0 * y.std() * np.exp(-400.0 * since) * np.sin(2 * np.pi * 2500.0 * since))[:, None]
    assert not judging_layers(RIG, y, RATE_HZ).machine.strikes
    of_unknown_mass = replace(RIG, mass={})
    layers = judging_layers(of_unknown_mass, y, RATE_HZ)
    assert layers.machine.strikes
    assert layers.structure.to_json() == survey_layers(of_unknown_mass, y, RATE_HZ).structure.to_json()
