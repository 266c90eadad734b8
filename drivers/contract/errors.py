"""What can go wrong with a link; the command line turns each into one line and exit status 3."""

from __future__ import annotations


class LinkError(Exception):
    """A link cannot be used. The text says what, where and what to do, in one line."""


class LinkUnavailable(LinkError):
    """A library, permission or platform is missing: installing or granting something would help."""


class LinkOpenError(LinkError):
    """The link exists in principle but cannot be opened: wrong port, busy, refused, wrong address."""
