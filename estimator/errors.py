"""The one error that data can cause."""

from __future__ import annotations


class DataError(ValueError):
    """The record cannot answer the question. One line: what, where (channel, sample), what to do."""


class ModelError(ValueError):
    """The model cannot do what is asked of it (a value is missing, no stationary density). One line, as above."""
