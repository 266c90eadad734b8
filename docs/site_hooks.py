"""Hooks of the site: links to files outside of docs/ become their names, code is shown as it is typed."""

from __future__ import annotations

import re
from typing import Any

INLINE_CODE = re.compile(r"(?<!<pre>)(?<!</span>)<code>([^<]*)</code>")
BLOCK_OF_CODE = re.compile(r"<pre><code>[^<]*</code></pre>")
OPTION_OF_COMMAND = re.compile(r"(?<!\S)-\S{1,24}(?!\S)")
SHORT_WORD = re.compile(r"(?<!\S)\S{2,24}(?!\S)")  # of which a table may break one in a narrow cell
OUTSIDE_LINK = re.compile(r"\[([^\]]+)\]\((?:\.\./)+[^)]*\)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page without links that lead out of the site."""
    return OUTSIDE_LINK.sub(lambda found: found[1], markdown)


def on_page_content(html: str, **_: Any) -> str:
    """The page whose inline code has whole words, its blocks whole options, and a table a pipe for an escaped one."""

    def shown(found: re.Match[str]) -> str:
        text = found[1].replace("\\|", "|")
        return f"<code>{SHORT_WORD.sub(_whole, text)}</code>"

    html = INLINE_CODE.sub(shown, html)
    return BLOCK_OF_CODE.sub(lambda found: OPTION_OF_COMMAND.sub(_whole, found[0]), html)


def _whole(word: re.Match[str]) -> str:
    return f'<span class="word">{word[0]}</span>'
