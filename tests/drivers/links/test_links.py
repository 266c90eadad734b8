"""Names of links: what is accepted, and what a mistake is answered with."""

from __future__ import annotations

import contextlib
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ramp_device import Record, ramp_device

from drivers.contract.errors import LinkError
from drivers.contract.link_config import (
    CanConfig,
    CaptureConfig,
    ReplayConfig,
    SerialConfig,
    SlcanConfig,
    VirtualConfig,
)
from drivers.contract.reading import LinkStats
from drivers.links.links import LINK_FORMS, make_driver, parse_link
from drivers.protocol.device_info import Expected
from drivers.serial import cobs
from drivers.serial.serial_decoder import SerialDecoder


@pytest.mark.parametrize(
    ("url", "config"),
    [
        ("virtual:", VirtualConfig()),
        ("virtual:?speed=max", VirtualConfig(None)),
        ("virtual:?speed=4", VirtualConfig(4.0)),
        ("can:socketcan:can0", CanConfig("socketcan", "can0")),
        ("can:socketcan:can0?bitrate=1000000&fd=0", CanConfig("socketcan", "can0", 1_000_000, False)),
        ("can:pcan:PCAN_USBBUS1?bitrate=500000&fd=1&data_bitrate=2000000&id=0x310",
         CanConfig(interface="pcan", channel="PCAN_USBBUS1", bitrate=500_000, fd=True, data_bitrate=2_000_000,
         base_id=0x310)),
        ("can:socketcand:can0?host=h&port=29536",
         CanConfig("socketcand", "can0", options={"host": "h", "port": 29536})),
        ("can:vector:0?option.app_name=Rig", CanConfig("vector", "0", options={"app_name": "Rig"})),
        ("slcan:/dev/ttyACM0?bitrate=500000", SlcanConfig("/dev/ttyACM0", 500_000)),
        ("slcan:socket://10.0.0.1:3333?setup=0", SlcanConfig("socket://10.0.0.1:3333", setup=False)),
        ("serial:/dev/ttyUSB0?baud=3000000", SerialConfig("/dev/ttyUSB0", 3_000_000)),
        ("serial:COM3", SerialConfig("COM3")),
        ("serial:rfc2217://h:1?ign_set_control&baud=9600", SerialConfig("rfc2217://h:1?ign_set_control", 9600)),
        ("capture:a b/c.log?rate=100", CaptureConfig("a b/c.log", 100.0)),
        ("capture:C:\\x\\c.blf?bus=can1", CaptureConfig("C:\\x\\c.blf", None, "can1")),
        ("replay:x.mcap?speed=max", ReplayConfig("x.mcap", None)),
    ],
)  # fmt: skip
def test_accepted(url: str, config: object) -> None:
    assert parse_link(url) == config


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("seral:/dev/x", "did you mean 'serial'"),
        ("/dev/ttyUSB0", "valid are"),
        ("", "valid are"),
        ("serial:", "a port is needed"),
        ("serial:/dev/x?buad=9600", "did you mean 'baud'"),
        ("serial:/dev/x?baud=fast", "not a whole number"),
        ("serial:/dev/x?baud=-1", "outside"),
        ("serial:sokcet://h:1", "did you mean 'socket'"),
        ("can:can0", "an interface and a channel"),
        ("can:socketcan:can0?fd=maybe", "neither 1 nor 0"),
        ("can:socketcan:can0?bitrte=1", "did you mean 'bitrate'"),
        ("virtual:x", "takes no name"),
        ("virtual", "a colon is missing; write virtual:"),
        ("virtual:?speed=0", "not a positive number"),
        ("virtual:?speed=nan", "not a positive number"),
        ("capture:", "a file is needed"),
        ("replay:", "a log is needed"),
    ],
)
def test_mistakes(url: str, says: str) -> None:
    with pytest.raises(LinkError, match=says) as caught:
        parse_link(url)
    assert "\n" not in str(caught.value)


@given(st.text(max_size=60))
def test_any_text_is_a_link_or_a_link_error(text: str) -> None:
    for url in (text, *(kind + ":" + text for kind in LINK_FORMS)):
        with contextlib.suppress(LinkError):
            parse_link(url)


def test_combinations_that_make_no_sense() -> None:
    with pytest.raises(LinkError, match="simulated device"):
        make_driver(VirtualConfig())
    with pytest.raises(LinkError, match="made from the log"):
        make_driver(ReplayConfig("x"))


def test_no_library_is_imported_for_a_name() -> None:
    code = (
        "import sys; from drivers.links.links import parse_link; parse_link('can:socketcan:can0'); "
        "print([m for m in ('can', 'serial', 'numba', 'cantools', 'asammdf') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_a_device_other_than_expected_is_reported() -> None:
    decoder = SerialDecoder(LinkStats(), Expected(10_000.0, ("a", "b")))
    record = Record()
    frames = ramp_device("serial16").next(2)
    record.take(decoder.feed(b"".join(cobs.encode(frame.data) for frame in frames), 0))
    assert record.codes() == {"rate_untrue", "channels_mismatch"}
    assert "acquisition.rate_hz" in record.notices[0].text
