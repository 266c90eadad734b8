"""The part of the residual force that a flexible black box can still predict."""

from .missing_force import UNJUDGED

__all__ = ["UNJUDGED"]
