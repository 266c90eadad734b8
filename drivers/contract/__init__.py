"""The driver contract: readings, notices, errors, the link base class."""

from .errors import BusError, LinkError, LinkOpenError
from .link import Event, Link
from .link_config import CaptureConfig, ReplayConfig, SerialConfig, VirtualConfig
from .patient import Patient
from .reading import Block, Driver, Gap, Info, LinkStats, Notice, Reading, Signal

__all__ = [
    "Block",
    "BusError",
    "CaptureConfig",
    "Driver",
    "Event",
    "Gap",
    "Info",
    "Link",
    "LinkError",
    "LinkOpenError",
    "LinkStats",
    "Notice",
    "Patient",
    "Reading",
    "ReplayConfig",
    "SerialConfig",
    "Signal",
    "VirtualConfig",
]
