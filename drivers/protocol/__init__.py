"""Protocol version 1: frames, device information, one absolute sample index."""
