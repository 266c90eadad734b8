"""A recorder that delays the end of the band is known by what it does to the harmonics of a law, and is undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record
from numpy.typing import NDArray

from estimator.diagnosis.comparison.comparison import compare
from estimator.diagnosis.verdict.improvement import improve
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.structure.recorder_phase import excess, find_recorder_phase
from estimator.model.recorder import POWERS, Filter
from estimator.model.rig import Model, Setting
from estimator.simulation.simulator import simulate

Array = NDArray[np.float64]
LATE = 0.8  # rad at the end of the band


def bent() -> Model:
    """A bearing whose cubic stiffness is fifteen times that of the paper's rig."""
    rig = one_bearing()
    own = {p: {n: Setting(15.0 * (s.value or 0.0)) for n, s in q.items()} for p, q in rig.effects[0].parameters.items()}
    return replace(rig, effects=(replace(rig.effects[0], parameters=own),))


def late(y: Array, rad: float, top_hz: float) -> Array:
    """(n, channels) behind a filter that takes nothing and delays the end of the band."""
    f = np.fft.rfftfreq(len(y), 1 / RATE)
    turned = np.exp(-1j * rad * np.minimum(f / top_hz, 1.0) ** 3)
    return np.fft.irfft(np.fft.rfft(y, axis=0) * turned[:, None], len(y), axis=0)


def test_the_delay_of_the_end_of_the_band_is_found() -> None:
    rig = bent()
    top = rig.band[1]
    y = simulate(rig, RATE, 4.0, seed=3)
    known = {"roll_off": dict.fromkeys(rig.places, Filter(RATE, top, nepers=(0.0,) * POWERS.size))}
    for rad in (0.0, LATE):
        seen = excess(fit_all_effects(replace(rig, **known), late(y, rad, top), RATE).point, lambda f: (f / top) ** 3)
        assert seen is not None
        assert seen[0] == pytest.approx(rad, abs=4 * seen[1])
        assert seen[1] < 0.25


def test_beside_a_measured_force_it_is_undone_in_both() -> None:
    """The path from force to motion is as it was; left in, the delay bent a law that the path cannot tell it from."""
    rig = bent()
    forces = [replace(c, name=c.name.replace("b", "f"), kind="force") for c in rig.channels]
    rig = replace(rig, channels=(*rig.channels, *forces))
    top = rig.band[1]
    y = simulate(rig, RATE, 6.0, seed=3, noise=1e-3)
    whole = fit_all_effects(rig, late(y, LATE, top), RATE)
    assert whole.model.roll_off is not None
    for place in rig.places:
        assert whole.model.roll_off[place].late == pytest.approx(LATE, abs=0.05)
        true = rig.effects[0].parameters[place]["kNL"].value
        assert whole.parameters[f"{place}.cubic.kNL"].value == pytest.approx(true, rel=2e-3)
    assert fit_all_effects(rig, y, RATE).model.roll_off is None


def test_no_recorder_is_ahead_of_the_motion() -> None:
    """The third harmonic of x^2 v is a quarter of a turn beside that of x^3: behind a mean over a sample a missing one
    was undone as a phase of -18 rad, after which the law was of the wrong sign."""
    rig = bent()
    flat = dict.fromkeys(rig.places, Filter(RATE, rig.band[1], nepers=(0.0,) * POWERS.size))
    model = replace(rig, roll_off=flat)
    point = fit_all_effects(model, record(rig, "displacement_damping", 0.06, seconds=6.0), RATE).point
    seen = excess(point, lambda f: (f / rig.band[1]) ** 3)
    assert seen is not None
    assert seen[0] < -5.0 * seen[1]
    assert find_recorder_phase(model, point) is None


@pytest.mark.slow
def test_a_complete_model_behind_a_filter_that_takes_nothing_is_complete() -> None:
    rig = bent()
    y = simulate(rig, RATE, 30.0, seed=3, noise=0.02)
    found = compare(rig, late(y, LATE, rig.band[1]), RATE)
    assert any(m.code == "recorder_delays" for m in found.messages)
    assert found.missing[0] == 0.0
    assert not compare(rig, y, RATE).messages


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["bouc_wen", "clearance", "quadratic", "coulomb", "ball_pass", "quadratic_damping"])
def test_no_law_passes_for_a_delay(effect: str) -> None:
    rig = bent()
    assert not fit_all_effects(rig, record(rig, effect, 0.06, seconds=30.0), RATE).model.roll_off


@pytest.mark.slow
def test_a_delay_behind_a_missing_law_is_sought_again_with_it() -> None:
    """A missing clearance hid it: drag was named after it, and 0.54 % of the force stayed."""
    rig = bent()
    y = late(record(rig, "clearance", 0.06, seconds=30.0), LATE, rig.band[1])
    ladder = improve(rig, y, RATE)
    assert [use.name for use in ladder.model.effects] == ["cubic", "clearance"]
    assert ladder.last.verdict == "complete"
    assert ladder.rungs[-1].missing[0] == 0.0
    assert any(m.code == "recorder_delays" for m in ladder.messages)
