"""Faults of a record that need no model: clipped channels and their repair."""

from .clipping import clipping_level, limited

__all__ = ["clipping_level", "limited"]
