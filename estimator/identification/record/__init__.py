"""Faults of a record that need no model: clipped channels and their repair."""

from .clipping import clipping_level, clipping_text

__all__ = ["clipping_level", "clipping_text"]
