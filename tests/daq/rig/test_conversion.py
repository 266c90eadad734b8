"""Values to SI: units of a file, volts with a sensitivity, an offset; and a remedy where it cannot be."""

from __future__ import annotations

import pytest

from daq.base.contract.errors import ConfigError
from daq.rig.conversion import conversion
from daq.rig.rig import Rig
from daq.rig.rig_file import ChannelTable
from daq.rig.units import STANDARD_GRAVITY

CONVERTED_RIG_TOML = """schema = 1
[band]
low = 10.0
high = 400.0
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
"""


def channel(text: str) -> ChannelTable:
    return Rig.parse(CONVERTED_RIG_TOML + text).file.channel[0]


@pytest.mark.parametrize(
    ("rig", "stated", "value", "si"),
    [
        ('unit = "m/s^2"', "mg", 1000.0, STANDARD_GRAVITY),
        ('unit = "g"', "", 1.0, STANDARD_GRAVITY),
        ('unit = "g"', "mm/s²", 1000.0, 1.0),
        ('unit = "g"', "m/sec^2", 1.0, 1.0),
        ('unit = "g"\nsensitivity = { value = 100.0, unit = "mV/g" }', "V", 0.1, STANDARD_GRAVITY),
        ('unit = "mV"\nsensitivity = { value = 10.2, unit = "mV/(m/s^2)" }', "", 10.2, 1.0),
        ('unit = "mV"\nsensitivity = { value = -10.2, unit = "mV/m/s^2" }', "V", 0.0102, -1.0),
        ('unit = "V"\noffset = 1.65\nsensitivity = { value = 330.0, unit = "mV/g" }', "", 1.98, STANDARD_GRAVITY),
        ('unit = "V"\noffset = 1.65\nsensitivity = { value = 330.0, unit = "mV/g" }', "mV", 1980.0, STANDARD_GRAVITY),
        ('unit = "g"\noffset = 1.0', "m/s^2", STANDARD_GRAVITY, 0.0),
    ],
)
def test_to_si(rig: str, stated: str, value: float, si: float) -> None:
    to = conversion(channel(rig), stated)
    assert value * to.scale + to.offset == pytest.approx(si, abs=1e-12)


@pytest.mark.parametrize(
    ("rig", "stated", "said"),
    [
        ('unit = "g"', "V", r'is in "V" there; say what its sensor gives.*sensitivity = \{ value'),
        ('unit = "g"', "mm", "a unit of displacement; a channel of kind acceleration may be in m/s"),
        ('unit = "g"', "furlong", "no unit known here"),
        ('unit = "g"\nsensitivity = { value = 100.0, unit = "mV/g" }', "", 'write unit = "V"'),
    ],
)
def test_what_does_not_fit_is_said_with_the_remedy(rig: str, stated: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        conversion(channel(rig), stated)


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        ('unit = "mV"', 'channel.0..unit: "mV" needs the sensor: add sensitivity'),
        ('unit = "V"\nsensitivity = { value = 0.0, unit = "mV/g" }', "a sensor that gives nothing"),
        ('unit = "V"\nsensitivity = { value = 1.0, unit = "g/V" }', 'write it as "mV/g"'),
        ('unit = "V"\nsensitivity = { value = 1.0, unit = "mV/mm" }', "not a unit of acceleration"),
    ],
)
def test_mistakes_in_the_rig_file(rig: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        channel(rig)


def test_a_channel_in_volts_is_in_the_unit_of_its_sensor_elsewhere() -> None:
    rig = Rig.parse(CONVERTED_RIG_TOML + 'unit = "mV"\nsensitivity = { value = 100.0, unit = "mV/g" }')
    assert rig.units["x"] == "g"
    assert rig.factors[0] == STANDARD_GRAVITY
