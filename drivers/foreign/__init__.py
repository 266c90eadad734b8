"""Devices of others by a DBC, and recorded CAN traffic."""

from .capture_files import CAPTURE_SUFFIXES
from .dbc import find_signals, load_dbc
from .mapped import MappedDecoder

__all__ = ["CAPTURE_SUFFIXES", "MappedDecoder", "find_signals", "load_dbc"]
