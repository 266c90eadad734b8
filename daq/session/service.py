"""Acquisition and replay in one call: link, log, rolling estimate, and the naming of a missing force."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Sequence
from pathlib import Path

from daq.base.contract.dates import Recorded
from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.sink import Sink
from daq.log.reader import Recording, read_log
from daq.log.writer import LogWriter
from daq.rig.rig import Rig
from drivers.contract import LinkOpenError

from .acquire import FINITE_KINDS, RECORDED_KINDS, Notify, RunSummary, acquire_from
from .layer_watch import LayersListener, LayerWatch
from .links import open_driver
from .naming import Naming
from .replay import logged_rig, replay_into


def acquire(
    rig: Rig, link: str | None = None, *, seconds: float | None = None, out: str | Path | None = None,
    stop: threading.Event | None = None, notify: Notify | None = None,
) -> RunSummary:  # fmt: skip
    """Acquire samples from a link into a log, with the rolling estimate of the rig file.

    Parameters
    ----------
    rig : Rig
        The rig file: channels, rate, model and estimator.
    link : str, optional
        Name of the link, as for ``rotorscope run --link``: "virtual:", "can:INTERFACE:CHANNEL?...", "slcan:PORT",
        "serial:PORT", "capture:FILE", "replay:LOG.mcap". None: the link of the rig file.
    seconds : float, optional
        Stop after this many seconds of data. None: at the end of the source, or when `stop` is set.
    out : path, optional
        Write a log (MCAP) there. A log that is there already gets another name.
    stop : threading.Event, optional
        Ends the acquisition when another thread sets it; the log is complete then too.
    notify : callable, optional
        Called with each notice (level, code, text) that an operator should read.

    Returns
    -------
    RunSummary
        ``samples``, ``lost_samples`` and ``gaps`` of each channel, ``last_estimate``, ``problems``.

    Raises
    ------
    ConfigError
        There is no link, or the device does not have the channels of the rig.
    LinkError
        The link cannot be opened, or no sample came (`drivers.contract.LinkError`).
    LogError
        The log cannot be written, or is not complete.

    Examples
    --------
    Half a second of the simulated machine that the rig file describes:

    >>> from tempfile import TemporaryDirectory
    >>> from daq import acquire, load_rig, read_log
    >>> rig = load_rig("configs/one_bearing.toml")
    >>> with TemporaryDirectory() as folder:
    ...     summary = acquire(rig, "virtual:", seconds=0.5, out=f"{folder}/bearing.mcap")
    ...     y = read_log(f"{folder}/bearing.mcap").samples(rig)
    >>> summary.samples, summary.lost_samples, y.shape
    (6400, 0, (6400, 2))
    """
    driver = open_driver(link, rig)
    live = driver.kind not in FINITE_KINDS
    recorded = Recorded(getattr(driver, "wall_offset_ns", None)) if driver.kind in RECORDED_KINDS else None
    sinks = _sinks(rig, out, live, recorded)
    name = link or rig.link.url or ""
    metadata = {"command": "acquire", "link": name}
    summary = acquire_from(rig, driver, sinks, seconds, stop, metadata=metadata, notify=notify)
    problem = failure(summary, name, stopped=stop is not None and stop.is_set())
    if problem is not None:
        raise problem
    return summary


def replay(
    log: Recording | str | Path, rig: Rig | None = None, *, out: str | Path | None = None, speed: float | None = None,
    check: bool = False, seconds: float | None = None, stop: threading.Event | None = None,
    notify: Notify | None = None,
) -> RunSummary:  # fmt: skip
    """Run the samples of a log through the pipeline of an acquisition again.

    Parameters
    ----------
    log : Recording or path
        The log.
    rig : Rig, optional
        Another rig file than the one in the log.
    out : path, optional
        Write a new log there.
    speed : float, optional
        Times real time. None: as fast as possible.
    check : bool
        Compare the estimates with the logged ones: ``identical`` and ``compared`` of the summary.
    seconds : float, optional
        Stop after this many seconds of data.
    stop : threading.Event, optional
        Ends the replay when another thread sets it.
    notify : callable, optional
        Called with each notice (level, code, text) that an operator should read.

    Returns
    -------
    RunSummary
        As of `acquire`; ``identical`` is None without `check`.

    Raises
    ------
    LogError
        The log cannot be read, holds no rig file and none is given, holds no estimates to check, or holds no samples
        for `out`.
    ConfigError
        `out` is the log itself, or the log does not have the channels of the rig.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from daq import acquire, load_rig, replay
    >>> rig = load_rig("configs/one_bearing.toml")
    >>> with TemporaryDirectory() as folder:
    ...     recorded = acquire(rig, "virtual:", seconds=0.5, out=f"{folder}/bearing.mcap")
    ...     again = replay(f"{folder}/bearing.mcap", check=True)
    >>> again.samples == recorded.samples, again.identical
    (True, True)
    """
    recording = log if isinstance(log, Recording) else read_log(log)
    refuse_own_log(recording.path, out)
    rig = rig or logged_rig(recording)
    dated = recording.started_ns is not None
    sinks = _sinks(rig, out, live=False, recorded=Recorded(recording.head.wall_offset_ns if dated else None))
    summary = replay_into(recording, rig, sinks, speed=speed, check=check, seconds=seconds, stop=stop, notify=notify)
    problem = replay_failure(summary, recording.path, out)
    if problem is not None:
        raise problem
    return summary


def _sinks(rig: Rig, out: str | Path | None, live: bool, recorded: Recorded | None) -> list[Sink]:
    writers: list[Sink] = [] if out is None else [LogWriter(out, live=live, recorded=recorded)]
    return writers + naming_sinks(rig, live)


def naming_sinks(rig: Rig, live: bool, listeners: Sequence[LayersListener] = ()) -> list[Sink]:
    """The sinks that report the layers, and name an effect that the model begins to lack.

    The second one is there if the rolling estimate of the rig looks for a missing force. listeners : get the layers.
    """
    naming: list[Sink] = [Naming(rig, live)] if rig.estimator.method == "spectral" else []
    return [LayerWatch(rig.model, live, rig.si_units, listeners), *naming]


def log_path(sinks: Sequence[Sink], out: Path | None) -> Path | None:
    """Where the log is by now: elsewhere than at `out` if it was removed and could not be put back there."""
    if out is None:
        return None
    path = next((sink.path for sink in sinks if isinstance(sink, LogWriter)), out)
    with contextlib.suppress(OSError):  # the folder that we were started in is gone
        return out if os.path.realpath(path) == os.path.realpath(out) else path
    return path


def failure(summary: RunSummary, link: str, stopped: bool = False) -> Exception | None:
    """Why an acquisition that came to its end failed nevertheless: its log is not complete, or nothing came.

    stopped : by the user, also before the first sample.
    """
    if summary.lost_log:
        return LogError(summary.lost_log)
    if summary.samples or stopped:
        return None
    if summary.kind == "capture":
        what = "it holds no frame of a device of protocol v1; for another maker's set link.dbc and [link.signals]"
    elif summary.stats.frames:
        what = "frames came, but none of the rig's channels; check the device, and [link] of the rig file"
    elif summary.stats.bytes:
        came = f"{summary.stats.bytes} bytes came, but no samples"
        what = f"{came}; check the kind of link (slcan: or serial:), the bit rate, and the device"
    else:
        what = "nothing came; check the device, its bit rate, and [link] of the rig file"
    return LinkOpenError(f"{link}: {what}")


def refuse_own_log(log: Path, out: str | Path | None) -> None:
    """Raise ConfigError if the new log of a replay is to lie where the replayed one does."""
    if out is not None and Path(out).exists() and log.exists() and log.samefile(out):
        raise ConfigError(f"{out}: is the log to be replayed; choose another place for the new log")


def replay_failure(summary: RunSummary, log: Path, out: str | Path | None) -> Exception | None:
    """Why a replay that came to its end failed nevertheless: its new log is not complete, or there is none."""
    if summary.lost_log:
        return LogError(summary.lost_log)
    if out is not None and not summary.samples + summary.lost_samples:
        return LogError(f"{log}: holds no samples, so there is no {out}")
    return None
