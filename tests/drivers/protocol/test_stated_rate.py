"""The rate that a device states is held against its clock and the rig file."""

from __future__ import annotations

from dataclasses import replace

import pytest
from ramp_device import Record, ramp_device

from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import CanFrames
from drivers.contract.reading import LinkStats
from drivers.protocol.device_info import Expected
from drivers.protocol.protocol import BASE_ID, ID_INFO, pack_info, unpack_info
from drivers.serial import cobs
from drivers.serial.serial_decoder import KIND_INFO, SerialDecoder
from drivers.simulated.simulated import WireFrame


def lie(frame: WireFrame, rate_hz: float) -> WireFrame:
    """The frame, with another rate if it is a record of the device."""
    head = b"" if frame.identifier == BASE_ID + ID_INFO else frame.data[:8]
    if head and not (frame.data[1] == KIND_INFO and len(frame.data) == 72):
        return frame
    record = unpack_info(frame.data[len(head) :])
    assert record is not None
    return replace(frame, data=head + pack_info(replace(record, rate_hz=rate_hz)))


def run(layout: str, said_hz: float, rig_hz: float | None, frames: int = 400) -> Record:
    device = ramp_device(layout, 2560.0, None)
    decoder = (SerialDecoder if device.config.serial else CanDecoder)(LinkStats(), expected=Expected(rig_hz))
    record = Record()
    for frame in device.next(frames):
        if layout not in ("serial16", "serial24") and frame.identifier != BASE_ID + ID_INFO:
            sent = frame
        else:
            sent = lie(frame, said_hz)
        t_ns = round(sent.due_s * 1e9)
        if isinstance(decoder, SerialDecoder):
            record.take(decoder.feed(cobs.encode(sent.data), t_ns))
        else:
            record.take(decoder.feed(CanFrames.build([(sent.identifier, sent.data, t_ns)]), t_ns))
    return record


@pytest.mark.promise("a device that states an absurd rate", "1e7, 1e-300, 25.6 for 25600 Hz", "the true one used, said")
@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "serial24"])
@pytest.mark.parametrize("said_hz", [1e7, 1e-300, 2.56, 5120.0])
@pytest.mark.parametrize("rig_hz", [2560.0, 2559.9])
def test_an_untrue_rate_is_told_and_the_true_one_used(layout: str, said_hz: float, rig_hz: float) -> None:
    record = run(layout, said_hz, rig_hz)
    assert [info.rate_hz for info in record.infos] == [rig_hz]
    assert not record.gaps
    assert record.samples > 1200
    assert {"stated_rate"} <= record.codes() <= {"stated_rate", "rate_untrue"}


@pytest.mark.parametrize("layout", ["fd16", "serial16"])
def test_without_a_rig_file_the_clock_says(layout: str) -> None:
    record = run(layout, 25.6, None)
    assert [info.rate_hz for info in record.infos] == [pytest.approx(2560.0, rel=1e-3)]
    assert not record.gaps


@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "serial24"])
@pytest.mark.parametrize("rig_hz", [None, 2560.0, 2500.0])
def test_a_true_rate_is_used_whatever_the_rig_file_says(layout: str, rig_hz: float | None) -> None:
    record = run(layout, 2560.0, rig_hz)
    assert [info.rate_hz for info in record.infos] == [2560.0]
    assert not record.gaps
    assert record.offset == 0
    assert record.codes() == (set() if rig_hz != 2500.0 else {"rate_untrue"})
