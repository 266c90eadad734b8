"""The name of a link (a URL-like string) -> its configuration -> a driver that is constructed but not opened.

No library of any link is imported before a driver of that kind is made.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl

from drivers.contract.errors import LinkError
from drivers.contract.link_config import (
    CanConfig,
    CaptureConfig,
    LinkConfig,
    ReplayConfig,
    SerialConfig,
    SlcanConfig,
    VirtualConfig,
)
from drivers.contract.reading import Driver, LinkStats
from drivers.protocol.device_info import Expected

if TYPE_CHECKING:
    from drivers.can.can_decoder import CanDecoder
    from drivers.foreign.mapped import MappedDecoder
    from drivers.simulated.simulated import SimulatedDevice

LINK_FORMS = {
    "virtual": "virtual:[?speed=1]",
    "can": "can:INTERFACE:CHANNEL?bitrate=500000[&fd=1][&data_bitrate=2000000][&id=0x300][&option.NAME=VALUE]",
    "slcan": "slcan:PORT_OR_URL?bitrate=1000000[&data_bitrate=5000000][&baud=..][&id=0x300][&setup=1]",
    "serial": "serial:PORT_OR_URL?baud=921600[&device=witmotion|mip|m_a352|lines]",
    "capture": "capture:FILE[?rate=100][&bus=0]",
    "replay": "replay:LOG.mcap[?speed=1]",
}
# What pyserial's own URLs take after the question mark.
_PYSERIAL_OPTIONS = {
    "socket": {"logging"},
    "rfc2217": {"logging", "ign_set_control", "poll_modem", "timeout"},
    "loop": {"logging"},
    "spy": {"file", "color", "raw", "all"},
    "alt": {"class"},
    "hwgrep": {"n", "skip_busy"},
}


def parse_link(url: str) -> LinkConfig:
    """The configuration a link's name stands for. Raises LinkError, which lists the valid forms."""
    kind, colon, rest = url.partition(":")
    if not colon and kind in LINK_FORMS:
        raise LinkError(f"link {url!r}: a colon is missing; write {LINK_FORMS[kind]}")
    if not colon or kind not in LINK_FORMS:
        raise LinkError(f"link {url!r}: {_instead(kind, LINK_FORMS)}; valid are {' | '.join(LINK_FORMS.values())}")
    rest, query = _query(kind, rest)
    options = _Options(url, kind, query)
    config = _PARSER_OF_KIND[kind](rest, options)
    options.finish()
    return config


def _query(kind: str, rest: str) -> tuple[str, str]:
    """The name, and its options. A file's name may hold question marks: the last one begins the options, if any."""
    if kind not in ("capture", "replay"):
        name, _, query = rest.partition("?")
        return name, query
    try:
        if Path(rest).exists():
            return rest, ""
    except (OSError, ValueError):
        pass
    name, mark, query = rest.rpartition("?")
    return (name, query) if mark else (rest, "")


def capture_file(name: str) -> str:
    """The path in FILE or FILE?bus=..."""
    return _query("capture", name)[0]


def make_driver(
    config: LinkConfig,
    *,
    dbc: bytes | None = None,
    signals: Mapping[str, str] | None = None,
    expected: Expected | None = None,
    device: SimulatedDevice | None = None,
) -> Driver:
    """A driver for this link, not yet opened.

    dbc, signals : for a device that does not speak protocol v1: its DBC file, and channel -> "Message.Signal" in the
    order of the channels. expected : values of the rig file; differences become notices. device : the simulated device
    of `virtual:`. Raises LinkError for a combination that makes no sense. The log reader makes `replay:` drivers.
    """
    from drivers.contract.link import Link

    own = isinstance(config, SerialConfig) and config.device  # brings its DBC
    if signals is not None and dbc is None and not own:
        raise LinkError("a signal map needs the DBC file that describes its messages: set link.dbc in the rig file")
    stats = LinkStats()
    if isinstance(config, VirtualConfig):
        from drivers.can.can_decoder import CanDecoder

        from .virtual import VirtualSource

        if device is None:
            raise LinkError("virtual: needs a simulated device: use it with a rig that can be simulated")
        decoder = CanDecoder(stats, device.config.base_id, expected)
        return Link("virtual", "virtual:", VirtualSource(device, config.speed), decoder)
    if isinstance(config, CanConfig):
        from drivers.can.can_bus import BusSource

        inner = _can_decoder(config.base_id, stats, dbc, signals, expected)
        return Link("can", config.target, BusSource(config), inner)
    if isinstance(config, SlcanConfig):
        from .slcan import SlcanDecoder, slcan_source

        inner = _can_decoder(config.base_id, stats, dbc, signals, expected, unchecked=True)
        return Link("slcan", config.target, slcan_source(config), SlcanDecoder(inner))
    if isinstance(config, SerialConfig):
        from drivers.serial.byte_port import PortSource

        if config.device:
            return _device(config, stats, dbc, signals, expected)
        from drivers.serial.serial_decoder import SerialDecoder

        return Link("serial", config.target, PortSource(config.target, config.port, config.baud),
                    SerialDecoder(stats, expected))  # fmt: skip
    if isinstance(config, CaptureConfig):
        from drivers.foreign.capture import Capture

        return Capture(config, stats, dbc, signals, expected=expected)
    raise LinkError(f"replay:{config.path}: a replay is made from the log, by the log reader")


def _device(
    config: SerialConfig, stats: LinkStats, dbc: bytes | None, signals: Mapping[str, str] | None,
    expected: Expected | None,
) -> Driver:  # fmt: skip
    """A device of others on a serial line, by its profile; a DBC takes the place of the profile's own."""
    from drivers.contract.link import Link
    from drivers.devices import PacketDecoder, profile_of
    from drivers.foreign import MappedDecoder
    from drivers.serial.byte_port import PortSource

    profile = profile_of(config.device)
    if not signals:
        own = ", ".join(profile.signals)
        raise LinkError(f"device={profile.name}: say in [link.signals] of the rig file what each channel is: {own}")
    inner = MappedDecoder(stats, profile.dbc if dbc is None else dbc, signals, expected)
    decoder = PacketDecoder(inner, profile.make())
    return Link("serial", config.target, PortSource(config.target, config.port, config.baud), decoder)


def _can_decoder(
    base_id: int, stats: LinkStats, dbc: bytes | None, signals: Mapping[str, str] | None, expected: Expected | None,
    unchecked: bool = False,
) -> CanDecoder | MappedDecoder:  # fmt: skip
    if signals is None or dbc is None:
        from drivers.can.can_decoder import CanDecoder

        return CanDecoder(stats, base_id, expected, unchecked=unchecked)
    from drivers.foreign.mapped import MappedDecoder

    return MappedDecoder(stats, dbc, signals, expected)


class _Options:
    """The options after the question mark; each is taken once, and an option that remains is an error."""

    def __init__(self, url: str, kind: str, query: str) -> None:
        self._where = f"link {url!r}"
        self._kind = kind
        self._asked: set[str] = set()
        self._left = dict(parse_qsl(query, keep_blank_values=True))

    def fail(self, text: str) -> LinkError:
        return LinkError(f"{self._where}: {text}; write {LINK_FORMS[self._kind]}")

    def text(self, name: str) -> str | None:
        self._asked.add(name)
        return self._left.pop(name, None)

    def integer(self, name: str, default: int, low: int = 1, high: int = 2**31) -> int:
        value = self.optional(name, low, high)
        return default if value is None else value

    def optional(self, name: str, low: int = 1, high: int = 2**31) -> int | None:
        text = self.text(name)
        if text is None:
            return None
        try:
            value = int(text, 0)
        except ValueError:
            raise self.fail(f"{name}={text!r} is not a whole number") from None
        if not low <= value <= high:
            raise self.fail(f"{name}={value} is outside {low} to {high}")
        return value

    def flag(self, name: str, default: bool) -> bool:
        text = self.text(name)
        if text is None:
            return default
        if text not in ("0", "1", "true", "false", "yes", "no"):
            raise self.fail(f"{name}={text!r} is neither 1 nor 0")
        return text in ("1", "true", "yes")

    def number(self, name: str) -> float | None:
        text = self.text(name)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf:
            raise self.fail(f"{name}={text!r} is not a positive number")
        return value

    def speed(self) -> float | None:
        if self._left.get("speed") == "max":
            self.text("speed")
            return None
        value = self.number("speed")
        return 1.0 if value is None else value

    def prefixed(self, prefix: str) -> dict[str, str | int]:
        found = [name for name in self._left if name.startswith(prefix)]
        values = {name.removeprefix(prefix): self._left.pop(name) for name in found}
        return {name: int(text) if text.isdigit() else text for name, text in values.items()}

    def pass_on(self, allowed: set[str]) -> str:
        """The options for the URL of another library, as its query."""
        self._asked |= allowed
        found = [name for name in self._left if name in allowed]
        pairs = [(name, self._left.pop(name)) for name in found]
        return "&".join(f"{name}={value}" if value else name for name, value in pairs)

    def finish(self) -> None:
        for name in self._left:
            raise self.fail(f"unknown option {name!r}: {_instead(name, self._asked)}")


def _instead(name: str, known: Mapping[str, str] | set[str]) -> str:
    close = difflib.get_close_matches(name, sorted(known), 1)
    return f"did you mean {close[0]!r}?" if close else "there is none like it"


def _virtual(rest: str, options: _Options) -> VirtualConfig:
    if rest:
        raise options.fail(f"virtual: takes no name, got {rest!r}")
    return VirtualConfig(options.speed())


def _can(rest: str, options: _Options) -> CanConfig:
    interface, _, channel = rest.partition(":")
    if not interface or not channel:
        raise options.fail("an interface and a channel are needed, for example can:socketcan:can0")
    extra = options.prefixed("option.")
    for name in ("host", "port"):
        value = options.text(name)
        if value is not None:
            extra[name] = int(value) if value.isdigit() else value
    return CanConfig(
        interface=interface, channel=channel, bitrate=options.optional("bitrate"), fd=options.flag("fd", True),
        data_bitrate=options.optional("data_bitrate"),
        base_id=_base_id(options), options=extra,
    )  # fmt: skip


def _base_id(options: _Options) -> int:
    return options.integer("id", 0x300, 0, 0x7F8)


def _port(rest: str, options: _Options) -> str:
    if not rest:
        raise options.fail("a port is needed, for example /dev/ttyACM0 or socket://127.0.0.1:5000")
    scheme, separator, _ = rest.partition("://")
    if not separator:
        return rest
    if scheme not in _PYSERIAL_OPTIONS:
        raise options.fail(f"no {scheme}:// port: {_instead(scheme, set(_PYSERIAL_OPTIONS))}")
    query = options.pass_on(_PYSERIAL_OPTIONS[scheme])
    return f"{rest}?{query}" if query else rest


def _slcan(rest: str, options: _Options) -> SlcanConfig:
    return SlcanConfig(
        port=_port(rest, options), bitrate=options.integer("bitrate", 1_000_000),
        data_bitrate=options.optional("data_bitrate"),
        baud=options.integer("baud", 3_000_000), base_id=_base_id(options), setup=options.flag("setup", True),
    )  # fmt: skip


def _serial(rest: str, options: _Options) -> SerialConfig:
    port, baud = _port(rest, options), options.integer("baud", 921_600)
    return SerialConfig(port, baud, options.text("device") or "")


def _capture(rest: str, options: _Options) -> CaptureConfig:
    if not rest:
        raise options.fail("a file is needed")
    return CaptureConfig(rest, options.number("rate"), options.text("bus"))


def _replay(rest: str, options: _Options) -> ReplayConfig:
    if not rest:
        raise options.fail("a log is needed")
    return ReplayConfig(rest, options.speed())


_PARSER_OF_KIND: dict[str, Callable[[str, _Options], LinkConfig]] = {
    "virtual": _virtual, "can": _can, "slcan": _slcan, "serial": _serial, "capture": _capture, "replay": _replay,
}  # fmt: skip
