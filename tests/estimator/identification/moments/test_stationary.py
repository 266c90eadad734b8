from __future__ import annotations

import numpy as np
from reference_samples import boltzmann, langevin

from estimator.identification.moments.planes import Cap, Plane
from estimator.identification.moments.stationary import plane_diagnostics, softening_message
from estimator.results import Parameter

KL, T, MASS = 1.0e7, 4.0e-7, 0.245


def plane(ks: float = KL) -> Plane:
    return Plane("x", tuple(Cap(f"bearing{i}.x", (1, 3), MASS) for i in (1, 2)), ks=ks, a=0.5, b=-0.5)


def test_fitted_softening_is_reported() -> None:
    v = np.random.default_rng(1).standard_normal((1000, 1)) * np.sqrt(T / MASS)
    one = Plane("x", (Cap("bearing1.x", (1, 3), MASS),))
    kNL = -0.1 * KL / (T / KL)
    found = {
        "bearing1.x.kL": Parameter(KL, 1e4, "N/m"),
        "bearing1.x.cubic.kNL": Parameter(kNL, -0.1 * kNL, "N/m^3"),
    }
    assert [m.code for m in softening_message(one, found, v)] == ["softens"]
    found["bearing1.x.cubic.kNL"] = Parameter(kNL, -0.4 * kNL, "N/m^3")
    assert softening_message(one, found, v) == []


def test_diagnostics_hold_for_the_hypothesis_and_their_errors_are_honest() -> None:
    """Hardening bearings: x is not Gaussian, v is; z-scores over 30 records have unit spread."""
    coupling = 0.5 * KL * np.array([[1.0, -1.0], [-1.0, 1.0]])
    z = []
    for seed in range(30):
        x = boltzmann(20_000, np.full(2, KL), np.full(2, 0.2 * KL * KL / T), coupling, T, seed)
        v = np.random.default_rng(seed + 99).standard_normal(x.shape) * np.sqrt(T / MASS)
        z.append([d.z for d in plane_diagnostics(plane(), x, v)])
    spread = np.std(z, axis=0)
    assert (spread > 0.6).all()
    assert (spread < 1.5).all()
    assert (np.abs(np.mean(z, axis=0)) < 0.7).all()


def test_equipartition_fails_for_unequal_noise() -> None:
    x, v = langevin([MASS] * 2, [60.0] * 2, [KL] * 2, [0.0] * 2, np.zeros((2, 2)), [4.5e-5, 9e-5], 25600.0, 80_000, 3)
    failed = [d.name for d in plane_diagnostics(plane(0.0), x, v) if abs(d.z) > 4.0]
    assert failed == ["m v^2 of bearing1.x over bearing2.x"]
