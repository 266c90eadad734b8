"""The catalogue: one effect per file, listed by hand."""

from ..effect import Effect
from .cubic import CUBIC

CATALOGUE: dict[str, Effect] = {e.name: e for e in (CUBIC,)}
