"""Devices of others by a DBC, and recorded CAN traffic."""

from .capture_files import SUFFIXES

__all__ = ["SUFFIXES"]
