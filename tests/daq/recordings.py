"""What is in a Rerun recording."""

from __future__ import annotations

import warnings
from pathlib import Path


def entities(path: Path) -> dict[str, int]:
    """Rows of every entity of a recording, from Rerun's own reader."""
    from rerun.chunk import RrdReader
    from rerun.error_utils import RerunWarning

    rows: dict[str, int] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RerunWarning)  # a receiver that is killed writes no footer
        reader = RrdReader(str(path))
    for chunk in reader.stream():
        rows[chunk.entity_path.lstrip("/")] = rows.get(chunk.entity_path.lstrip("/"), 0) + chunk.num_rows
    return rows
