"""Our frames on a byte stream."""
