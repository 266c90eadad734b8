"""The one error that data can cause."""

from __future__ import annotations


class DataError(ValueError):
    """The record cannot answer the question. One line: what, where (channel, sample), what to do."""
