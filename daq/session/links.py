"""The name of a link and a rig -> a driver, constructed and not opened."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from daq.base.contract.errors import ConfigError
from daq.rig.in_si import InSI
from daq.rig.problems import Problem, line_numbers
from daq.rig.rig import Rig
from drivers.contract import CaptureConfig, Driver, LinkError, ReplayConfig, SerialConfig, VirtualConfig
from drivers.foreign import find_signals, load_dbc
from drivers.links import make_driver, parse_link
from drivers.protocol import Expected

LARGEST_DBC = 64 << 20  # bytes; a whole vehicle's has some
_DBC_OPTION = re.compile(r"([?&])dbc=([^&]*)&?")


def open_driver(url: str | None, rig: Rig, *, seed: int = 1, seconds: float | None = None) -> Driver:
    """The driver of a link; without a name that of the rig file. `?dbc=FILE` takes the place of the rig's DBC.

    Raises LinkError for a name that means nothing, ConfigError if there is none or its DBC cannot be read.
    """
    name = rig.link.url if url is None else url
    if name is None:
        raise ConfigError("no link: say --link LINK, or put url = into [link] of the rig file; rotorscope ports lists")
    if not name.strip():  # --link "$PORT" without a PORT must not fall back on the rig's link
        raise ConfigError("the link is empty; say --link LINK, such as slcan:/dev/ttyACM0; rotorscope ports lists")
    name, dbc = _without_dbc(name)
    config = parse_link(name)
    if isinstance(config, ReplayConfig):
        from daq.log.reader import read_log

        from .replay import ReplayDriver

        return ReplayDriver(read_log(config.path), config.speed)
    expected = Expected(rig.acquisition.rate_hz if rig.acquisition else None, tuple(rig.units))
    if isinstance(config, VirtualConfig):
        from .simulation import machine

        return make_driver(config, expected=expected, device=machine(rig, seed=seed, seconds=seconds).device)
    if isinstance(config, CaptureConfig) and config.rate_hz is None and rig.acquisition is not None:
        config = replace(config, rate_hz=rig.acquisition.rate_hz)
    signals = {c: rig.link.signals[c] for c in rig.units if c in rig.link.signals} or None
    named = isinstance(config, SerialConfig) and config.device and not dbc and rig.dbc is None  # it brings its own
    text = _dbc(Path(dbc) if dbc else rig.dbc) if signals and not named else None
    if signals is None and dbc:
        raise ConfigError(f'{name}: a DBC needs [link.signals] in the rig file: channel = "MESSAGE.SIGNAL" for each')
    if signals is not None and (left := [c for c in rig.units if c not in signals]):
        raise ConfigError(f'link.signals: no signal for {", ".join(left)}; add {left[0]} = "MESSAGE.SIGNAL"')
    driver = make_driver(config, dbc=text, signals=signals, expected=expected)
    return driver if signals is None else InSI(driver, rig.file.channel)


def check_signals(rig: Rig) -> None:
    """Raises ConfigError, with a line for each signal of [link.signals] that the DBC of the rig file does not have.

    Without `dbc` in the file nothing is looked at: the link may name one, or the device brings its own.
    """
    signals = rig.link.signals
    if not signals or rig.dbc is None:
        return
    try:
        database = load_dbc(_dbc(rig.dbc))
    except LinkError as error:
        raise ConfigError(f"{rig.dbc}: {error}") from error
    problems = []
    taken: dict[str, str] = {}
    for channel in rig.units:
        path = ("link", "signals", channel)
        if channel not in signals:
            problems.append(Problem(path[:2], f'no signal for {channel}; add {channel} = "MESSAGE.SIGNAL"'))
            continue
        if other := taken.get(signals[channel]):
            problems.append(Problem(path, f'"{signals[channel]}" is the signal of {other} already; correct one'))
        taken.setdefault(signals[channel], channel)
        try:
            find_signals(database, channel, signals[channel])
        except LinkError as error:
            problems.append(Problem(path, str(error)))
    if problems:
        lines = line_numbers(rig.text)
        raise ConfigError("\n".join(problem.line(str(rig.path), lines) for problem in problems))


def _without_dbc(url: str) -> tuple[str, str | None]:
    found = _DBC_OPTION.search(url)
    if found is None:
        return url, None
    rest = url[: found.start()] + found[1] + url[found.end() :]
    return rest.rstrip("?&"), found[2]


def _dbc(path: Path | None) -> bytes:
    if path is None:
        raise ConfigError("link.signals needs a DBC: add dbc = FILE to [link] of the rig file, or ?dbc=FILE")
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: the DBC of [link] is not a file; correct dbc in the rig file, or add ?dbc=FILE")
        if path.stat().st_size > LARGEST_DBC:
            raise ConfigError(f"{path}: the DBC of [link] is larger than {LARGEST_DBC >> 20} MB; check the path")
        return path.read_bytes()
    except OSError as error:
        text = f"{path}: the DBC of [link] cannot be read: {error.strerror}"
        raise ConfigError(f"{text}; correct dbc in the rig file, or add ?dbc=FILE to the link") from error


__all__ = ["LinkError", "check_signals", "open_driver"]
