"""One bearing measured on a shaft that couples it to the other."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hidden_effects import RATE, ROOT

from daq.rig.rig import load_rig
from estimator.identification.batch.spectral import fit_spectral
from estimator.identification.batch.unmeasured_end import unmeasured_end_messages
from estimator.model.rig import Model
from estimator.simulation.simulator import simulate


@pytest.fixture
def rig() -> Model:
    return load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model


def test_only_a_stiff_shaft_with_one_end_measured_has_a_message(rig: Model) -> None:
    kL = {place: rig.linear[place]["kL"].value or 0.0 for place in rig.places}
    first = replace(rig, channels=tuple(c for c in rig.channels if c.node == "bearing1"))
    own = {place: kL[place] for place in first.places}
    stiff = {"shaft_stiffness": 1e7}
    assert (
        unmeasured_end_messages(rig, kL)
        == unmeasured_end_messages(first, own)
        == unmeasured_end_messages(replace(rig, **stiff), kL)
        == ()
    )
    assert unmeasured_end_messages(replace(first, shaft="none", **stiff), own) == ()
    (message,) = unmeasured_end_messages(replace(first, **stiff), own)
    assert (message.code, message.place) == ("end_unmeasured", "bearing2")


def test_a_fit_says_so(rig: Model) -> None:
    """kL came out 7 MN/m for 10 with an interval of 0.3 %."""
    stiff = replace(rig, shaft_stiffness=1e7, effects=())
    keep = [k for k, c in enumerate(rig.channels) if c.node == "bearing1"]
    y = simulate(stiff, RATE, 3.0, seed=1, noise=0.02, full_scale=490.5)[:, keep]
    found = fit_spectral(replace(stiff, channels=tuple(rig.channels[k] for k in keep)), y, RATE)
    assert any((m.code, m.place) == ("end_unmeasured", "bearing2") for m in found.messages)
