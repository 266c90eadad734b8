"""Devices of other makers: their DBC says in which unit a signal is; from here on it is in SI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from drivers.contract import Driver, Gap, Info, LinkStats, Notice, Reading, Signal

from .units import SI_UNIT, UNITS_OF_KIND, canonical


class InSI:
    """A driver whose signals are of any unit, as one that keeps the contract: SI value = counts * scale + offset.

    rig : channel -> kind and unit of the rig file. A unit that the DBC leaves out, or that nobody knows, is the rig's
    (the latter is told); one of another kind of quantity stays as it is: the pipeline says so.
    """

    def __init__(self, driver: Driver, rig: Mapping[str, tuple[str, str]]) -> None:
        self.kind = driver.kind
        self.stats: LinkStats = driver.stats
        self._driver = driver
        self._rig = rig

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
        for reading in reversed(self._driver.read(timeout_s)):  # an Info has no time: that of what follows it
            if isinstance(reading, Info):
                signals, unknown = zip(*(self._in_si(signal) for signal in reading.signals), strict=True)
                out += [Notice(stamp, "warning", "unknown_unit", text) for text in unknown if text]
                out.append(replace(reading, signals=signals))
            else:
                out.append(reading)
                stamp = stamp if isinstance(reading, Gap) else reading.t_host_ns
        return out[::-1]

    def _in_si(self, signal: Signal) -> tuple[Signal, str]:
        """And what is to be said of it."""
        kind, own = self._rig[signal.name]
        unit, said = canonical(signal.unit), ""
        if not any(unit in units for units in UNITS_OF_KIND.values()):
            if unit:
                said = f'{signal.name}: the DBC says "{signal.unit}", which is no unit known here: taken as {own}'
            unit = canonical(own)
        factor = UNITS_OF_KIND[kind].get(unit)
        if factor is None:
            return signal, said
        return replace(signal, unit=SI_UNIT[kind], scale=signal.scale * factor, offset=signal.offset * factor), said
