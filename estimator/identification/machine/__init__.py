"""Tones, harmonics, impact trains and parametric stiffness of a machine."""
