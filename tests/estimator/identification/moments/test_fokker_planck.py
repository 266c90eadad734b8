from __future__ import annotations

import numpy as np
import pytest
from reference_samples import boltzmann, langevin

from estimator.errors import DataError
from estimator.identification.moments import fokker_planck
from estimator.identification.moments.fokker_planck import (
    fokker_planck_parameters,
    histogram,
    potentials,
)
from estimator.identification.moments.planes import Cap, Plane
from estimator.model.rig import Channel, EffectUse, Model, Setting

KL, T, M3 = 1.0e7, 4.0e-7, 0.515
MASS = M3 / 2.10
LAMBDA = 0.1 / (T / KL)


def strong_shaft(mass: float | None = None, ks: float = KL) -> Plane:
    caps = tuple(Cap(f"bearing{i}.x", (1, 3), mass) for i in (1, 2))
    return Plane("x", caps, ks=ks, a=0.5, b=-0.5)


def samples(n: int, seed: int, ks: float = KL, lam: float = LAMBDA) -> tuple[np.ndarray, np.ndarray]:
    coupling = 0.5 * ks * np.array([[1.0, -1.0], [-1.0, 1.0]])
    x = boltzmann(n, np.full(2, KL), np.full(2, lam * KL), coupling, T, seed)
    return x, np.random.default_rng(seed + 1000).standard_normal((n, 2)) * np.sqrt(T / MASS)


@pytest.fixture(scope="module")
def strong() -> tuple[np.ndarray, np.ndarray]:
    return samples(1_000_000, 3)


def test_response_form_recovers_masses_and_stiffness(strong: tuple[np.ndarray, np.ndarray]) -> None:
    values, cov = fokker_planck_parameters(strong_shaft(), *strong, replicates=60)
    truth = {"kL": KL, "kNL": LAMBDA * KL, "lambda": LAMBDA, "m": MASS}
    for (name, value), sd in zip(values.items(), np.sqrt(np.diag(cov)), strict=True):
        true = truth[name.rsplit(".", 1)[1]]
        assert abs(value - true) < 4.0 * sd, name
    assert M3 / values["bearing1.x.m"] == pytest.approx(2.10, rel=0.03)
    assert values["bearing1.x.kL"] == pytest.approx(KL, rel=0.04)


def test_midpoint_form_is_attenuated(strong: tuple[np.ndarray, np.ndarray]) -> None:
    """The printed unknowns make the noisy logarithm a regressor: the mass ratio comes out too large."""
    values, _ = fokker_planck_parameters(strong_shaft(), *strong, form="midpoint", replicates=2)
    assert 2.2 < M3 / values["bearing1.x.m"] < 3.2


def test_midpoint_differences_are_exact() -> None:
    """x D and G D with the exact differences of x^2/2 and x^4/4: ln(p'/p) of the true density without remainder."""
    x, v = samples(5000, 1)
    grid = histogram(x, v)
    plane = strong_shaft()
    terms, shaft = potentials(plane, grid.centres)
    energy = terms @ np.array([KL, LAMBDA * KL, KL, LAMBDA * KL]) + KL * shaft
    x1, x2 = grid.centres.T
    exact = sum(KL * z**2 / 2 + LAMBDA * KL * z**4 / 4 for z in (x1, x2)) + KL / 4 * (x1 - x2) ** 2
    np.testing.assert_allclose(energy, exact, rtol=1e-12)


def test_histogram_counts_every_sample_in_reach() -> None:
    x, v = samples(20_000, 2)
    grid = histogram(x, v)
    inside = (np.abs(x) < 4.5 * np.std(x, axis=0)).all(axis=1).sum()
    assert abs(grid.counts.sum() - inside) <= 2
    assert grid.rows.sum() == len(x)
    np.testing.assert_allclose(grid.squares.sum(axis=0), (v**2).sum(axis=0))


def test_soft_shaft_gives_no_mass() -> None:
    """ks/kL = 1e-3, the rig's order: lambda is found, mass and stiffness are not shown."""
    plane = strong_shaft(ks=1e-3 * KL)
    x, v = samples(200_000, 5, ks=1e-3 * KL)
    values, cov = fokker_planck_parameters(plane, x, v, replicates=40)
    found = plane.judged({n: (values[n], float(s)) for n, s in zip(values, np.sqrt(np.diag(cov)), strict=True)})
    assert not found["bearing1.x.m"].identifiable
    assert not found["bearing2.x.kL"].identifiable
    assert found["bearing1.x.cubic.lambda"].value == pytest.approx(LAMBDA, rel=0.4)


def test_single_degree_of_freedom_of_the_rigid_rotor() -> None:
    """The companion paper's case: one cap, its own histogram; kL from the known mass, within 1 % at 1e6 samples."""
    x = boltzmann(1_000_000, np.array([KL]), np.array([LAMBDA * KL]), np.zeros((1, 1)), T, 6)
    v = np.random.default_rng(6).standard_normal(x.shape) * np.sqrt(T / MASS)
    values, cov = fokker_planck_parameters(Plane("x", (Cap("bearing1.x", (1, 3), MASS),)), x, v, replicates=60)
    sd = np.sqrt(np.diag(cov))
    assert values["bearing1.x.kL"] == pytest.approx(KL, rel=0.015)
    assert abs(values["bearing1.x.kL"] - KL) < 4.0 * sd[0]
    assert abs(values["bearing1.x.cubic.kNL"] - LAMBDA * KL) < 4.0 * sd[1]


@pytest.mark.slow
def test_bootstrap_sd_of_correlated_samples() -> None:
    """On a record the samples hang together: the block bootstrap says so, a multinomial error would not."""
    x, v = langevin([0.2], [60.0], [1e7], [1.3e18], np.zeros((1, 1)), [4.5e-5], 25600.0, 8 * 25600, seed=3)
    plane = Plane("x", (Cap("bearing1.x", (1, 3), 0.2),))
    _, correlated = fokker_planck_parameters(plane, x, v, replicates=60)
    order = np.random.default_rng(1).permutation(len(x))
    _, shuffled = fokker_planck_parameters(plane, x[order], v[order], replicates=60)
    assert correlated[0, 0] > 9.0 * shuffled[0, 0]


def rig(places: tuple[str, ...]) -> Model:
    channels = tuple(Channel(p, *p.split("."), "displacement") for p in places)
    cubic = EffectUse("cubic", {p: {"kNL": Setting()} for p in places})
    return Model(channels, (150.0, 8000.0), mass={"bearing1": 0.2, "bearing2": 0.2}, effects=(cubic,))


def test_fit_of_a_record_in_both_directions() -> None:
    """20 s of two directions: the linear stiffness within 4 sd and 8 %, the cubic (2 % of the force) not shown."""
    x, _ = langevin([0.2, 0.2], [60.0, 55.0], [1e7, 9.2e6], [1.3e18] * 2, np.zeros((2, 2)), [4.5e-5] * 2, 25600.0,
                    10 * 25600, seed=9)  # fmt: skip
    found = fokker_planck.fit_fokker_planck(rig(("bearing1.x", "bearing1.y")), x, 25600.0, replicates=60)
    assert found.method == "fokker-planck"
    for place, kL in (("bearing1.x", 1e7), ("bearing1.y", 9.2e6)):
        p = found.parameters[f"{place}.kL"]
        assert p.value == pytest.approx(kL, rel=0.08)
        assert abs(p.value - kL) < 4.0 * p.sd
        assert not found.parameters[f"{place}.cubic.kNL"].identifiable


def test_too_few_counts_are_said() -> None:
    x, v = samples(300, 1)
    with pytest.raises(DataError, match="record longer"):
        fokker_planck_parameters(strong_shaft(MASS), x, v)
