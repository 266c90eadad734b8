"""Rotors given by matrices, against elimination frequency by frequency, the shafts of one disc, and ROSS."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.rig.rig import Rig, load_rig
from estimator.errors import ModelError
from estimator.model.rotor import assemble, rotor_of
from estimator.model.rotor_matrices import RotorMatrices, reduced_rotor

TWO_DISCS = load_rig(Path(__file__).parents[3] / "configs" / "two_discs.toml")
W = 2 * np.pi * np.array([30.0, 150.0, 410.0, 1300.0])
# damped natural frequencies below 1300 Hz without torsion that ROSS 2.3.0 gives for the script of docs/rotor-models.md
ROSS_HZ = {
    0.0: (201.8, 204.22, 253.32, 259.02, 551.99, 568.52, 987.36, 992.16),
    2980.0: (201.66, 204.34, 253.18, 259.17, 550.44, 569.89, 978.84, 1000.89),
    12000.0: (200.22, 205.48, 251.62, 260.88, 536.61, 581.1, 948.19, 1034.56),
}


def random_rotor() -> RotorMatrices:
    """Three bearings in x, one in y, a disc and two further coordinates; coupled in everything, x with y too."""
    rng, n = np.random.default_rng(3), 8
    dofs = ("a.x", "shaft1.x", "b.x", "disc.x", "c.x", "a.y", "disc.y", "shaft1.y")
    M, K, C, G = (rng.normal(size=(n, n)) for _ in range(4))
    M, K, C = M @ M.T / n + np.eye(n), 1e7 * (K @ K.T / n + np.eye(n)), 20.0 * C @ C.T / n
    return RotorMatrices(dofs=dofs, bearings=("a", "b", "c"), M=M, C=C + 100.0 * (G - G.T), K=K)


def test_the_rational_response_is_that_of_elimination_with_the_bearings_that_are_not_measured_held() -> None:
    given, places = random_rotor(), ("c.x", "a.x", "a.y")
    rotor = given.at(places)
    assert rotor is not None
    keep = [i for i, dof in enumerate(given.dofs) if dof != "b.x"]
    at = [given.only(keep).dofs.index(p) for p in places]
    inner = [i for i in range(len(keep)) if i not in at]
    disc = inner.index(given.only(keep).dofs.index("disc.y"))
    mass = np.diag([given.only(keep).bearing_mass(p) for p in places])
    for w, found, follows in zip(W, rotor.dynamic(W), rotor.follows("disc.y", W), strict=True):
        part = given.only(keep)
        D = part.K + 1j * w * part.C - w * w * part.M
        follow = -np.linalg.solve(D[np.ix_(inner, inner)], D[np.ix_(inner, at)])
        exact = D[np.ix_(at, at)] + D[np.ix_(at, inner)] @ follow
        assert found - w * w * mass == pytest.approx(exact, rel=1e-8)
        assert follows == pytest.approx(follow[disc], rel=1e-8)


def test_the_terms_are_what_comes_through_the_modes_of_the_shaft() -> None:
    rotor = random_rotor().at(("a.x", "b.x", "c.x", "a.y"))
    assert rotor is not None
    M, C, K = rotor.direct
    through = sum(matrix[:, :, None] * response(W / (2 * np.pi)) for matrix, response in rotor.terms())
    direct = K[..., None] + 1j * W * C[..., None] - W**2 * M[..., None]
    assert np.moveaxis(direct + through, 2, 0) == pytest.approx(rotor.dynamic(W), rel=1e-8)


@pytest.mark.parametrize("shaft", ["chain", "beam"])
def test_a_shaft_of_one_disc_is_a_rotor_with_one_term_for_all_places(shaft: str) -> None:
    rig = replace(TWO_DISCS.model, shaft=shaft, rotor=None, mass={"disc": 0.5}, shaft_stiffness=2e6, shaft_damping=3.0)  # type: ignore[arg-type]
    rotor = rotor_of(rig)
    assert rotor is not None
    assert len(rotor.terms()) <= 2
    assert rotor.resonances_hz == pytest.approx([np.sqrt({"chain": 2, "beam": 4}[shaft] * 2e6 / 0.5) / (2 * np.pi)])


def test_a_shaft_without_any_further_coordinate_is_its_own_matrices() -> None:
    K = 1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    rotor = RotorMatrices(dofs=("a.x", "b.x"), bearings=("a", "b"), M=np.eye(2), C=1e-5 * K, K=K).at(("b.x", "a.x"))
    assert rotor is not None
    assert rotor.dynamic(W) == pytest.approx(np.multiply.outer(1.0 + 1e-5j * W, K))
    assert rotor.terms() == rotor.resonances_hz == ()


@pytest.mark.parametrize("speed_rpm", ROSS_HZ)
def test_campbell_is_that_of_ross(speed_rpm: float) -> None:
    text = TWO_DISCS.text.replace("speed_rpm = 2980.0", f"speed_rpm = {speed_rpm}").replace("0.003", "0.0")
    for c in (160.0, 155.0, 165.0, 158.0):
        text = text.replace("c = 400.0", f"c = {c}", 1)
    rig = assemble(replace(Rig.parse(text, TWO_DISCS.base, TWO_DISCS.path).model, effects=()))
    n = len(rig.dofs)
    flow = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(rig.M, np.hstack([rig.K, rig.C]))]])
    hz = np.sort(np.linalg.eigvals(flow).imag) / (2 * np.pi)
    found = hz[(hz > 0.0) & (hz < 1300.0)]
    assert found == pytest.approx(ROSS_HZ[speed_rpm], rel=4e-4)


def test_a_rotor_that_turns_freely_is_refused() -> None:
    K = 1e6 * np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])  # bends, and costs nothing rigidly
    nodes = {name: {"x": k} for k, name in enumerate(("a", "disc", "b"))}
    plane = {"x": range(3)}
    made = reduced_rotor(
        np.eye(3), 0 * K, K, planes=plane, nodes=nodes, bearings=("a", "b"), highest_hz=1e3, damping_ratio=0.01
    )
    assert made.dofs == ("a.x", "disc.x", "b.x")
    assert made.C @ np.array([1.0, 1.0, 1.0]) == pytest.approx(np.zeros(3), abs=1e-6 * made.C.max())
    assert made.C @ np.array([-1.0, 0.0, 1.0]) == pytest.approx(np.zeros(3), abs=1e-6 * made.C.max())
    bend = np.array([1.0, -2.0, 1.0])
    assert bend @ made.C @ bend / np.sqrt((bend @ K @ bend) * (bend @ bend)) == pytest.approx(2 * 0.01)
    with pytest.raises(ModelError, match="name two bearings"):
        reduced_rotor(np.eye(3), 0 * K, K, planes=plane, nodes=nodes, bearings=("a",), highest_hz=1e3)


def test_a_simulation_needs_every_bearing() -> None:
    linear = {p: s for p, s in TWO_DISCS.model.linear.items() if not p.startswith("free")}
    with pytest.raises(ModelError, match=r"free\.x\.kL.*free\.y\.S"):
        assemble(replace(TWO_DISCS.model, linear=linear, channels=TWO_DISCS.model.channels[:2]))


def test_the_mass_of_a_cap_is_what_the_rig_file_adds_to_the_matrices() -> None:
    model, rotor = TWO_DISCS.model, TWO_DISCS.model.rotor
    assert rotor is not None
    assert model.cap_mass("drive.x") == pytest.approx(0.3 + rotor.bearing_mass("drive.x"))
    assert replace(model, mass={}).cap_mass("drive.x") == rotor.bearing_mass("drive.x") > 0.0
