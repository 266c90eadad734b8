"""Laws of displacement."""
