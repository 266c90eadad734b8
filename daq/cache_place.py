"""Where numba keeps compiled code. It gives up where it can keep none: a read-only installation and no home."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def choose() -> None:
    """Before numba is imported: a folder among the temporary files, if its own places cannot be written."""
    package = Path(__file__).parents[1] / "estimator"
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    if VARIABLE not in os.environ and not (_writable(package / "__pycache__") or _writable(home / "numba")):
        os.environ[VARIABLE] = str(_ours(Path(tempfile.gettempdir())))


def _writable(folder: Path) -> bool:
    """Tried, as numba does: what permissions say is not all."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _ours(temporary: Path) -> Path:
    """The same one each time, for compiling takes half a minute; never another user's: what is in it is executed."""
    user = getattr(os, "getuid", os.getpid)()
    path = temporary / f"rotorscope-numba-{user}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        about = path.lstat()
        if stat.S_ISDIR(about.st_mode) and about.st_uid == user and not about.st_mode & 0o077:
            return path
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="rotorscope-numba-"))
