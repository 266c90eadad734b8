"""What all tests in the guest begin with."""

from __future__ import annotations

import time

import pytest
from can_guest import write_rig

from daq.commands.cli.app import main


@pytest.fixture(scope="session", autouse=True)
def _imported(tmp_path_factory: pytest.TempPathFactory) -> None:
    """One session in this process, from which all others are forked: imports take half a minute in the emulation."""
    folder = tmp_path_factory.mktemp("imported")
    begin = time.monotonic()
    rig, log = str(write_rig(folder)), str(folder / "a.mcap")
    status = main(["run", rig, "--link", "virtual:", "--seconds", "1", "--out", log])
    print(f"everything imported after {time.monotonic() - begin:.0f} s")
    assert status == 0
