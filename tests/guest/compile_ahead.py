"""Runs on the host before the guest boots: compiles what the tests will need into the shared cache, prints loop_s()."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from can_guest import loop_s, write_rig  # noqa: E402

from daq.commands.cli.app import main  # noqa: E402


def compile_ahead(folder: Path) -> int:
    """A session of the tests' rig on a virtual bus."""
    rig = str(write_rig(folder))
    return main(["run", rig, "--link", "virtual:", "--seconds", "3", "--out", str(folder / "warm.mcap"), "--quiet"])


if __name__ == "__main__":
    status = compile_ahead(Path(sys.argv[1]))
    print(loop_s())
    sys.exit(status)
