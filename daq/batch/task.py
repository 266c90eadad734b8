"""One task: an analysis of one log or of one window of it. Its key, the memory that it may take, its row."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, replace
from typing import Any

from daq.base.contract.errors import ConfigError

from .archive import LogSource

ALL_ANALYSES = ("severity", "fit", "compare", "diagnose")  # in the order of the tables
WINDOWS_TASK = "windows"  # reads how long a log is; its row holds that
UNIT_SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
DURATION_PATTERN = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(s|min|h|d|)\s*")
BYTES_PER_MB = 1_000_000
# Largest memory of a worker: MB of itself with all that it has loaded, and bytes for each sample of each channel. One
# and a half times what 20 to 60 s of one and of four channels at 25.6 kHz take (tests/bench/test_bench_batch.py).
MEMORY_OF_TASK = {
    WINDOWS_TASK: (450, 25),
    "severity": (450, 25),
    "fit": (550, 90),
    "compare": (700, 110),
    "diagnose": (900, 120),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """--window and --every, s."""

    length_s: float
    every_s: float

    @classmethod
    def asked(cls, length: str | None, every: str | None) -> Windows | None:
        """From the texts of the command line. Raises ConfigError: one line, what is wrong and what to write."""
        if length is None:
            if every is not None:
                raise ConfigError(f"--every {every}: says how often, and --window is to say how long: give both")
            return None
        own = _seconds("--window", length)
        step = own if every is None else _seconds("--every", every)
        if step < own:
            raise ConfigError(f"--every {every} is shorter than --window {length}: windows would overlap; give more")
        return cls(length_s=own, every_s=step)

    def starts(self, seconds: float) -> list[float]:
        """Where the windows of a log of this length begin, s: those that lie wholly within it."""
        count = int((seconds - self.length_s) / self.every_s + 1e-9) + 1 if seconds >= self.length_s else 0
        return [k * self.every_s for k in range(count)]


def _seconds(option: str, text: str) -> float:
    match = DURATION_PATTERN.fullmatch(text)
    seconds = 0.0 if match is None else float(match[1]) * UNIT_SECONDS[match[2]]
    if seconds <= 0.0:
        raise ConfigError(f"{option} {text}: is no length of time; give such as 60s, 10min, 1h or 1d")
    return seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One task of a worker.

    name : an analysis, or WINDOWS_TASK. from_s, seconds : of a window; None of a whole log. version : of rotorscope,
    which the worker has to have.
    """

    log: LogSource
    name: str
    version: str
    from_s: float | None = None
    seconds: float | None = None

    @property
    def place(self) -> tuple[Any, ...]:
        """Identity of the row: a newer row of the same place replaces it."""
        return self.log.url, self.log.rig.path, self.name, self.from_s, self.seconds

    @property
    def key(self) -> str:
        """Changes when the log, the rig file, the task or the version does."""
        about = [*self.place, self.log.stamp, self.log.rig.digest, self.version]
        return hashlib.sha256(json.dumps(about).encode()).hexdigest()[:20]

    def windows(self, windows: Windows, seconds: float, names: list[str]) -> list[Task]:
        """The tasks of all windows of a log of this length."""
        return [
            replace(self, name=name, from_s=start, seconds=windows.length_s)
            for start in windows.starts(seconds)
            for name in names
        ]

    def row(self) -> dict[str, Any]:
        """The columns of the table of runs that are known before it runs."""
        return {
            "key": self.key,
            "log": self.log.url,
            "rig": self.log.rig.path,
            "machine": self.log.machine,
            "task": self.name,
            "from_s": self.from_s,
            "window_s": self.seconds,
            "version": self.version,
        }


def memory_bytes(task: str, values: int) -> int:
    """The most memory that a task takes of a record. values : samples of all channels."""
    own, each = MEMORY_OF_TASK[task]
    return own * BYTES_PER_MB + each * values


def analyses(text: str) -> list[str]:
    """The analyses of --do, in the order of the tables. Raises ConfigError for an unknown one."""
    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        if name not in ALL_ANALYSES:
            raise ConfigError(f'--do: "{name}" is no analysis of a record; there are {", ".join(ALL_ANALYSES)}')
    if not asked:
        raise ConfigError(f"--do names no analysis; give some of {', '.join(ALL_ANALYSES)}, with commas between")
    return [name for name in ALL_ANALYSES if name in asked]
