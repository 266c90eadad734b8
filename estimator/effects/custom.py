"""A user's own law from an expression, compiled to the same standing as a law of the catalogue."""

from __future__ import annotations

from collections.abc import Mapping

from ..effect import Effect


def from_expression(name: str, expression: str, units: Mapping[str, str]) -> Effect:
    """The effect of an expression."""
    raise NotImplementedError("custom expressions")
