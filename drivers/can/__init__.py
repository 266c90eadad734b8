"""CAN frames in all their forms."""

from .can_decoder import CanDecoder
from .can_frames import CanFrames

__all__ = ["CanDecoder", "CanFrames"]
