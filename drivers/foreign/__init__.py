"""Devices of others by a DBC, and recorded CAN traffic."""

from .capture_files import CAPTURE_SUFFIXES

__all__ = ["CAPTURE_SUFFIXES"]
