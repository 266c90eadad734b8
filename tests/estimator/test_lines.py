"""Tones on the resonance are found, named as orders and left out; a record without any loses nothing."""

import numpy as np
from reference_rig import PLACES, RATE, TRUTH, rig_model, rig_record

from estimator import spectral
from estimator.lines import find_lines


def test_tones_on_the_resonance_do_not_disturb_the_fit() -> None:
    tones = tuple((35.0 * n, 0.2) for n in (5, 10, 31, 32, 33))
    model = rig_model("cubic", speed_rpm=2100.0)
    fit = spectral.fit(model, rig_record(12.0, seed=6, tones=tones), RATE)
    said = next(m for m in fit.messages if "lines" in m)
    assert "175 Hz" in said
    z = [
        (p.value - TRUTH[k][i]) / p.sd
        for i, q in enumerate(PLACES)
        for k in ("kL", "c")
        for p in [fit.parameters[f"{q}.{k}"]]
    ]
    assert np.sqrt(np.mean(np.square(z))) < 1.8


def test_a_smooth_spectrum_has_no_lines() -> None:
    rng = np.random.default_rng(0)
    f = 150.0 + 3.125 * np.arange(2500)
    shape = 1.0 + 500.0 / (1.0 + ((f - 1100.0) / 24.0) ** 2)  # a resonance, half-power width 48 Hz
    false = 0
    for _ in range(40):
        power = shape[:, None] * rng.gamma(90, 1 / 90, size=(2500, 4))
        false += len(find_lines(power, 120.0, f))
    assert false <= 1
    power[300] *= 3.0
    (found,) = find_lines(power, 120.0, f)
    assert found[0] < f[300] < found[1]
