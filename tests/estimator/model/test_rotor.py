"""The linear rotor against the paper's test vector, scipy and exact limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import eigh

from estimator.errors import ModelError
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.model.rotor import assemble, linear_covariance, propagator, rotor_of, shaft_matrix
from estimator.simulation.start import stationarity

PAPER_MASS = np.diag([0.245, 0.22, 0.515])


def small_rig(shaft: str = "chain", nodes: tuple[str, ...] = ("bearing1", "bearing2"), **linear: float) -> Model:
    values = {"kL": 1e6, "c": 40.0, "S": 1e-4} | linear
    return Model(
        channels=tuple(Channel(f"{n}{d}", n, d) for n in nodes for d in "xy"),
        band=(50.0, 2000.0),
        shaft=shaft,  # type: ignore[arg-type]
        mass={"disc": 0.515, "bearing1": 0.245, "bearing2": 0.22},
        shaft_stiffness=155e3,
        shaft_damping=0.5,
        linear={f"{n}.{d}": {k: Setting(v) for k, v in values.items()} for n in nodes for d in "xy"},
    )


def test_paper_modes() -> None:
    p, shapes = eigh(shaft_matrix("chain", 1.0), PAPER_MASS)
    shapes = shapes / shapes[-1]
    assert p == pytest.approx([0.0, 4.29974359569, 8.21083874846], rel=1e-10, abs=1e-12)
    printed = np.array([[1.0, 1.0], [-18.71356202, 18.49919407], [-0.98847879, -1.24010316]])
    np.testing.assert_allclose(shapes[:2].T, printed, rtol=1e-8)
    modal_mass = np.einsum("ij,ik,kj->j", shapes, PAPER_MASS, shapes)
    assert modal_mass == pytest.approx([0.98, 161.6018, 1.0927], rel=2e-5)  # to the digits printed


def lumped_shaft(positions: np.ndarray, bending_stiffness: float, slopes: str = "free") -> np.ndarray:
    """(n, n) N/m of a massless Euler-Bernoulli shaft with n lumped nodes, free at both ends, or every slope held."""
    n = positions.size
    K = np.zeros((2 * n, 2 * n))  # deflections, then slopes
    for i, length in enumerate(np.diff(positions)):
        a, b = 6.0 * length, length * length
        element = np.array([[12, a, -12, a], [a, 4 * b, -a, 2 * b], [-12, -a, 12, -a], [a, 2 * b, -a, 4 * b]])
        at = [i, n + i, i + 1, n + i + 1]
        K[np.ix_(at, at)] += bending_stiffness / length**3 * element
    return K[:n, :n] if slopes == "held" else K[:n, :n] - K[:n, n:] @ np.linalg.solve(K[n:, n:], K[n:, :n])


def test_chain_and_beam_are_three_nodes_of_the_general_shaft() -> None:
    EI, span = 100.0, 0.5
    positions, order = np.array([0.0, span / 2, span]), [0, 2, 1]
    free = lumped_shaft(positions, EI)[np.ix_(order, order)]
    held = lumped_shaft(positions, EI, "held")[np.ix_(order, order)]
    assert free == pytest.approx(shaft_matrix("beam", 12 * EI / span**3))
    assert held == pytest.approx(shaft_matrix("chain", 12 * EI / (span / 2) ** 3))


@pytest.mark.parametrize(("shaft", "factor"), [("chain", 2.0), ("beam", 4.0)])
def test_disc_elimination_is_exact(shaft: str, factor: float) -> None:
    w = 2 * np.pi * np.array([0.0, 35.0, 120.0, 1100.0, 8000.0])
    ks, cs, m3 = 155e3, 0.5, 0.515
    rig = small_rig(shaft)
    rotor = rotor_of(rig)
    assert rotor is not None
    x = [rig.places.index(p) for p in ("bearing1.x", "bearing2.x")]
    caps, disc = rotor.dynamic(w)[:, x][:, :, x], rotor.follows("disc.x", w)[:, x]
    full = np.multiply.outer(ks + 1j * w * cs, shaft_matrix(shaft, 1.0)) - np.multiply.outer(w**2, np.diag([0, 0, m3]))  # type: ignore[arg-type]
    for f in range(w.size):
        moved = np.array([1.0, -0.3])
        force = full[f] @ np.array([*moved, disc[f] @ moved])
        assert force[2] == pytest.approx(0.0, abs=1e-6 * ks)
        assert force[:2] == pytest.approx(caps[f] @ moved, rel=1e-9, abs=1e-9 * ks)
    kc = ks + 1j * w * cs
    if shaft == "chain":
        assert caps[:, 0, 1] == pytest.approx(-(kc**2) / (factor * kc - m3 * w**2))
        assert caps[0] == pytest.approx(ks / 2 * np.array([[1, -1], [-1, 1]]))  # what is left at zero frequency
    else:
        assert np.abs(caps[0]).max() < 1e-6 * ks


def test_linear_covariance_against_the_integral_of_the_response() -> None:
    rig = assemble(small_rig())
    Q = np.diag(rig.S / 2)
    P = linear_covariance(rig.M, rig.C, rig.K, Q)
    keep = [0, 1, 2]
    M, C, K = (A[np.ix_(keep, keep)] for A in (rig.M, rig.C, rig.K))

    def power(w: float) -> np.ndarray:
        H = np.linalg.inv(K + 1j * w * C - w**2 * M)
        return np.real(H @ Q[:3, :3] @ H.conj().T) / np.pi

    peaks = np.sqrt(eigh(K, M, eigvals_only=True))
    total = quad_vec(power, 0.0, 5e5, points=peaks, limit=2000, epsrel=1e-7)[0]
    assert P[:3, :3] == pytest.approx(total, rel=1e-4)
    assert P[:6, 6:] == pytest.approx(-P[:6, 6:].T, abs=1e-9 * np.sqrt(P[0, 0] * P[6, 6]))  # E[x v'] antisymmetric


def test_one_bearing_has_the_textbook_variance() -> None:
    rig = assemble(small_rig("none", ("bearing1",)))
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2))
    assert P[0, 0] == pytest.approx(1e-4 / (4 * 40.0 * 1e6))  # S / (4 c k)
    assert P[2, 2] == pytest.approx(1e-4 / (4 * 40.0 * 0.245))


def test_equipartition_exactly_when_noise_matches_damping() -> None:
    rig = assemble(small_rig())
    assert not stationarity(small_rig()).exact  # the shaft is damped and not driven
    C = np.diag([40.0, 60.0, 0.0])
    M, K = rig.M[:3, :3], rig.K[:3, :3]
    T = 3e-7
    P = linear_covariance(M, C, K, 2 * T * C)
    assert np.diag(M) * np.diag(P)[3:] == pytest.approx(np.full(3, T), rel=1e-6)
    assert P[:3, :3] == pytest.approx(T * np.linalg.inv(K), rel=1e-5)


def test_stationary_condition_is_reported() -> None:
    from dataclasses import replace

    exact = replace(small_rig(), shaft_damping=0.0)
    report = stationarity(exact)
    assert report.exact
    assert report.temperature == pytest.approx(1e-4 / (4 * 40.0))
    cubic = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(1e15)}})
    assert stationarity(replace(exact, effects=(cubic,))).exact
    doubled = {**exact.linear["bearing1.x"], "c": Setting(80.0)}
    unequal = replace(exact, linear={**exact.linear, "bearing1.x": doubled})
    assert stationarity(unequal).mismatch > 0.1


def test_propagator_is_the_exact_flow() -> None:
    from scipy.integrate import solve_ivp

    rig = assemble(small_rig())
    n, dt = len(rig.dofs), 1e-4
    rng = np.random.default_rng(1)
    g0, g1, u0 = rng.normal(size=n), rng.normal(size=n), rng.normal(size=2 * n) * 1e-6

    def flow(t: float, u: np.ndarray) -> np.ndarray:
        g = g0 + (g1 - g0) * t / dt
        return np.concatenate([u[n:], np.linalg.solve(rig.M, g - rig.K @ u[:n] - rig.C @ u[n:])])

    truth = solve_ivp(flow, (0, dt), u0, rtol=1e-11, atol=1e-18).y[:, -1]
    E, G0, G1 = propagator(rig.M, rig.C, rig.K, dt)
    assert E @ u0 + G0 @ g0 + G1 @ (g1 - g0) == pytest.approx(truth, rel=1e-8)


def test_what_is_missing_is_named() -> None:
    from dataclasses import replace

    rig = small_rig()
    linear = {**rig.linear, "bearing1.y": {"kL": Setting(1e6), "S": Setting(1e-4)}}
    lacking = replace(rig, mass={"bearing1": 0.2, "bearing2": 0.2}, linear=linear)
    with pytest.raises(ModelError, match=r"mass of disc.*bearing1\.y\.c"):
        assemble(lacking)
    with pytest.raises(ModelError, match="two bearings"):
        assemble(small_rig("chain", ("bearing2",)))
    with pytest.raises(ModelError, match="does not decay"):
        linear_covariance(np.eye(1), np.zeros((1, 1)), np.eye(1), np.eye(1))
    with pytest.raises(ModelError, match="does not decay"):  # a minus sign too many in a rig file
        linear_covariance(np.eye(1), np.eye(1), -np.eye(1), np.eye(1))
