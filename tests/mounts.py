"""Mounts that only one command sees: for tests as root on Linux."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from promises import PATIENCE_S

PAPER_RIG_PATH = Path(__file__).parents[1] / "configs" / "tiwari_vyas_1997.toml"


def light_rig(folder: Path) -> Path:
    """The rig file of the paper with an estimator that takes little of a core, in a folder."""
    path = folder / "rig.toml"
    path.write_text(PAPER_RIG_PATH.read_text().replace('method = "spectral"', 'method = "score-matching"'))
    return path


def in_namespace(script: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Of bash, in `folder`, with mounts of its own."""
    command = ["unshare", "-m", "bash", "-euc", script]
    environment = os.environ | more
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
