"""The disc's own resonance inside the band: the bins that no filter can hold are left out, the rest are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT

from daq.rig import load_rig
from estimator.compare import compare
from estimator.simulate import simulate


@pytest.mark.slow
def test_a_sharp_disc_resonance_in_the_band_is_no_missing_force() -> None:
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    disc = 4.0 * 4e5 / (2 * np.pi * 300.0) ** 2  # 300 Hz, Q about 2000
    rig = replace(rig, shaft="beam", shaft_stiffness=4e5, shaft_damping=0.1, mass={**rig.mass, "disc": disc})
    y = simulate(rig, RATE, 12.0, seed=3, noise=0.02, full_scale=490.5)
    found = compare(rig, y, RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]
    for place in rig.places:
        p, truth = found.parameters[f"{place}.c"], rig.linear[place]["c"].value
        assert abs((p.value or 0.0) - truth) < 4.0 * (p.sd or 0.0), place
