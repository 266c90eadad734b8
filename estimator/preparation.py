"""A record as the model sees it: sensor effects of the model undone, then cut into blocks."""

from __future__ import annotations

from .arrays import Array
from .cut_record import cut
from .model import Model
from .motion_blocks import MotionBlocks, part_of
from .sensor_response import undone

SHORTEST = 2**16  # samples, 2.6 s at 25.6 kHz: with fewer even strong effects may be missed
LONGEST = 240.0  # s of a record that is kept in memory, about 10 MB each; six stretches of it, spread over the whole


def prepare(model: Model, y: Array, rate_hz: float) -> MotionBlocks:
    """Blocks of a record y (n, channels), SI. Raises DataError as `cut` does."""
    return part_of(cut(model, undone(model, y, rate_hz), rate_hz), LONGEST)


def shortened(data: MotionBlocks, y: Array) -> tuple[str, ...]:
    """What to tell the user of a record longer than what is kept of it, or so short that little is seen in it."""
    used, whole = data.seconds, len(y) / data.rate_hz
    if data.blocks * data.block < SHORTEST:
        text = "what it does not show may be there all the same; record half a minute or more"
        return (f"only {used:.2g} s of the record can be judged: {text}",)
    if whole <= 1.25 * LONGEST or used < 0.9 * LONGEST:
        return ()
    return (f"of the record's {whole:.0f} s {used:.0f} are judged, in six stretches spread over it",)
