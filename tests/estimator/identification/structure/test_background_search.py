"""Structural modes and spectra of the force: against the matrices that made the record, and against differences."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.fft import irfft
from scipy.signal import butter, cheby2, sosfilt
from structural_rig import CAP_MASS_KG, DAMPING_N_S_M, PART_MODE, STIFFNESS_N_M, SUPPORT_MODE

from estimator import Channel, Model, compare, fit
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.structure.cross_spectra import CrossSpectra
from estimator.identification.structure.joint_spectrum import JointSpectrum, JointValues, ModePlace
from estimator.identification.structure.spectral_problem import smooth_start
from estimator.identification.structure.thresholds import LIMITS
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import BearingBackground, StructuralMode

RATE_HZ = 8192.0


def supports(*modes: tuple[float, float, float]) -> tuple[StructuralMode, ...]:
    """Modes under the bearing. modes : mass over that of the cap, Hz, damping ratio of each."""
    return tuple(StructuralMode(form="support", mass=m * CAP_MASS_KG, frequency_hz=f, damping=z) for m, f, z in modes)


def record_with_modes(seconds: float, supports: tuple[StructuralMode, ...] = (SUPPORT_MODE,)) -> np.ndarray:
    """(n, 1) acceleration of a cap on its bearing, with modes of the support and a part on the cap."""
    n = int(seconds * RATE_HZ)
    f = np.arange(n // 2 + 1) / seconds
    s = 2j * np.pi * np.maximum(f, 1.0)
    D = STIFFNESS_N_M + DAMPING_N_S_M * s
    w0 = 2 * np.pi * PART_MODE.frequency_hz
    part = PART_MODE.mass * s**2 * (w0**2 + 2 * PART_MODE.damping * w0 * s) / PART_MODE.denominator(s)
    bearing = 1.0 / (1.0 / D + sum(mode.compliance(s) for mode in supports))
    rng = np.random.default_rng(5)
    force = rng.normal(size=f.size) + 1j * rng.normal(size=f.size)
    return irfft(force * s**2 / (CAP_MASS_KG * s**2 + bearing + part), n)[:, None] * 100.0


def rig() -> Model:
    return Model((Channel("b1x", "bearing1", "x"),), band=(100.0, 1800.0), mass={"bearing1": CAP_MASS_KG})


def test_structural_modes_are_found_and_leave_stiffness_and_damping_right() -> None:
    y = record_with_modes(24.0)
    found = fit(rig(), y, RATE_HZ)
    for name, true in (("kL", STIFFNESS_N_M), ("c", DAMPING_N_S_M)):
        parameter = found.parameters[f"bearing1.x.{name}"]
        assert parameter.value is not None
        assert parameter.sd is not None
        assert abs(parameter.value - true) < 4.0 * parameter.sd
        assert parameter.sd < 0.1 * true
    text = next(m.text for m in found.messages if m.code == "structural_modes")
    assert any(f"{hz}" in text for hz in range(287, 294))
    assert compare(rig(), y, RATE_HZ).adequate


@pytest.mark.parametrize(
    "own",
    [
        supports((3.15, 283.0, 0.03), (2.63, 516.0, 0.02)),
        supports((9.0, 341.0, 0.039), (1.5, 154.0, 0.005)),
        supports((2.0, 341.0, 0.02), (1.5, 154.0, 0.005)),
        supports((9.0, 341.0, 0.039), (3.0, 154.0, 0.005), (12.0, 600.0, 0.02)),
        supports((1.0, 200.0, 0.003), (30.0, 420.0, 0.05)),
    ],
)
def test_heavy_modes_of_the_support_are_not_taken_for_masses_on_the_cap(own: tuple[StructuralMode, ...]) -> None:
    """Masses on the cap of a softer bearing move it alike, but for their damping: kL was 0.16 of the true one."""
    found = fit(rig(), record_with_modes(24.0, own), RATE_HZ)
    kL = found.parameters["bearing1.x.kL"]
    assert kL.value == pytest.approx(STIFFNESS_N_M, rel=0.05)


def test_a_form_that_the_record_does_not_tell_widens_the_interval_of_stiffness() -> None:
    """One mode of 8 % damping beside a bearing of 9 %: under it, or on the cap of a bearing that is 20 % softer."""
    support = StructuralMode(form="support", mass=12.0 * CAP_MASS_KG, frequency_hz=420.0, damping=0.08)
    found = fit(rig(), record_with_modes(8.0, (support,)), RATE_HZ)
    kL = found.parameters["bearing1.x.kL"]
    assert kL.value is not None
    assert kL.sd is not None
    assert abs(kL.value - STIFFNESS_N_M) < 2.5 * kL.sd
    assert kL.sd > 0.02 * STIFFNESS_N_M


def test_an_unknown_filter_is_a_fall_of_the_force_spectrum_and_no_mode() -> None:
    sos = cheby2(8, 60.0, 3100.0, output="sos", fs=RATE_HZ)
    model = replace(rig(), band=(100.0, 2600.0))
    found = fit(model, sosfilt(sos, record_with_modes(24.0), axis=0), RATE_HZ)
    for name, true in (("kL", STIFFNESS_N_M), ("c", DAMPING_N_S_M)):
        parameter = found.parameters[f"bearing1.x.{name}"]
        assert parameter.value is not None
        assert parameter.value == pytest.approx(true, rel=0.05)
    text = next(m.text for m in found.messages if m.code == "structural_modes")
    assert len(text.split(",")) == 2, text


def test_a_filter_near_the_upper_edge_of_the_band_is_no_mode_there() -> None:
    """The flank of a mode above the edge is not identifiable beside a roll-off of the force."""
    sos = butter(8, 1900.0, output="sos", fs=RATE_HZ)
    background = fit_all_effects(rig(), sosfilt(sos, record_with_modes(16.0), axis=0), RATE_HZ).model.background
    assert background is not None
    assert len(background.at["bearing1.x"].modes) == 2


def test_a_value_at_its_limit_does_not_hold_the_others_back() -> None:
    """A part on the cap that is damped beyond the limit of a mode: all else is at its likeliest value beside it."""
    f = np.linspace(150.0, 900.0, 250)
    s = 2j * np.pi * f
    part = StructuralMode(form="attached", mass=0.05, frequency_hz=600.0, damping=0.3)
    Z0 = (s * s + part.attached_stiffness(s))[:, None, None]
    kL, c, n = (2.0 * np.pi * 400.0) ** 2, 60.0, np.full(f.size, 400.0)
    power = np.abs(s**2 / (Z0[:, 0, 0] + kL + c * s)) ** 2 + 1e-3
    problem = JointSpectrum(
        spectra=CrossSpectra(
            places=(0,), f_hz=f, psd=power[:, None, None].astype(complex), n=n, noise=np.ones((f.size, 1))
        ),
        Z0=(s * s)[:, None, None], laws=np.zeros((f.size, 1), complex), mass=np.ones(1), shape=np.ones((f.size, 1)),
        damping0=np.log([c]),
    )  # fmt: skip
    start = JointValues(
        force=np.zeros((1, 1)), noise=np.log([1e-3]), stiffness=np.log([0.8 * kL]), damping=np.log([2.0 * c])
    ).with_mode(ModePlace(0, "attached"), np.log([500.0, 0.02, 0.02]))
    found = problem.maximised(start)
    assert np.exp(found.values.q[0, 1]) == pytest.approx(LIMITS.damping_ratio_limits[1])
    free = np.arange(found.values.vector().size) != found.values.vector().size - 2
    J, r = problem.score(found)
    left_nats = 0.5 * (J[free] @ r) @ np.linalg.solve(J[free] @ J[free].T, J[free] @ r)
    assert left_nats < 1.0


def test_a_band_that_just_holds_one_more_spline_is_searched() -> None:
    """The cells of a scan span the band, as its splines do."""
    f = np.linspace(100.0, 100.0 * 2.0 ** (2.0 * LIMITS.plain_octaves) * 1.001, 250)
    s, kL, c = 2j * np.pi * f, (2.0 * np.pi * 150.0) ** 2, 60.0
    power = np.abs(s**2 / (s**2 + kL + c * s)) ** 2 + 1e-3
    spectra = CrossSpectra(
        places=(0,), f_hz=f, psd=power[:, None, None].astype(complex), n=np.full(250, 40.0), noise=np.ones((250, 1))
    )
    problem = JointSpectrum(
        spectra=spectra, Z0=(s * s)[:, None, None], laws=np.zeros((250, 1), complex), mass=np.ones(1),
        shape=np.ones((250, 1)), damping0=np.log([c]), shaft=np.zeros((250, 1, 1), complex),
    )  # fmt: skip
    data = SimpleNamespace(mass=np.ones(1), band=(f[0], f[-1]))
    point = SimpleNamespace(data=data, S=np.ones(1), nu=np.array([1e-3]), kL=np.array([0.5 * kL]), c=np.array([c]))
    _, found = smooth_start(problem, cast(WorkingPoint, point))
    assert np.exp(found.values.stiffness[0]) == pytest.approx(kL, rel=0.01)


def test_derivatives_of_the_likelihood_are_those_of_its_differences() -> None:
    rng = np.random.default_rng(0)
    f = np.linspace(50.0, 800.0, 200)
    s, mass = 2j * np.pi * f, np.array([1.0, 1.2])
    kL = mass * (2 * np.pi * np.array([300.0, 340.0])) ** 2
    shaft = 3e5 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    A = rng.normal(size=(200, 2, 2)) + 1j * rng.normal(size=(200, 2, 2))
    spectra = CrossSpectra(
        places=(0, 1), f_hz=f, psd=A @ A.conj().swapaxes(1, 2) + np.eye(2), n=np.full(200, 7.0), noise=np.ones((200, 2))
    )
    problem = JointSpectrum(
        spectra=spectra, Z0=shaft + (s**2)[:, None, None] * np.diag(mass), laws=np.zeros((200, 2), complex), mass=mass,
        shape=np.ones((200, 2)), damping0=np.log([60.0, 80.0]), octaves=1.0, fall_power=8, loose=(1,),
        shaft=np.broadcast_to(shaft, (200, 2, 2)).astype(complex),
    )  # fmt: skip
    values = JointValues(
        force=0.1 * rng.normal(size=(2, problem.basis.shape[1])), noise=np.log([0.1, 0.2]), stiffness=np.log(kL),
        damping=np.log([60.0, 80.0]), heavier=np.array([0.3]),
    )  # fmt: skip
    values = values.with_mode(ModePlace(1, "support"), np.log([200.0, 0.02, 5.0]))
    values = values.with_mode(ModePlace(0, "attached"), np.log([400.0, 0.02, 0.05]))
    J, r = problem.score(problem.at(values))
    for k, slope in enumerate(J @ r):
        if k < 2 * problem.basis.shape[1]:
            continue  # the prior of the spline is not part of the score
        step = 1e-5 * np.eye(r.size and len(J))[k]
        up, down = (problem.at(values.at_vector(values.vector() + d)).log_likelihood for d in (step, -step))
        assert (up - down) / 2e-5 == pytest.approx(slope, rel=1e-4, abs=1e-2)


def test_a_stiff_support_is_no_support_and_a_part_far_above_is_mass() -> None:
    f = np.array([100.0])
    s = 2j * np.pi * f
    rigid = StructuralMode(form="support", mass=1e6, frequency_hz=400.0, damping=0.01)
    light = StructuralMode(form="attached", mass=0.1, frequency_hz=1e5, damping=0.01)
    own = BearingBackground(
        modes=(rigid, light), stiffness=1e7, damping=10.0, f_hz=np.array([50.0, 500.0]), psd_rel=np.ones(2)
    )
    assert own.deflection(s) == pytest.approx(1.0, abs=1e-4)
    assert own.attached_stiffness(s)[0].real == pytest.approx(0.1 * (s[0] ** 2).real, rel=1e-4)
