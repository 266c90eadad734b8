"""Protocol version 1: frames, device information, one absolute sample index."""

from .device_info import Expected
from .faults import KINDS

__all__ = ["Expected", "KINDS"]
