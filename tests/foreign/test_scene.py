"""Realistic records against exact results: transfer functions, harmonics, strikes; and the judge."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from .campaign import truth_of, wilson
from .judge import HONEST, LATE, RIGHT, WRONG, judge
from .machine import Machine
from .recorder import recorded, rig_file
from .scene import KINDS, NOTHING, Scene, draw

SILENT = {"level": 0.0, "white": 0.0, "pink": 0.0, "hum": (), "once": 0.0, "twice": 0.0, "sway": 0.0}


def still(scene: Scene, **changes: Any) -> Scene:
    """The scene at a low rate without what is not asked for; its structure, colour and filter stay."""
    return replace(scene, cubic=False, around=replace(scene.around, **(SILENT | changes)))


def test_a_record_has_the_spectrum_of_its_transfer_functions() -> None:
    """Modes of the support and on the cap, a coloured force, the mounting and the recorder's filter, all at once."""
    scene = next(s for s in (draw("complete", seed, (200.0, 201.0)) for seed in range(99)) if s.rate_hz == 1600.0)
    scene = still(replace(scene, sensor="acceleration", unit="g"), ac_hz=0.0, filter=("butterworth", 6, 640.0),
                  mount=(2000.0, 10.0))  # fmt: skip
    machine = Machine(scene)
    name, place = scene.channels[0], scene.measured[0]
    y = recorded(machine, machine.moved())[name] * 9.80665
    f, found = signal.welch(y, scene.rate_hz, nperseg=4096)
    rotor, w = machine.rotor, 2 * np.pi * f
    exact = np.zeros(len(f))
    for k in np.flatnonzero(rotor.S):
        G = np.array([machine.receptance(one)[machine.at[place], k] for one in w])
        zero, pole = scene.around.colour[next(p for p in scene.places if machine.at[p] == k)]
        exact += rotor.S[k] * np.abs(w**2 * G) ** 2 * (1 + (f / zero) ** 2) / (1 + (f / pole) ** 2)
    mount = 1 / np.abs(1 - (f / 2000) ** 2 + 1j * f / 20000) ** 2
    exact *= mount / (1 + (np.tan(np.pi * f / 12800) / np.tan(np.pi * 640 / 12800)) ** 12)
    band = (f > 0.3 * scene.band[1]) & (f < 500.0)
    assert np.median(found[band] / exact[band]) == pytest.approx(1.0, abs=0.03)
    assert np.quantile(np.abs(np.log(found[band] / exact[band])), 0.95) < 0.3  # some 150 averages, 9 %


def test_a_tone_at_the_shaft_has_the_amplitude_that_the_receptance_gives() -> None:
    scene = next(s for s in (draw("complete", seed, (8.0, 8.1)) for seed in range(99)) if s.rate_hz <= 4096.0)
    machine = Machine(still(replace(scene, sensor="acceleration", unit="m/s^2"), once=100.0, wander=0.0))
    caps = machine.moved().caps[:, 0].astype(float)
    half = caps[len(caps) // 2 :]
    t = (len(caps) // 2 + np.arange(len(half))) / scene.rate_hz / scene.keep
    X = np.stack([np.cos(machine.turn * t), np.sin(machine.turn * t)], axis=1)
    amplitude = np.hypot(*np.linalg.lstsq(X, half, rcond=None)[0])
    forces = [(dof, a) for dof, _, _, a in machine.tones]
    G = machine.receptance(machine.turn)[machine.at[scene.measured[0]]]
    assert amplitude == pytest.approx(machine.turn**2 * abs(sum(G[dof] * a for dof, a in forces)), rel=0.03)


def test_strikes_come_at_their_order_with_slip() -> None:
    """The envelope of a record has its strongest line within the first harmonics at the order that the truth says."""
    scene = draw("one", 0, (10.0, 11.0), ("local_defect",))
    scene = still(replace(scene, rpm=1200.0, strikes=scene.strikes | {"modulated": 0.0, "share": 3.0}), wander=0.0)
    rate, order = scene.rate_hz * scene.keep, scene.strikes["order"]
    assert order == pytest.approx(scene.orders[scene.strikes["name"]] * (1 - scene.strikes["slip"]))
    moved = Machine(replace(scene, seconds=4.0)).moved()
    power = moved.caps[:, 0].astype(float) ** 2
    lines = np.abs(np.fft.rfft(power - power.mean()))
    hz = np.arange(len(lines)) * rate / len(power)
    near = (hz > 0.7 * order * 20) & (hz < 1.3 * order * 20)
    assert hz[near][np.argmax(lines[near])] == pytest.approx(order * 20, abs=0.5)


def test_every_kind_is_drawn_with_what_it_needs_and_again_the_same() -> None:
    for kind in KINDS:
        for seed in range(40):
            scene = draw(kind, seed, (10.0, 600.0))
            assert scene == draw(kind, seed, (10.0, 600.0))
            assert len(scene.hidden) == {"one": 1, "two": 2}.get(kind, 0)
            assert bool(scene.mistake) == (kind == "mistake")
            assert 0.1 <= scene.m["bearing1"] <= 50.0
            assert 1 <= len(scene.channels) <= 4
            assert scene.band[0] < scene.band[1] < scene.rate_hz / 2
            assert all(2 <= sum(m.place == p for m in scene.around.modes) <= 4 for p in scene.places)
            assert "speed_rpm" in rig_file(scene, True) or not scene.speed_known or scene.tacho


def said(verdict: str, **more: Any) -> dict[str, Any]:
    """An answer of the product."""
    empty = {"status": "ok", "error": "", "ranking": [], "separates": "", "messages": [], "codes": [], "reason": "",
             "order": None, "findings": [], "parameters": {}}  # fmt: skip
    return empty | {"verdict": verdict} | more


def row(effect: str, **parameters: float) -> dict[str, Any]:
    """A rank of its ranking."""
    return {"effect": effect, "at": ["bearing1"], "parameters": {k: {"value": v} for k, v in parameters.items()}}


def test_the_judge() -> None:
    scene = replace(draw("complete", 0, (10.0, 11.0)), around=NOTHING)
    truth = truth_of(scene, Machine(scene), None) | {"f0": 300.0, "band": (100.0, 800.0), "zeta": 0.02}
    cubic = truth | {"hidden": {"cubic": "bearing1"}}
    strikes = truth | {"hidden": {"local_defect": "bearing1"}, "strikes": {"order": 3.5}}
    mass = truth | {"mistake": "cap_mass"}
    key = "rig.mass.bearing1"
    cases = [
        (truth, said("complete"), RIGHT), (truth, said("unknown"), HONEST), (truth, said("cubic"), WRONG),
        (truth, said("imbalance"), WRONG), (truth, said("complete", codes=["shaft_differs"]), WRONG),
        (truth, {"status": "late", "error": ""}, LATE), (truth, {"status": "failed", "error": "x"}, WRONG),
        (truth, {"status": "refused", "error": "no resonance inside the band"}, WRONG),
        (truth, {"status": "refused", "error": "another reason"}, HONEST),
        (cubic, said("cubic", ranking=[row("cubic")]), RIGHT), (cubic, said("complete"), WRONG),
        (cubic, said("quintic", separates="quintic or cubic"), HONEST), (cubic, said("quintic"), WRONG),
        (cubic, said("unknown", added=["cubic"]), RIGHT), (cubic, said("complete", added=["cubic", "stop"]), WRONG),
        (strikes, said("local_defect", ranking=[row("local_defect", order=3.49)]), RIGHT),
        (strikes, said("local_defect", ranking=[row("local_defect", order=7.0)]), WRONG),
        (mass, said("rig_file", ranking=[row("rig_file", **{key: 1.0})]), RIGHT),
        (mass, said("rig_file", parameters={"rig.speed_rpm": 1.0}), WRONG), (mass, said("complete"), WRONG),
        (mass, said("unknown", messages=[key]), HONEST), (mass, said("line"), WRONG),
    ]  # fmt: skip
    assert [judge(true, answer).what for true, answer, _ in cases] == [what for *_, what in cases]


def test_the_interval_is_wilsons() -> None:
    assert wilson(0, 200) == pytest.approx((0.0, 1.88), abs=0.01)
    assert wilson(5, 10) == pytest.approx((23.66, 76.34), abs=0.01)
