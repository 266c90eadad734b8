"""A channel that is late."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def apply(y: NDArray[np.float64], rate_hz: float, p: Sequence[float], rng: np.random.Generator) -> NDArray[np.float64]:
    """The samples delayed by the phase of their Fourier transform; a few samples at the ends are affected."""
    pad = 64
    whole = np.pad(y, pad, mode="reflect") if len(y) > pad else y
    f = np.fft.rfftfreq(len(whole), 1.0 / rate_hz)
    late = np.fft.irfft(np.fft.rfft(whole) * np.exp(-2j * np.pi * f * p[0]), len(whole))
    return np.asarray(late[pad : pad + len(y)] if len(y) > pad else late)


def channel_response(w: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.complex128]:
    return np.asarray(np.exp(-1j * w * p[0]))


SENSOR_SKEW = Effect(
    name="sensor_skew",
    kind="sensor",
    parameters=(searched("delay", "s", "how late the channel is", (-10.0, 10.0, 1.0), scale="sample"),),
    equation="measured(t) = true(t - delay)",
    signature="phase between this channel and the others grows in proportion to frequency; amplitudes are right",
    confused_with=("cross_coupling", "gyroscopic", "pedestal"),
    distinguish=(
        "phase is linear in frequency up to the top of the band, and only for this channel; physics has phase "
        "near its resonances"
    ),
    reference="Bendat and Piersol, Random Data, 4th ed., Wiley 2010 (multiplexed sampling)",
    check="phase of the cross spectrum with the undelayed signal is -2 pi f delay",
    on_machine=(
        "multiplexed converter, other filter setting or firmware of one channel, two devices without a common clock; "
        "it is found beside a measured force only, and undone where the rig file gives it"
    ),
    apply=apply,
    found_by="spectrum",
    channel_response=channel_response,
    typical={"delay": (0.3, 1.0)},
)
