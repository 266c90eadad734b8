"""Held-out error, missing force by state, restoring-force curves and the simulated twin."""
