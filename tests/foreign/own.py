"""The same rigs without surroundings from the product's own simulator: complete models as the product means them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from .recorder import rig_file
from .scene import NOTHING, Scene


def own_record(scene: Scene, folder: Path, limit: float) -> Scene:
    """Write rig.toml, as the user has it, and record.mcap; the scene as it was simulated."""
    plain = replace(scene, around=NOTHING, hidden={}, strikes={}, cubic=False, tacho=False, speed_known=True)
    text = rig_file(plain, filters=False)
    (folder / "rig.toml").write_text(text)
    full = replace(plain, masses_known=True)
    linear = "".join(
        f"[model.linear.{p}]\nkL = {scene.kL[p]!r}\nc = {scene.c[p]!r}\nS = {scene.S[p]!r}\n" for p in scene.places
    )
    (folder / "true.toml").write_text(rig_file(full, filters=False).replace("[[channel]]", linear + "[[channel]]", 1))
    words = ["simulate", folder / "true.toml", "--out", folder / "record.mcap", "--seconds", round(scene.seconds, 3)]
    words += ["--seed", scene.seed]
    command = [sys.executable, "-m", "daq", *map(str, words), "--quiet"]
    subprocess.run(command, check=True, capture_output=True, timeout=limit)
    return plain
