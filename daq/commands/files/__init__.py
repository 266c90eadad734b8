"""Import, export, recover and info."""
