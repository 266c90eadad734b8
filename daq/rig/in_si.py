"""Converts signals of other makers' devices, whose DBC gives the unit, to SI."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from daq.base.contract.errors import ConfigError
from drivers.contract import Driver, Gap, Info, LinkStats, Notice, Reading, Signal

from .conversion import conversion
from .rig_file import ChannelTable
from .units import SI_UNIT, UNITS_OF_KIND, VOLTS_OF_UNIT, canonical


class InSI:
    """A driver whose signals are of any unit, as one that keeps the contract: SI value = counts * scale + offset.

    channels : of the rig file. A unit that the DBC leaves out, or that is unknown, is the rig's (a notice names an
    unknown one). A unit of another kind of quantity is kept, and the pipeline reports it. Volts need a sensitivity:
    `read` raises ConfigError without one.
    """

    def __init__(self, driver: Driver, channels: Iterable[ChannelTable]) -> None:
        self.kind = driver.kind
        self.stats: LinkStats = driver.stats
        self._driver = driver
        self._channels = {c.name: c for c in channels}

    @property
    def exhausted(self) -> bool:
        return self._driver.exhausted

    def open(self) -> None:
        self._driver.open()

    def close(self) -> None:
        self._driver.close()

    def read(self, timeout_s: float) -> list[Reading]:
        out: list[Reading] = []
        stamp = 0
        for reading in reversed(
            self._driver.read(timeout_s)
        ):  # an Info has no time: its notice gets that of the next reading
            if isinstance(reading, Info):
                signals, unknown = zip(*(self._in_si(signal) for signal in reading.signals), strict=True)
                out += [Notice(stamp, "warning", "unknown_unit", text) for text in unknown if text]
                out.append(replace(reading, signals=signals))
            else:
                out.append(reading)
                stamp = stamp if isinstance(reading, Gap) else reading.t_host_ns
        return out[::-1]

    def _in_si(self, signal: Signal) -> tuple[Signal, str]:
        """The signal in SI, and a warning about its unit, "" if none."""
        channel = self._channels[signal.name]
        unit, said = canonical(signal.unit), ""
        if unit not in VOLTS_OF_UNIT and not any(unit in units for units in UNITS_OF_KIND.values()):
            if unit:
                text = f'the DBC says "{signal.unit}", which is no unit known here: taken as {channel.unit}'
                said = f"{signal.name}: {text}"
            unit = canonical(channel.unit) if unit or channel.sensitivity is None else ""
        if unit and unit not in VOLTS_OF_UNIT and unit not in UNITS_OF_KIND[channel.kind]:
            return signal, said
        try:
            to = conversion(channel, unit)
        except ValueError as error:
            raise ConfigError(f"{signal.name}: {error}") from error
        scale, offset = signal.scale * to.scale, signal.offset * to.scale + to.offset
        return replace(signal, unit=SI_UNIT[channel.kind], scale=scale, offset=offset), said
