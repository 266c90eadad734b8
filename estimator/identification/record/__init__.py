"""Faults of a record that need no model: clipped channels and their repair."""
