"""MCAP in and out, bit for bit."""
