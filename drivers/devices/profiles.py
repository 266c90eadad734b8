"""The devices by name: their framing, and the DBC of what stands in their packets."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drivers.contract.errors import LinkError

from .formats import EPSON_FORMAT, MIP_FORMAT, WITMOTION_FORMAT
from .packets import Framer, PacketFramer
from .text_numbers import TextNumbersFramer


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceProfile:
    """A device on a serial line. about : for the user. signals : "MESSAGE.SIGNAL" of its accelerations or numbers."""

    name: str
    about: str
    signals: tuple[str, ...]
    make: Callable[[], Framer]

    @property
    def dbc(self) -> bytes:
        """DBC file of the packets of a device."""
        return Path(__file__).with_name(f"{self.name}.dbc").read_bytes()


DEVICE_PROFILES = {
    profile.name: profile
    for profile in (
        DeviceProfile(
            name="witmotion", about="WitMotion, standard serial protocol (0x55), 16 g",
            signals=("Acceleration.X", "Acceleration.Y", "Acceleration.Z"), make=lambda: PacketFramer(WITMOTION_FORMAT),
        ),
        DeviceProfile(
            name="mip", about="MicroStrain MIP, scaled accelerometer (set 0x80, field 0x04)",
            signals=("Acceleration.X", "Acceleration.Y", "Acceleration.Z"), make=lambda: PacketFramer(MIP_FORMAT),
        ),
        DeviceProfile(
            name="m_a352", about="Epson M-A352, burst with flags, temperature, acceleration, count, check sum",
            signals=("Burst.X", "Burst.Y", "Burst.Z"), make=lambda: PacketFramer(EPSON_FORMAT),
        ),
        DeviceProfile(
            name="lines", about="lines of up to eight numbers as text",
            signals=tuple(f"Line.V{k}" for k in range(1, 9)), make=TextNumbersFramer,
        ),
    )
}  # fmt: skip


def profile_of(name: str) -> DeviceProfile:
    """Raises LinkError naming those that there are."""
    if name in DEVICE_PROFILES:
        return DEVICE_PROFILES[name]
    close = difflib.get_close_matches(name, DEVICE_PROFILES, 1)
    known = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(DEVICE_PROFILES)}"
    raise LinkError(f"device={name}: no device of this name; {known}")
