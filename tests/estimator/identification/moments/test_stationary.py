from __future__ import annotations

import numpy as np
import pytest
from reference_samples import boltzmann, langevin

from estimator.errors import DataError
from estimator.identification.moments.planes import Cap, Plane
from estimator.identification.moments.stationary import Density, circulation, plane_diagnostics, softening_message
from estimator.results import Parameter

KL, T, MASS = 1.0e7, 4.0e-7, 0.245


def plane(ks: float = KL) -> Plane:
    return Plane("x", tuple(Cap(f"bearing{i}.x", (1, 3), MASS) for i in (1, 2)), ks=ks, a=0.5, b=-0.5)


@pytest.mark.slow
def test_density_against_an_independent_sampler() -> None:
    """emcee on the potential of physics.md section 2 written out here: moments of our density on a grid agree."""
    import emcee

    lam = 0.15 * KL / T

    def log_p(z: np.ndarray) -> float:
        x1, x2 = z * np.sqrt(T / KL)
        V = KL / 2 * (x1**2 + x2**2) + lam * KL / 4 * (x1**4 + x2**4) + KL / 4 * (x1 - x2) ** 2
        return float(-V / T)

    rng = np.random.default_rng(1)
    sampler = emcee.EnsembleSampler(16, 2, log_p)
    sampler.random_state = np.random.RandomState(5).get_state()  # noqa: NPY002 (emcee's own interface)
    sampler.run_mcmc(rng.standard_normal((16, 2)), 3000)
    z = sampler.get_chain(discard=300, flat=True)
    density = Density(plane(), ({1: KL, 3: lam * KL},) * 2, T)
    axis = np.linspace(-5.0, 5.0, 201) * np.sqrt(T / KL)
    p = density.on_grid((axis, axis)) * (axis[1] - axis[0]) ** 2
    u = axis / np.sqrt(T / KL)
    assert p.sum() == pytest.approx(1.0)
    for power in (2, 4):
        assert (p.sum(axis=1) * u**power).sum() == pytest.approx(np.mean(z[:, 0] ** power), rel=0.06)
    assert (p * np.multiply.outer(u, u)).sum() == pytest.approx(np.mean(z[:, 0] * z[:, 1]), rel=0.12)


def test_linear_density_has_the_inverse_stiffness_as_covariance() -> None:
    density = Density(plane(), ({1: KL},) * 2, T)
    axis = np.linspace(-7.0, 7.0, 301) * np.sqrt(T / KL)
    p = density.on_grid((axis, axis)) * (axis[1] - axis[0]) ** 2
    K = np.array([[1.5, -0.5], [-0.5, 1.5]]) * KL
    exact = np.linalg.inv(K) * T
    assert (p.sum(axis=1) * axis**2).sum() == pytest.approx(exact[0, 0], rel=1e-6)
    assert (p * np.multiply.outer(axis, axis)).sum() == pytest.approx(exact[0, 1], rel=1e-6)


def test_softening_without_a_barrier_is_refused() -> None:
    sigma2 = T / KL
    Density(plane(), ({1: KL, 3: -0.01 * KL / sigma2},) * 2, T).require_stationary()
    with pytest.raises(DataError, match="no stationary density"):
        Density(plane(), ({1: KL, 3: -0.05 * KL / sigma2},) * 2, T).require_stationary()


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


def test_circulation_shows_a_follower_force() -> None:
    """Cross stiffness (-kc y, +kc x) makes the orbit turn; without it nothing turns."""
    kc = 2e5
    for cross, turns in ((0.0, False), (kc, True)):
        K = np.array([[0.0, cross], [-cross, 0.0]])
        # the integrator's start needs a symmetric matrix only for its covariance; this one is close enough to it
        x, v = langevin([0.2] * 2, [60.0] * 2, [1e7] * 2, [0.0] * 2, K, [4.5e-5] * 2, 25600.0, 100_000, 4)
        found = circulation("bearing1", x[:, 0], x[:, 1], v[:, 0], v[:, 1])
        assert (abs(found.z) > 5.0) == turns
