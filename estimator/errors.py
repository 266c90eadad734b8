"""Exceptions that the estimator raises about a record or a model."""

from __future__ import annotations


class DataError(ValueError):
    """The record cannot answer the question. The message is one line: what, where (channel, sample), what to do."""


class NoResonanceError(DataError):
    """The fit finds no resonance of a place in the band.

    Parameters
    ----------
    text : str
        One line.
    place : str
        Location, such as ``"bearing1.x"``.
    """

    def __init__(self, text: str, place: str) -> None:
        super().__init__(text)
        self.place = place


class NotFiniteError(DataError):
    """A force or a fit is not finite along the measured motion."""


class DivergedError(NotFiniteError):
    """The equations of a fit have no solution."""

    def __init__(self) -> None:
        super().__init__("the fit of the model diverges: check the masses and the band in the rig file")


class LawNotFiniteError(NotFiniteError):
    """The force of a law is not finite somewhere along the measured motion.

    Parameters
    ----------
    effect : str
        Name of the effect.
    place : str
        Location, such as ``"bearing1.x"``.
    """

    def __init__(self, effect: str, place: str) -> None:
        text = "is not finite along the measured motion: check its expression and limits"
        super().__init__(f"the force of effect {effect} at {place} {text}")


class ModelError(ValueError):
    """The model cannot do what is asked of it: a value is missing, or it has no stationary density. One line."""
