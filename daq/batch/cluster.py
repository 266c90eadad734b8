"""The Dask cluster that a batch works on: processes of this computer, or one that exists, by its address."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import Any

from daq.base.console.output import version
from daq.base.contract.errors import ConfigError
from drivers.contract import LinkError

LOCAL_WORD = "local"
ANSWER_S = 20  # for a scheduler to answer, and for a first worker to be there
CLOSE_S = 2  # for workers that are asked to end
MAX_DEATHS = 2  # of workers over one task, before it is taken for the cause


@contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """A Dask client. address : "local:N", None for as many processes as there are cores, or that of a scheduler.

    Raises ConfigError for an address that is none, LinkError where no scheduler answers or it has no workers.
    """
    word, _, count = (address or LOCAL_WORD).partition(":")
    if word == LOCAL_WORD:
        if count and not (count.isdecimal() and 0 < int(count) < 1000):
            raise ConfigError(f"--scheduler {address}: give the number of processes, such as local:4")
        own = _here(int(count or cores()))
    elif "://" not in str(address):
        raise ConfigError(f"--scheduler {address}: give local:N, or an address such as tcp://10.0.0.5:8786")
    else:
        own = _there(str(address))
    logging.disable(logging.CRITICAL)  # Dask logs at length what the command reports in one line
    try:
        with own as client:
            yield client
    finally:
        logging.disable(logging.NOTSET)


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _here(count: int) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster

    options = {"n_workers": count, "threads_per_worker": 1, "processes": True, "dashboard_address": "127.0.0.1:0"}
    with dask.config.set({"distributed.scheduler.allowed-failures": MAX_DEATHS}), uninterrupted_children():
        try:
            cluster = LocalCluster(silence_logs=logging.CRITICAL, **options)
        except (OSError, RuntimeError) as error:
            fewer = f"local:{max(1, count // 2)}"
            text = f"--scheduler local:{count}: the processes cannot be started: {error}; give fewer, such as {fewer}"
            raise LinkError(text) from error
    client = Client(cluster, set_as_default=False)
    try:
        yield client
    except BaseException:
        _kill(cluster)
        raise
    finally:
        with suppress(Exception):  # of what does not end in time, and ends with us
            client.close(timeout=CLOSE_S)
        with suppress(Exception):
            cluster.close(timeout=CLOSE_S)


def _ask_version(client: Any, address: str) -> None:
    """Raise ConfigError unless every worker has this version: its numbers would be others."""
    found = client.run(version, on_error="return")
    others = {worker: said if isinstance(said, str) else "none" for worker, said in found.items() if said != version()}
    wrong = [f"{worker} has {said}" for worker, said in others.items()]
    if wrong:
        text = f"needs rotorscope {version()} at every worker, and {wrong[0]}; install it there, and start them again"
        raise ConfigError(f"{address}: {text}")


def _kill(cluster: Any) -> None:
    """End workers in the middle of their tasks: what they do is wanted no more."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        with suppress(ProcessLookupError, TypeError):  # it has ended, or never began
            os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))


@contextmanager
def uninterrupted_children() -> Iterator[None]:
    """Block Ctrl-C for the processes that are started within, which inherit the block.

    A terminal sends Ctrl-C to them too, and they have to be asked to end. A Ctrl-C that this process gets within takes
    effect at the end.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # a tracker that is started within would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _there(address: str) -> Iterator[Any]:
    from distributed import Client

    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        text = "no Dask scheduler answers there; start one with `dask scheduler`, or check the address"
        raise LinkError(f"{address}: {text}") from error
    try:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError as error:
            text = f"the scheduler has no workers; start some: dask worker {address} --nthreads 1 --nworkers auto"
            raise LinkError(f"{address}: {text}") from error
        _ask_version(client, address)
        yield client
    finally:
        with suppress(Exception):  # the scheduler may be gone
            client.close(timeout=CLOSE_S)
