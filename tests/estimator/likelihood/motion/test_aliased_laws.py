"""A smooth law at so high a resonance that its harmonics fold back into the band."""

import numpy as np
import pytest
from reference_samples import langevin
from scipy.signal import firwin, oaconvolve

from estimator.effects import CATALOGUE
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.batch.spectral import fit_spectral
from estimator.likelihood.motion.law_smoothing import harmonics_alias, highest_harmonic
from estimator.model.rig import Channel, EffectUse, Model

RATE, HZ, BAND, FINER = 12800.0, 3000.0, (400.0, 5760.0), 8


@pytest.mark.parametrize(
    ("effect", "order"), [("cubic", 3), ("quintic", 5), ("quadratic", 2), ("ball_pass", 1), ("displacement_damping", 3)]
)
def test_the_harmonics_of_a_law(effect: str, order: int) -> None:
    law = CATALOGUE[effect]
    p = np.array([1.0 if q.linear else q.default for q in law.parameters])
    scale = np.array([1e-7, 1e-7 * 2 * np.pi * 1000.0, 0.0, 0.0])  # 1000 Hz
    assert highest_harmonic(law, p, scale) == order
    assert harmonics_alias(law, p, scale, 1000.0 * order)
    assert not harmonics_alias(law, p, scale, 1200.0 * order)


@pytest.mark.slow
def test_a_cubic_at_a_resonance_near_a_third_of_the_rate() -> None:
    """10 s: kNL and kL were 4 to 6 standard deviations off."""
    m, w = 0.2, 2 * np.pi * HZ
    k, c = m * w**2, 2 * 0.02 * m * w
    x2 = 1e-14
    kNL = 0.02 * k / x2 / np.sqrt(15.0)
    n, Q = int(10 * RATE) * FINER, 2 * c * k * x2
    fine, _ = langevin([m], [c], [k], [kNL], np.zeros((1, 1)), [Q], RATE * FINER, n, 1)
    taps = firwin(641, 0.47 / FINER * 2, window=("kaiser", 9.0))
    x = oaconvolve(fine[:, 0], taps, mode="same")[::FINER]
    channel = (Channel("d", "bearing1", "x", "displacement"),)
    model = Model(channel, BAND, "none", {"bearing1": m}, effects=(EffectUse("cubic", {"bearing1.x": {}}),))
    for found in (
        fit_spectral(model, x[:, None], RATE).parameters,
        fit_all_effects(model, x[:, None], RATE).parameters,
    ):
        for name, true in (("kL", k), ("c", c), ("cubic.kNL", kNL)):
            p = found[f"bearing1.x.{name}"]
            assert p.value is not None
            assert p.sd is not None
            assert abs(p.value - true) < 3.0 * p.sd, name
