"""The rolling estimate while lines move through the band, and the shaft angle of a stream."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_rig import PLACES, RATE, rig_model, rig_record, run_up_angle

from estimator.identification.rolling.estimator import RollingEstimator
from estimator.model.rig import Channel, Model
from estimator.results import Estimate
from estimator.signals.shaft_angle import ShaftAngle, shaft_angle

SECONDS, RUN_UP = 14.0, (320.0, 460.0, 0.3)


def pulses(seconds: float) -> np.ndarray:
    """(n,) a tacho of the run-up's shaft: the line is its tenth order."""
    angle = run_up_angle(RUN_UP, seconds, np.arange(int(seconds * RATE)) / RATE) / 10.0
    return (np.mod(angle, 2 * np.pi) < 0.3).astype(float)


def with_tacho(model: Model) -> Model:
    return replace(model, channels=(*model.channels, Channel("tacho", "", "", "tacho")))


def test_the_angle_of_a_stream_is_that_of_the_record() -> None:
    y = pulses(6.0)
    whole = shaft_angle(y, RATE)
    stream = ShaftAngle(with_tacho(rig_model()), RATE)
    at, last = 0, None
    for k in range(0, len(y) - 1024, 1024):
        stream.push(np.stack([np.zeros(1024)] * 4 + [y[k : k + 1024]], axis=1))
        if k < 2 * RATE:
            continue
        at = k - int(1.5 * RATE)
        angle = stream.angle(at, k - 2048)
        assert angle is not None
        rest = angle - whole[at : k - 2048]
        assert np.ptp(rest) < 0.02
        assert last is None or abs(rest[0] - last) < 0.02
        last = rest[0]
        stream.drop(at)


def rolled(model: Model, y: np.ndarray) -> list[Estimate]:
    rolling, out = RollingEstimator(model, RATE, 10.0, watch=()), []
    for part in np.split(y, np.arange(1024, len(y), 1024)):
        rolling.update(part)
        out.append(rolling.snapshot())
    return out[::12]


@pytest.mark.slow
def test_a_run_up_does_not_disturb_the_estimate() -> None:
    """The shaft's tenth order, forty times the random force in its bin, rises through the band."""
    quiet = rolled(rig_model("cubic"), rig_record(SECONDS, seed=4))
    run_up = rig_record(SECONDS, seed=4, run_up=RUN_UP)
    tacho = np.column_stack([run_up, pulses(SECONDS)])
    for y, model in ((run_up, rig_model("cubic")), (tacho, with_tacho(rig_model("cubic")))):
        estimates = rolled(model, y)
        for now, expected in zip(estimates, quiet, strict=True):
            assert bool(now.parameters) == bool(expected.parameters)
            for name in [f"{place}.{key}" for place in PLACES for key in ("kL", "c")] if now.parameters else []:
                a, b = now.parameters[name], expected.parameters[name]
                assert abs(a.value - b.value) < b.sd
                assert a.sd < 1.1 * b.sd
