"""Chooses and cleans the folder of numba's compiled code: numba fails without one, or over files of a power cut."""

from __future__ import annotations

import contextlib
import os
import pickle
import stat
import tempfile
from pathlib import Path

CACHE_VARIABLE = "NUMBA_CACHE_DIR"  # of the environment, numba's
INSTALLATION_FOLDER = Path(__file__).parents[2]  # the folder of the three packages
COMPILED_PACKAGES = ("estimator", "drivers")  # whose functions numba compiles
BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")
CHECKED_FILE = "checked-in-boot"  # beside the checked files


def choose(root: Path = INSTALLATION_FOLDER) -> None:
    """Choose a temporary folder before numba is imported, if its default folders cannot be written.

    This is so for a read-only installation without a home folder.
    """
    own = root / COMPILED_PACKAGES[0] / "__pycache__"
    if CACHE_VARIABLE not in os.environ and not (_writable(own) or _writable(_home())):
        os.environ[CACHE_VARIABLE] = str(_ours(Path(tempfile.gettempdir())))


def clean(root: Path = INSTALLATION_FOLDER, boot_id: Path = BOOT_ID_FILE) -> None:
    """Remove files that are empty or cut: numba would fail in every command because of them.

    Once in each place after the computer has started: numba itself leaves none, a power cut does. By the kernel's name
    for this start, not by times: a computer without a battery clock starts in the past.
    """
    boot = _boot(boot_id)
    folders = {file.parent for package in COMPILED_PACKAGES for file in (root / package).rglob("*.py")}
    places = {folder / "__pycache__" for folder in folders}
    for cache in {_home(), Path(os.environ.get(CACHE_VARIABLE) or _home())}:
        places |= {place for folder in folders for place in cache.glob(f"{folder.name}_*")}
    for place in places:
        if boot and _checked(place) == boot:
            continue
        for path in place.glob("*.nb[ic]"):
            with contextlib.suppress(OSError):
                if not _has_end(path):
                    path.unlink()
        with contextlib.suppress(OSError):  # not ours to write to, or not there
            (place / CHECKED_FILE).write_bytes(boot)


def _boot(boot_id: Path) -> bytes:
    """Empty where the system does not say: then all are looked at each time."""
    try:
        return boot_id.read_bytes().strip()
    except OSError:
        return b""


def _checked(place: Path) -> bytes:
    try:
        return (place / CHECKED_FILE).read_bytes()
    except OSError:
        return b""


def _home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"


def _has_end(path: Path) -> bool:
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        return file.read() == pickle.STOP


def _writable(folder: Path) -> bool:
    """Whether a folder can be written, tried as numba does: permissions alone do not show it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _ours(temporary: Path) -> Path:
    """A folder of this user alone, as its content is executed. All runs share it, as compiling takes half a minute."""
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
