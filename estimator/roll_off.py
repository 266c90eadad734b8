"""What a recorder takes of every channel alike towards the end of the band: anti-alias filters, means over samples.

All channels fall, the more the higher the frequency, and none rises on the way as behind a resonance. Of the inferred
force that is a colour that no rotor has: it goes into the shape of its spectrum (motion_blocks.colours), and nothing is
said to be missing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .model import Model

Array = NDArray[np.float64]
POWERS = np.array([2, 4, 8, 16, 32])  # of frequency: a mean of samples falls by the first
FROM = 2.0  # times the highest resonance, from where laws and damping shape the inferred force no more
SURE, STEEP = 4.0, 0.004  # standard deviations, and nepers of power to the top, of a fall worth a look
SAID = 0.1  # dB at the end of the band


def gain(roll_off: tuple[float, ...], f_hz: Array, top_hz: float) -> Array:
    """(f,) of power, 1 at zero. roll_off : (5,) nepers of power at the end of the band, each by its power of f."""
    if not roll_off:
        return np.ones_like(f_hz)
    return np.asarray(np.exp(-((f_hz[:, None] / top_hz) ** POWERS) @ np.array(roll_off)))


def said(model: Model) -> tuple[str, ...]:
    """What to tell the user of it."""
    fall = 10 / np.log(10) * sum(model.roll_off)
    if fall < SAID:
        return ()
    return (
        f"all channels fall alike towards the end of the band, by {fall:.1f} dB at {model.band[1]:g} Hz: taken for the "
        "recorder's filter, not for the rotor's (a colour of the forces with its corner above the band looks the same)",
    )


def suspected(power: Array, f_hz: Array, count: Array, resonance_hz: float) -> bool:
    """Whether all places seem to fall: a cheap look before common_fall.find. power : (cells, places) of the inferred
    force over the model's; f_hz, count : (cells,) mean frequency, and number of independent values."""
    above = f_hz > FROM * resonance_hz
    if above.sum() < 3:
        return False
    x, n = (f_hz[above] / f_hz[-1]) ** 8, count[above]
    x -= np.average(x, weights=n)
    slope, sd = (n * x) @ np.log(power[above]) / (n @ x**2), 1 / np.sqrt(n @ x**2)
    return bool(np.all(slope < -np.maximum(SURE * sd, STEEP)))
