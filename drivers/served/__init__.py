"""A simulated device served on a link, for other programs to read."""

from .serve import serve

__all__ = ["serve"]
