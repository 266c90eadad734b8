"""Tones on the resonance are found, named as orders and left out; a record without any loses nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import one_bearing
from reference_rig import PLACES, RATE, TRUTH, rig_model, rig_record

from estimator.identification.batch import spectral as spectral
from estimator.simulation.simulator import simulate


@pytest.mark.slow
def test_tones_on_the_resonance_do_not_disturb_the_fit() -> None:
    tones = tuple((35.0 * n, 0.2) for n in (5, 10, 31, 32, 33))
    model = rig_model("cubic", speed_rpm=2100.0)
    fit = spectral.fit_spectral(model, rig_record(12.0, seed=6, tones=tones), RATE)
    said = next(m.text for m in fit.messages if m.code == "lines_left_out")
    assert "175 Hz" in said
    z = [
        (p.value - TRUTH[k][i]) / p.sd
        for i, q in enumerate(PLACES)
        for k in ("kL", "c")
        for p in [fit.parameters[f"{q}.{k}"]]
    ]
    assert np.sqrt(np.mean(np.square(z))) < 1.8


def test_a_resonance_as_narrow_as_a_bin_is_no_line() -> None:
    """Damping of 0.3 %, blocks of 80 ms: it rises from its surroundings as a tone does, and was left out of the fit; of
    the rest "no resonance" or damping 1.8 times too high was said, or that hours of record were needed."""
    rig = one_bearing()
    linear = {
        place: {n: replace(s, value=(s.value or 0.0) * (0.15 if n == "c" else 1.0)) for n, s in own.items()}
        for place, own in rig.linear.items()
    }
    light = replace(rig, effects=(), linear=linear)
    found = spectral.fit_spectral(light, simulate(light, RATE, 5.0, seed=2), RATE).parameters
    for place, own in linear.items():
        c, true = found[f"{place}.c"], own["c"].value
        assert c.value is not None
        assert c.sd is not None
        assert c.sd < 0.2 * true
        assert abs(c.value - true) < 3.5 * c.sd
