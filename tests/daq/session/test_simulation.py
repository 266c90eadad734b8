"""A rig file as a machine: values filled in, the truth of another file, units, axial channels, too many channels."""

from pathlib import Path

import numpy as np
import pytest

from daq.base.contract.errors import ConfigError
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.rig.rig import Rig, load_rig
from daq.session.acquire import acquire_from
from daq.session.estimators import maker
from daq.session.simulation import at_full_speed, complete, fault_rates, machine
from estimator.effects import CATALOGUE
from estimator.simulation.simulator import simulate

PAPER = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"
HEAD = "schema = 1\n[band]\nlow = 100.0\nhigh = 4000.0\n"


def channel(name: str, node: str, direction: str, unit: str = "m/s^2", kind: str = "acceleration") -> str:
    keys = {"name": name, "node": node, "direction": direction, "unit": unit, "kind": kind}
    return "[[channel]]\n" + "".join(f'{key} = "{value}"\n' for key, value in keys.items())


def record(rig: Rig, seconds: float = 0.5, **more: object) -> np.ndarray:
    """What the device's source gives, SI."""
    source = machine(rig, **more).device._source  # type: ignore[arg-type]
    return source(round(seconds * 12800))


def test_a_complete_file_is_taken_as_it_is() -> None:
    model = load_rig(PAPER).model
    assert complete(model, 25600.0) == (model, {})


def test_what_is_open_is_filled_in_and_named() -> None:
    rig = Rig.parse(HEAD + channel("a", "bearing1", "x"))
    model, assumed = complete(rig.model, 12800.0)
    assert set(assumed) == {"bearing1.x.m", "bearing1.x.kL", "bearing1.x.c", "bearing1.x.S"}
    y = simulate(model, 12800.0, 5.0)
    assert y.std() == pytest.approx(10.0, rel=0.4)  # the acceleration that the force is chosen for


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_without_values_can_be_simulated(name: str) -> None:
    text = PAPER.read_text().replace('effects = ["cubic"]', f'effects = ["{name}"]')
    rig = Rig.parse(text.replace("[model.cubic]\nkNL = 1.3e18", ""))
    y = machine(rig).device._source(4096)
    assert np.isfinite(y).all()
    assert (y.std(axis=0) > 1.0).all()


def test_values_of_a_law_of_the_users_own_are_needed() -> None:
    law = '[[model.custom]]\nname = "mine"\nexpression = "k*x"\nparameters = { k = { unit = "N/m" } }\n'
    with pytest.raises(ConfigError, match="mine has no value for k"):
        machine(Rig.parse(HEAD + law + channel("a", "bearing1", "x")))


def test_units_change_the_numbers_on_the_wire_not_the_motion() -> None:
    in_si = Rig.parse(HEAD + channel("a", "bearing1", "x"))
    in_g = Rig.parse(HEAD + channel("a", "bearing1", "x", "g"))
    np.testing.assert_array_equal(record(in_si), record(in_g))


def test_an_axial_channel_has_noise_alone() -> None:
    rig = Rig.parse(HEAD + channel("z", "bearing1", "z") + channel("a", "bearing1", "x"))
    y = record(rig)
    assert y[:, 0].std() < 0.01 * y[:, 1].std()


def test_displacement_velocity_and_force_sensors() -> None:
    kinds = {"displacement": "um", "velocity": "mm/s", "force": "N"}
    parts = [channel(k[0], "bearing1", "x" if k != "velocity" else "y", unit, k) for k, unit in kinds.items()]
    made = machine(Rig.parse(HEAD + "".join(parts)))
    y = made.device._source(12800)
    counts = y / [s.scale for s in made.device.config.signals()]
    assert (np.abs(counts).max(axis=0) < 32767).all()
    assert (counts.std(axis=0) > 100).all()


def test_the_truth_is_seen_through_the_rigs_channels() -> None:
    truth = load_rig(PAPER)
    one = Rig.parse(HEAD + "[acquisition]\nrate_hz = 25600.0\nnoise = 0.02\n" + channel("mine", "bearing2", "x"))
    alone = machine(one, truth=truth).device._source(1000)
    whole = machine(truth).device._source(1000)
    assert np.corrcoef(alone[:, 0], whole[:, 2])[0, 1] > 0.999
    with pytest.raises(ConfigError, match="does not measure velocity of bearing1.x"):
        machine(Rig.parse(HEAD + channel("v", "bearing1", "x", "mm/s", "velocity")), truth=truth)


def test_words_for_faults() -> None:
    assert fault_rates(["drop:0.01", "flip:1"]) == {"drop": 0.01, "flip": 1.0}
    for wrong in ("drop", "drop:2", "drop:x", "dorp:0.1"):
        with pytest.raises(ConfigError, match="KIND is one of drop"):
            fault_rates([wrong])


def test_a_log_made_at_full_speed_has_the_clock_of_its_device(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    device = machine(load_rig(PAPER), seconds=5.0, config={"clock_ppm": 40.0}).device
    sinks = [LogWriter(log, live=False)]
    acquire_from(load_rig(PAPER), at_full_speed(device), sinks, make=maker("score-matching", 10.0))
    clock = read_log(log).clock
    assert clock is not None
    assert clock.drift_ppm == pytest.approx(40.0, abs=1.0)
    assert clock.bound_ns < 60e6
