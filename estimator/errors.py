"""What data and models can be wrong in."""

from __future__ import annotations


class DataError(ValueError):
    """The record cannot answer the question. One line: what, where (channel, sample), what to do."""


class NotFiniteError(DataError):
    """A law is not a number somewhere along the record."""

    def __init__(self, effect: str, place: str) -> None:
        text = "is not finite along the measured motion: check its expression and limits"
        super().__init__(f"the force of effect {effect} at {place} {text}")


class ModelError(ValueError):
    """The model cannot do what is asked of it (a value is missing, no stationary density). One line, as above."""
