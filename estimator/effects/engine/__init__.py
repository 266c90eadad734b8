"""How laws are compiled, placed, sized and written."""

from .custom import custom_effect, effect_of
from .expression import ExpressionError, compile_law
from .strength import size, strengths, with_effect

__all__ = ["ExpressionError", "compile_law", "custom_effect", "effect_of", "size", "strengths", "with_effect"]
