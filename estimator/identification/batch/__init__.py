"""Fit of a whole record."""
