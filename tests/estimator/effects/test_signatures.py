"""Simulated runs show what the catalogue claims: orders, sidebands, whirl direction, densities, coherence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import csd, welch
from scipy.stats import kurtosis, skew

from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import Size, strengths
from estimator.errors import ModelError
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.model.rotor import assemble
from estimator.simulation.simulator import simulate

RATE, SHAFT = 25600.0, 200.0  # Hz: orders fall well inside the band
AT = Size(x=np.sqrt(9e-5 / (4 * 60 * 1e7)), v=np.sqrt(9e-5 / (4 * 60 * 0.2)), m=0.2, kL=1e7, a=40.0, c=60.0)


def use(name: str, at: str, **values: float) -> EffectUse:
    return EffectUse(name, {at: {k: Setting(v) for k, v in values.items()}})


def rig(*effects: EffectUse, S: float = 9e-5, c: float = 60.0, kind: str = "acceleration", nodes: int = 1) -> Model:
    """Isotropic bearings; one alone, or two with the disc of the paper on a stiff shaft."""
    places = [f"bearing{b + 1}.{d}" for b in range(nodes) for d in "xy"]
    return Model(
        channels=tuple(Channel(p, *p.split("."), kind) for p in places),
        band=(50.0, 8000.0),
        shaft="chain" if nodes == 2 else "none",
        mass={"bearing1": 0.2, "bearing2": 0.2, "disc": 0.515},
        shaft_stiffness=1e6,
        shaft_damping=20.0,
        speed_rpm=60 * SHAFT,
        ball_pass_order=2.1,
        linear={p: {"kL": Setting(1e7), "c": Setting(c), "S": Setting(S)} for p in places},
        effects=effects,
    )


def lines(y: np.ndarray, f_hz: float) -> complex:
    """Complex amplitude of a tone (Hann window)."""
    w = np.hanning(len(y))
    t = np.arange(len(y)) / RATE
    return complex(np.sum(w * y * np.exp(-2j * np.pi * f_hz * t)) / np.sum(w))


def spin(y: np.ndarray) -> tuple[float, float]:
    """Mean of x v_y - y v_x over its standard error; y (n, 4): x, y displacement and velocity."""
    L = y[:, 0] * y[:, 3] - y[:, 1] * y[:, 2]
    blocks = L[: len(L) // 64 * 64].reshape(64, -1).mean(axis=1)
    return float(blocks.mean()), float(blocks.mean() / (blocks.std(ddof=1) / 8))


def motion(model: Model) -> Model:
    kinds = ("displacement", "velocity")
    channels = tuple(Channel(f"{d}.{k}", "bearing1", d, k) for k in kinds for d in "xy")
    return replace(model, channels=channels)


# -- lines ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["imbalance", "bow"])
def test_1x_is_forward_and_of_the_size_of_the_linear_response(name: str) -> None:
    model = rig(use(name, "disc", a=3.0, b=-4.0), S=1e-10, nodes=2)
    y = simulate(model, RATE, 2.0, seed=1, start="rest")[int(1.2 * RATE) :]
    z = y[:, 0] + 1j * y[:, 1]
    phase = np.exp(2j * np.pi * SHAFT * 1.2)  # the slice starts there
    forward, backward = lines(z, SHAFT), lines(z, -SHAFT)
    assembled = assemble(model)
    keep = [0, 1, 2]
    M, C, K = (A[np.ix_(keep, keep)] for A in (assembled.M, assembled.C, assembled.K))
    w = 2 * np.pi * SHAFT
    force = (3 - 4j) * (np.array([0, 0, 1.0]) if name == "imbalance" else np.array([-0.5, -0.5, 1.0]))
    truth = -(w**2) * np.linalg.solve(K + 1j * w * C - w**2 * M, force)[0]
    assert forward / phase == pytest.approx(truth, rel=0.01)
    assert abs(backward) < 0.01 * abs(forward)
    assert abs(lines(z, 2 * SHAFT)) < 0.01 * abs(forward)


@pytest.mark.parametrize("shaft", ["chain", "beam"])
@pytest.mark.parametrize("hz", [3.0, 80.0, 400.0])
def test_a_bow_loads_the_caps_as_an_imbalance_of_its_eccentricity_at_every_speed(shaft: str, hz: float) -> None:
    """Newton's law for the disc: a bent shaft loads the caps as the mass that it carries round. At the disc the
    two differ by the bow, which is the run-out at slow roll."""
    model = replace(rig(nodes=2), shaft=shaft, shaft_damping=0.0)
    assembled, keep, w = assemble(model), [0, 1, 2], 2 * np.pi * hz
    M, C, K = (A[np.ix_(keep, keep)] for A in (assembled.M, assembled.C, assembled.K))
    bow = 1e-5  # m, of the disc against the line of the caps
    pull = K[2, 2] * bow  # N on the disc whose caps are held
    D = K + 1j * w * C - w**2 * M
    bent = np.linalg.solve(D, pull * np.array([-0.5, -0.5, 1.0]))
    heavy = np.linalg.solve(D, M[2, 2] * bow * w**2 * np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(bent[:2], heavy[:2], rtol=1e-9)
    assert bent[2] - heavy[2] == pytest.approx(bow, rel=1e-9)


def test_misalignment_is_at_2x_alone() -> None:
    y = simulate(rig(use("misalignment", "bearing1.x", a=1.0, b=0.0), S=1e-9), RATE, 1.0, seed=2)
    at = {order: abs(lines(y[:, 0], order * SHAFT)) for order in (1, 2, 3, 4)}
    assert at[2] > 50 * max(at[1], at[3], at[4])
    assert abs(lines(y[:, 1], 2 * SHAFT)) < 0.02 * at[2]


@pytest.mark.parametrize(("name", "at", "order"), [("ball_pass", "bearing1.x", 2.1), ("crack", "disc", 1.0)])
def test_parametric_effects_make_sidebands_of_a_tone(name: str, at: str, order: float) -> None:
    values = {"ball_pass": {"k_cos": 5e5, "k_sin": 0.0}, "crack": {"loss": 2e5, "loss_cos": 2e5, "loss_sin": 0.0}}[name]
    tone = use("line", "bearing1.x", a=2.0, b=0.0, frequency=700.0)
    with_it, without = (
        simulate(rig(tone, *more, S=1e-12, nodes=2), RATE, 1.0, seed=3) for more in ((use(name, at, **values),), ())
    )
    for side in (-1, 1):
        f = 700.0 + side * order * SHAFT
        assert abs(lines(with_it[:, 0], f)) > 100 * abs(lines(without[:, 0], f))
        assert abs(lines(with_it[:, 0], f)) > 0.002 * abs(lines(with_it[:, 0], 700.0))
    assert abs(lines(with_it[:, 0], 700.0 + 0.5 * order * SHAFT)) < 1e-3 * abs(lines(with_it[:, 0], 700.0))


def test_local_defect_is_a_comb_at_its_order() -> None:
    defect = use("local_defect", "bearing1.x", strike=3.0, order=2.1, angle=0.0, width=0.05)
    y = simulate(rig(defect, S=1e-9), RATE, 2.0, seed=4)
    comb = [abs(lines(y[:, 0], n * 2.1 * SHAFT)) for n in range(1, 8)]
    between = [abs(lines(y[:, 0], (n + 0.5) * 2.1 * SHAFT)) for n in range(1, 8)]
    assert min(comb) > 10 * max(between)
    quiet = simulate(rig(S=1e-9), RATE, 2.0, seed=4)
    assert kurtosis(y[:, 0]) > 1.0 > abs(kurtosis(quiet[:, 0])) + 0.5


def test_line_stays_when_the_speed_changes() -> None:
    from estimator.simulation.shaft_speed import ShaftSpeed

    tone = use("line", "bearing1.x", a=1.0, b=1.0, frequency=650.0)
    for rpm in (9000.0, 12000.0):
        y = simulate(rig(tone, S=1e-9), RATE, 1.0, seed=5, speed=ShaftSpeed(rpm))
        w = 2 * np.pi * 650.0
        H = -(w**2) / (1e7 - 0.2 * w**2 + 60j * w)
        assert 2 * abs(lines(y[:, 0], 650.0)) == pytest.approx(abs(H) * np.sqrt(2), rel=0.01)
        assert np.abs(lines(y[:, 0], rpm / 60)) < 0.01


# -- whirl ----------------------------------------------------------------------------------------------------------


def test_whirl_directions() -> None:
    linear = rig()
    cases = {
        "cross_coupling": use("cross_coupling", "bearing1", k=1.5e5),
        "rub": use("rub", "bearing1", k=1e6, kt=3e5, clearance=1.5 * AT.x),
        "anisotropy": use("anisotropy", "bearing1", kxy=1.5e6),
        "gyroscopic": use("gyroscopic", "bearing1", g=100.0),
    }
    models = {name: motion(replace(linear, effects=(e,))) for name, e in cases.items()}
    found = {name: spin(simulate(model, RATE, 8.0, seed=6)) for name, model in models.items()}
    assert found["cross_coupling"][1] > 8, "forward"
    assert found["rub"][1] < -5, "backward"
    # a conservative cross stiffness and gyroscopic forces leave the mean at what exp(-H/T) gives: zero
    assert abs(found["anisotropy"][1]) < 4
    assert abs(found["gyroscopic"][1]) < 4


def test_cross_coupling_becomes_unstable_at_c_times_w() -> None:
    limit = 60.0 * np.sqrt(1e7 / 0.2)
    stable = simulate(rig(use("cross_coupling", "bearing1", k=0.9 * limit)), RATE, 2.0, seed=7)
    assert np.isfinite(stable).all()
    with pytest.raises(ModelError, match="ran away"):
        simulate(rig(use("cross_coupling", "bearing1", k=1.5 * limit)), RATE, 30.0, seed=7)


def test_gyroscopic_forces_part_forward_and_backward_modes() -> None:
    g = 400.0
    y = simulate(rig(use("gyroscopic", "bearing1", g=g), kind="displacement"), RATE, 8.0, seed=8)
    f, S = welch(y[:, 0] + 1j * y[:, 1], RATE, nperseg=8192, return_onesided=False)
    a, w = g / 0.4, np.sqrt(1e7 / 0.2)
    forward, backward = f[f > 0][np.argmax(S[f > 0])], -f[f < 0][np.argmax(S[f < 0])]
    assert forward == pytest.approx((np.hypot(w, a) + a) / (2 * np.pi), abs=25)
    assert backward == pytest.approx((np.hypot(w, a) - a) / (2 * np.pi), abs=25)
    assert forward - backward > 250


def test_anisotropy_makes_the_directions_coherent() -> None:
    y = simulate(rig(use("anisotropy", "bearing1", kxy=2e6), kind="displacement"), RATE, 8.0, seed=9)
    # 45 degree axes have stiffness kL +- kxy and equal temperature: E[xy] = T/2 (1/(kL+kxy) - 1/(kL-kxy))
    T = 9e-5 / 240
    blocks = (y[:, 0] * y[:, 1]).reshape(64, -1).mean(axis=1)
    truth = 0.5 * T * (1 / 1.2e7 - 1 / 0.8e7)
    assert abs(blocks.mean() - truth) < 4 * blocks.std() / 8
    assert blocks.mean() < -4 * blocks.std() / 8


# -- densities and levels -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "moment", "sign", "fraction"),
    [
        ("cubic", "kurtosis", -1, 0.4),
        ("quintic", "kurtosis", -1, 0.5),
        ("clearance", "kurtosis", -1, 0.4),
        ("quadratic", "skew", -1, 0.1),
        ("stop", "skew", -1, 0.2),
        ("coulomb", "kurtosis", 1, 0.04),
        ("quadratic_damping", "kurtosis", -1, 0.04),
        ("displacement_damping", "kurtosis", -1, 0.04),
    ],
)
def test_displacement_density(name: str, moment: str, sign: int, fraction: float) -> None:
    values = strengths(CATALOGUE[name], AT, fraction)  # c v, what damping competes with, is 4 % of the bearing force
    model = rig(use(name, "bearing1.x", **values), kind="displacement")
    y = simulate(model, RATE, 16.0, seed=10)
    statistic = skew if moment == "skew" else kurtosis
    with_it, without = (statistic(y[:, i].reshape(32, -1), axis=1) for i in (0, 1))
    error = np.hypot(with_it.std(), without.std()) / np.sqrt(32)
    assert sign * (with_it.mean() - without.mean()) > 4 * error


def test_hysteresis_moves_stiffness_into_damping() -> None:
    """Far below slip it is a spring; far above, nearly nothing: the resonance falls with level."""
    peaks = []
    for S in (1e-7, 9e-3):
        model = rig(use("bouc_wen", "bearing1.x", k=2e6, slip=AT.x), S=S)
        f, P = welch(simulate(model, RATE, 4.0, seed=11)[:, 0], RATE, nperseg=4096)
        near = (f > 800) & (f < 1600)
        peaks.append(f[near][np.argmax(P[near] / f[near] ** 4)])
    assert peaks[0] == pytest.approx(np.sqrt(1.2e7 / 0.2) / (2 * np.pi), abs=25)
    assert peaks[1] == pytest.approx(np.sqrt(1.0e7 / 0.2) / (2 * np.pi), abs=25)


def test_pedestal_makes_two_resonances_at_the_two_mass_frequencies() -> None:
    mp, fp = 0.3, 1500.0
    model = rig(use("pedestal", "bearing1.x", mass=mp, frequency=fp, damping=0.01), c=20.0, kind="displacement")
    f, S = welch(simulate(model, RATE, 8.0, seed=12)[:, 0], RATE, nperseg=8192)
    K = np.array([[1e7, -1e7], [-1e7, 1e7 + mp * (2 * np.pi * fp) ** 2]])
    expected = np.sqrt(np.linalg.eigvals(np.diag([1 / 0.2, 1 / mp]) @ K).real) / (2 * np.pi)
    for mode in expected:
        near = np.abs(f - mode) < 150
        assert f[near][np.argmax(S[near])] == pytest.approx(mode, abs=12)


def test_drifting_stiffness_shows_in_the_halves() -> None:
    model = motion(rig(use("stiffness_drift", "bearing1.x", rate=5e5, curvature=0.0)))
    y = simulate(model, RATE, 8.0, seed=13)
    half = len(y) // 2
    stiffness = [0.2 * np.var(part[:, 2]) / np.var(part[:, 0]) for part in (y[:half], y[half:])]
    assert stiffness[1] - stiffness[0] == pytest.approx(5e5 * 4.0, rel=0.15)


# -- excitation -----------------------------------------------------------------------------------------------------


def test_correlated_forces() -> None:
    model = rig(use("correlated_force", "bearing1.x", rho=-0.6), nodes=2)
    forces = tuple(Channel(p, *p.split("."), "force") for p in model.linear)
    y = simulate(replace(model, channels=forces), RATE, 4.0, seed=14)
    R = np.corrcoef(y.T)
    assert R[0, 2] == pytest.approx(-0.6, abs=0.02)
    assert np.abs([R[0, 1], R[1, 3], R[0, 3]]).max() < 0.02


@pytest.mark.parametrize("gain", [4.0, -0.8])
def test_coloured_force(gain: float) -> None:
    model = rig(use("coloured_excitation", "bearing1.x", gain=gain, corner=900.0))
    forces = tuple(Channel(p, *p.split("."), "force") for p in model.linear)
    y = simulate(replace(model, channels=forces), RATE, 10.0, seed=15)
    f, S = welch(y, RATE, nperseg=2048, axis=0)
    keep = (f > 60) & (f < 11000)
    truth = 9e-5 * (1 + gain / (1 + (f / 900.0) ** 2))
    ratio = (S[:, 0] / truth)[keep]
    for part in np.array_split(ratio, 8):
        assert part.mean() == pytest.approx(1.0, abs=0.05)
    assert (S[keep, 1] / 9e-5).mean() == pytest.approx(1.0, abs=0.03)
    _, cross = csd(y[:, 0], y[:, 1], RATE, nperseg=2048)
    assert np.mean(np.abs(cross[keep]) ** 2 / (S[keep, 0] * S[keep, 1])) < 0.03
