"""Assembles the device's description from info records; detects a complete, a new, and an unreadable description."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.contract.notices import Notices
from drivers.contract.reading import Info, Signal

from .protocol import INFO_PARTS, LAYOUT_OF_NAME, PROTOCOL_VERSION, InfoRecord, Layout, unpack_info
from .starts import Starts

_BY_CODE = {layout.code: layout for layout in LAYOUT_OF_NAME.values()}


@dataclass(frozen=True, slots=True)
class Expected:
    """Values of the rig file about the device; a difference becomes a notice.

    rate_hz : sampling rate, Hz; None if the rig file gives none.
    channels : names of the channels.
    """

    rate_hz: float | None = None
    channels: tuple[str, ...] = ()


MIXED_NS = 3_000_000_000  # a device describes itself each second


@dataclass(frozen=True, slots=True)
class _Sender:
    """A device that described itself. times : number of its recent records."""

    serial: int
    t_host_ns: int
    times: int


class DeviceInfo:
    """`info` and `layout` are None until one record of every channel has come.

    unchecked : the link has no check sums, so that another description of the same start must come twice.
    """

    def __init__(self, notices: Notices, expected: Expected | None = None, unchecked: bool = False) -> None:
        self.info: Info | None = None
        self._stated: Info | None = None  # as the records say
        self.layout: Layout | None = None
        self._notices = notices
        self._expected = expected or Expected()
        self._records: dict[int, InfoRecord] = {}
        self.starts = Starts()
        self._unchecked = unchecked
        self._twice: dict[int, bool] = {}  # the last two records of a channel say the same
        self._start: tuple[object, ...] = ()  # whose description `info` is
        self._senders: list[_Sender] = []  # recent senders, the latest last
        self._mixed_ns: int | None = None  # when records of two devices last came in turn
        self._parts: dict[int, list[bytes]] = {}

    def record(self, data: bytes, t_host_ns: int) -> Info | None:
        """Take one record; returns the description if this completes a new one."""
        record = unpack_info(data)
        if record is None:
            self._notices.add(t_host_ns, "warning", "bad_info", "a device info record is invalid: ignored")
            return None
        if record.version != PROTOCOL_VERSION:
            self.other_version(record.version, t_host_ns)
            return None
        self._listen(record.serial_number, t_host_ns)
        if self.mixed(t_host_ns):
            return None
        self.starts.identified = record.serial_number != 0
        self._twice[record.channel] = self._records.get(record.channel) == record
        self._records[record.channel] = record
        device = (record.serial_number, record.epoch, record.layout, record.channels, record.rate_hz, record.count_bits)
        group = [
            each
            for each in self._records.values()
            if (each.serial_number, each.epoch, each.layout, each.channels, each.rate_hz, each.count_bits) == device
        ]
        if len(group) < record.channels:
            return None
        self._records = {each.channel: each for each in group}
        signals = tuple(self._records[channel].signal for channel in range(record.channels))
        info = Info(signals, record.rate_hz, f"{record.serial_number:08X}", record.count_bits)
        if info == self._stated:
            if record.channel == record.channels - 1:
                self.starts.described(record.epoch, not self._unchecked or all(self._twice.values()))
            return None
        if self.info is not None and device == self._start and not self._settled(signals):
            return None
        self._compare(info, t_host_ns)
        self.starts.described(record.epoch, True)
        self._start = device
        self.info, self._stated, self.layout = info, info, _BY_CODE[record.layout]
        return info

    def use(self, info: Info) -> None:
        """The description with the rate that is used, where the stated one is untrue."""
        self.info = info

    def _settled(self, signals: tuple[Signal, ...]) -> bool:
        """Whether the description is neither damaged nor half of another description."""
        if len({signal.name for signal in signals}) < len(signals):
            return False
        return not self._unchecked or all(self._twice[channel] for channel in range(len(signals)))

    def mixed(self, t_host_ns: int) -> bool:
        """Whether two devices send with the same identifiers, so that the device of a sample is unknown."""
        return self._mixed_ns is not None and t_host_ns - self._mixed_ns < MIXED_NS

    def _listen(self, serial: int, t_host_ns: int) -> None:
        """Detect two devices with the same identifiers: the first describes itself again after the second.

        A second device alone may be a replacement. Each device must be received twice: on a link without check sums a
        damaged record may carry the number of a device that does not exist.
        """
        known = [one for one in self._senders if t_host_ns - one.t_host_ns < MIXED_NS]
        before = next((one.times for one in known if one.serial == serial), 0)
        if before and known[-1].serial != serial and known[-1].times > 1:
            self._mixed_ns = t_host_ns
            one, other = sorted((serial, known[-1].serial))
            text = (
                f"devices {one:08X} and {other:08X} send with the same identifiers, and nothing says whose a sample "
                "is: dropped, and what came since the second one did is of both; give one of them another base"
            )
            self._notices.add(t_host_ns, "error", "two_devices", text)
        others = [one for one in known if one.serial != serial]
        self._senders = [*others[-3:], _Sender(serial, t_host_ns, before + 1)]

    def part(self, payload: bytes, t_host_ns: int) -> Info | None:
        """Take one classic CAN part of a record: parts must come in order, a missing one voids the record."""
        channel, number = payload[0], payload[1]
        parts = self._parts.setdefault(channel % 16, [])
        if number == 0:
            parts.clear()
        if number != len(parts):
            parts.clear()
            return None
        parts.append(payload[2:8])
        if len(parts) < INFO_PARTS:
            return None
        data = b"".join(parts)[:64]
        parts.clear()
        return self.record(data, t_host_ns)

    def other_version(self, version: int, t_host_ns: int) -> None:
        text = (
            f"a frame of protocol version {version}, this host reads {PROTOCOL_VERSION}: dropped; update one of the two"
        )
        self._notices.add(t_host_ns, "error", "other_version", text)

    def _compare(self, info: Info, t_host_ns: int) -> None:
        rate, names = self._expected.rate_hz, tuple(signal.name for signal in info.signals)
        if rate is not None and abs(info.rate_hz - rate) > 1e-6 * rate:
            text = f"the device says {info.rate_hz:g} Hz, the rig file {rate:g} Hz: set acquisition.rate_hz"
            self._notices.add(t_host_ns, "error", "rate_untrue", text)
        if self._expected.channels and names != self._expected.channels:
            text = f"the device has channels {', '.join(names)}, the rig file {', '.join(self._expected.channels)}"
            self._notices.add(t_host_ns, "warning", "channels_mismatch", text)
        if self.info is not None:
            self._notices.add(t_host_ns, "warning", "info_changed", "the device's description changed")
