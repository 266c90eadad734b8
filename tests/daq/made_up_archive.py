"""A small archive: records of two channels with a tone, as files that rotorscope imports, and a rig file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

RATE_HZ = 6400.0
RIG_TOML = """schema = 1
[rig]
speed_rpm = 1500.0
[machine]
iso20816 = { part = 3, group = 2, support = "rigid" }
[band]
low = 20.0
high = 2000.0
[[channel]]
name = "a"
node = "bearing1"
direction = "x"
unit = "g"
[[channel]]
name = "b"
node = "bearing1"
direction = "y"
kind = "velocity"
unit = "mm/s"
"""
TIMES = ("took_s", "cpu_s", "peak_mb", "run_at")  # columns that differ between two runs


def record(path: Path, seconds: float = 4.0, level: float = 1.0, seed: int = 0) -> None:
    """25 Hz of 3 mm/s rms times `level` on both channels."""
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    noise = np.random.default_rng(seed).standard_normal((2, t.size))
    tone = level * 3.0 * np.sqrt(2.0) * np.sin(2 * np.pi * 25.0 * t)
    a = tone * 1e-3 * 2 * np.pi * 25.0 / 9.80665 + 1e-3 * noise[0]
    np.savez(path, rate_hz=RATE_HZ, a=a, b=tone + 1e-2 * noise[1])


def archive(folder: Path, count: int) -> None:
    """rig.toml and so many records."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(RIG_TOML)
    for k in range(count):
        record(folder / f"record{k:03d}.npz", level=1.0 + k, seed=k)


def table(folder: Path, name: str) -> list[dict[str, Any]]:
    """The rows of a table without the columns that are times."""
    rows: list[dict[str, Any]] = pq.read_table(folder / f"{name}.parquet").to_pylist()
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]
