"""Tables that fit the width there is: words are never broken, and the least important columns give way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

BETWEEN_COLUMNS = 2  # characters
LEFT_OUT_TEXT = "left out for width: {}; a wider terminal, COLUMNS=160 in a pipe, or --json has them"


@dataclass(frozen=True, slots=True, kw_only=True)
class FittingTable:
    """A table of texts.

    headings : of the columns. rows : cells, one for each heading. order : numbers of the columns that may give way, the
    first ones last; the others stay. right : numbers of the columns of numbers. whole : of other columns whose cells
    are not broken between words either.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    order: Sequence[int] = ()
    right: frozenset[int] = field(default_factory=frozenset)
    whole: frozenset[int] = field(default_factory=frozenset)

    def fitted(self, width: int) -> tuple[list[int], list[int]]:
        """Columns that are shown at so many characters, and those that are left out."""
        least = [self._longest_word(k) for k in range(len(self.headings))]
        shown, out = list(range(len(self.headings))), list[int]()
        for k in reversed(self.order):
            if sum(least[c] for c in shown) + BETWEEN_COLUMNS * (len(shown) - 1) <= width:
                break
            shown.remove(k)
            out.append(k)
        return shown, sorted(out)

    def _longest_word(self, k: int) -> int:
        """Characters of the longest word of a column; of numbers of the longest cell."""
        unbroken = k in self.right | self.whole
        words = [word for row in self.rows for word in ([row[k]] if unbroken else row[k].split())]
        return max(map(len, [*self.headings[k].split(), *words]), default=1)

    def widths(self, shown: Sequence[int], width: int) -> list[int]:
        """Characters of each shown column: its full width, or its longest word and a share of the rest."""
        least = [self._longest_word(k) for k in shown]
        wanted = [max(map(len, (self.headings[k], *(row[k] for row in self.rows)))) for k in shown]
        more = [max(0, a - b) for a, b in zip(wanted, least, strict=True)]
        spare = max(0, width - sum(least) - BETWEEN_COLUMNS * (len(shown) - 1))
        share = min(1.0, spare / (sum(more) or 1))
        return [a + int(share * b) for a, b in zip(least, more, strict=True)]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        shown, out = self.fitted(options.max_width)
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, BETWEEN_COLUMNS, 0, 0))
        for k, width in zip(shown, self.widths(shown, options.max_width), strict=True):
            table.add_column(Text(self.headings[k]), justify="right" if k in self.right else "left", width=width)
        for row in self.rows:
            table.add_row(*(Text(row[k]) for k in shown))
        yield table
        if out:
            yield Text(LEFT_OUT_TEXT.format(", ".join(self.headings[k] for k in out)), style="dim")
