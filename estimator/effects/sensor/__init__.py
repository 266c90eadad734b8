"""Faults of a measured channel."""
