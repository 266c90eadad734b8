"""The folder of this file is on the import path: helpers that several folders share lie beside it."""

import os
import platform
import signal

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings
from promises import TRIES, Late

# The first call of compiled code takes seconds, and this machine may be busy: time is for the benchmarks.
settings.register_profile("rotorscope", deadline=None)
settings.load_profile("rotorscope")

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded: as the command does (daq/cli.py)
if platform.machine() in ("x86_64", "AMD64"):  # the golden records hold for one kernel: another rounds otherwise
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job: what tests start would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

LATE = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    item.stash[LATE] = item.stash.get(LATE, False) or (call.excinfo is not None and call.excinfo.errisinstance(Late))
    return (yield)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """The row of a test that says what it promises; of one with parameters once."""
    os.environ.pop("COLUMNS", None)  # readline sets it: a pipe is as wide as it is without
    first = not any(getattr(getattr(item, "callspec", None), "indices", {}).values())
    for mark in item.iter_markers("promise"):
        row = ("reliability", " | ".join([*mark.args, "held"]))
        if first and row not in item.user_properties:
            item.user_properties.append(row)


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """A test in which a promise in seconds was not kept is tried again, from its fixtures on; no other is."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for left in reversed(range(TRIES)):
        item.stash[LATE] = False
        properties = list(item.user_properties)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if not (item.stash[LATE] and left):
            break
        item.user_properties[:] = properties
        if hasattr(item, "_initrequest"):
            item._initrequest()
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
