"""Devices of others by a DBC, and recorded CAN traffic."""

from .capture_files import CAPTURE_SUFFIXES
from .dbc import load_dbc

__all__ = ["CAPTURE_SUFFIXES", "load_dbc"]
