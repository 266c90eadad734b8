"""Shapes of the unknown force."""
