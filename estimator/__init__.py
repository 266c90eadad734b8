"""Rotor physics, likelihood and diagnosis. Takes arrays in SI units; knows no files, threads or clocks."""
