"""Protocol version 1: frames, device information, one absolute sample index."""

from .device_info import Expected
from .faults import FAULT_KINDS

__all__ = ["Expected", "FAULT_KINDS"]
