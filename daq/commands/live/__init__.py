"""Acquisition from one device or several."""
