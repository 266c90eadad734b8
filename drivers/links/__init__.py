"""A link's name turned into a driver."""

from .links import capture_file, make_driver, parse_link

__all__ = ["capture_file", "make_driver", "parse_link"]
