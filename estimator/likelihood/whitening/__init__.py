"""Whitened block spectra: their sensor noise, leakage of narrow lines, and the determinant of the path likelihood."""
