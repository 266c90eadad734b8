"""Common devices on a serial line by name: how their packets are framed, and what stands in them."""

from .decoder import PacketDecoder
from .profiles import DEVICE_PROFILES, DeviceProfile, profile_of

__all__ = ["DEVICE_PROFILES", "DeviceProfile", "PacketDecoder", "profile_of"]
