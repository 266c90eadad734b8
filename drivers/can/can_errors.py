"""Meaning of an error frame (Linux's can/error.h; python-can hands the same bits on for other adapters)."""

from __future__ import annotations

from drivers.contract.link import Event

_TX_TIMEOUT, _LOST_ARBITRATION, _CONTROLLER_PROBLEM, _PROTOCOL_VIOLATION = (
    0x001,
    0x002,
    0x004,
    0x008,
)  # linux/can/error.h
_TRANSCEIVER_STATUS, _NO_ACK, _BUS_OFF, _BUS_ERROR, _CONTROLLER_RESTARTED = 0x010, 0x020, 0x040, 0x080, 0x100


def describe_error(identifier: int, data: bytes) -> list[Event]:
    """Events of one error frame: the class bits of its identifier, and the controller's state in byte 1."""
    events = []
    state = data[1] if len(data) > 1 else 0
    if identifier & _BUS_OFF:
        text = "the controller is bus-off: check wiring, termination and bit rate; it needs restart-ms or a restart"
        events.append(Event("error", "bus_off", text, "reconnect"))
    if identifier & _CONTROLLER_RESTARTED:
        events.append(Event("info", "bus_restarted", "the controller has started again after bus-off", "reconnect"))
    if identifier & _CONTROLLER_PROBLEM:
        if state & 0x03:
            text = "the controller's receive buffer overflowed"
            events.append(Event("error", "controller_overflow", text, "overflow"))
        if state & 0x30:
            events.append(Event("warning", "error_passive", "the controller is error-passive: many errors on the bus"))
        elif state & 0x0C:
            events.append(Event("warning", "error_warning", "the controller counts many errors on the bus"))
        elif state & 0x40:
            events.append(Event("info", "error_active", "the controller is well again"))
    if identifier & (_PROTOCOL_VIOLATION | _BUS_ERROR | _TRANSCEIVER_STATUS):
        events.append(Event("warning", "bus_error", "errors on the bus: check wiring, termination and bit rate"))
    if identifier & _NO_ACK:
        events.append(Event("warning", "no_ack", "nobody acknowledges on the bus"))
    return events
