"""Settings of each kind of link, from its name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field


@dataclass(frozen=True, slots=True)
class VirtualConfig:
    """speed : device seconds per second, None for as fast as possible."""

    speed: float | None = 1.0


@dataclass(frozen=True, slots=True)
class CanConfig:
    """options go to python-can's bus as they are; base_id: of a device that speaks protocol v1."""

    interface: str
    channel: str
    bitrate: int | None = None
    fd: bool = True
    _: KW_ONLY
    data_bitrate: int | None = None
    base_id: int = 0x300
    options: Mapping[str, str | int] = field(default_factory=dict)

    @property
    def target(self) -> str:
        return f"can:{self.interface}:{self.channel}"


@dataclass(frozen=True, slots=True)
class SlcanConfig:
    """setup : send the bit rates and the open command (an adapter that is open already needs none)."""

    port: str
    bitrate: int = 1_000_000
    data_bitrate: int | None = None
    baud: int = 3_000_000
    _: KW_ONLY
    base_id: int = 0x300
    setup: bool = True

    @property
    def target(self) -> str:
        return f"slcan:{self.port}"


@dataclass(frozen=True, slots=True)
class SerialConfig:
    """device : name of a device of others; "" of one that speaks protocol v1."""

    port: str
    baud: int = 921_600
    device: str = ""

    @property
    def target(self) -> str:
        return f"serial:{self.port}"


@dataclass(frozen=True, slots=True)
class CaptureConfig:
    """rate_hz : nominal rate of the samples, estimated if None. bus : of a file with several, None for all."""

    path: str
    rate_hz: float | None = None
    bus: str | None = None

    @property
    def target(self) -> str:
        return f"capture:{self.path}"


@dataclass(frozen=True, slots=True)
class ReplayConfig:
    path: str
    speed: float | None = 1.0


LinkConfig = VirtualConfig | CanConfig | SlcanConfig | SerialConfig | CaptureConfig | ReplayConfig
