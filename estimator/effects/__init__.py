"""The catalogue: one effect per file, listed by hand."""
