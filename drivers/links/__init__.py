"""A link's name turned into a driver."""

from .links import make_driver, parse_link

__all__ = ["make_driver", "parse_link"]
