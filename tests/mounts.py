"""Mounts that only one command sees: for tests as root on Linux."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from promises import PATIENCE_S


def in_namespace(script: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Of bash, in `folder`, with mounts of its own."""
    command = ["unshare", "-m", "bash", "-euc", script]
    environment = os.environ | more
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
