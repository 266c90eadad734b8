"""Resonance of a sensor or of its mounting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.model.effect import Effect, searched


def apply(y: NDArray[np.float64], rate_hz: float, p: Sequence[float], rng: np.random.Generator) -> NDArray[np.float64]:
    """The samples after the resonance; ringing at the ends is cut off with a pad of up to 512 samples."""
    pad = min(512, max(len(y) - 1, 0))
    whole = np.pad(y, pad, mode="reflect")
    r = np.fft.rfftfreq(len(whole), 1.0 / rate_hz) / p[0]
    out = np.fft.irfft(np.fft.rfft(whole) / (1.0 - r**2 + 1j * r / p[1]), len(whole))
    return np.asarray(out[pad : pad + len(y)])


def channel_response(w: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.complex128]:
    r = w / (2 * np.pi * p[0])
    return np.asarray(1.0 / (1.0 - r**2 + 1j * r / p[1]))


def spectral_factor(f_hz: NDArray[np.float64], p: Sequence[float]) -> NDArray[np.float64]:
    r = f_hz / p[0]
    return np.asarray(1.0 / ((1 - r**2) ** 2 + (r / p[1]) ** 2))


SENSOR_RESONANCE = Effect(
    name="sensor_resonance",
    kind="sensor",
    parameters=(
        searched("frequency", "Hz", "resonance", (0.1, 3.0, 0.7), scale="band"),
        searched("quality", "1", "quality factor", (1.0, 100.0, 10.0)),
    ),
    equation="measured / true = 1 / (1 - (f / f0)^2 + i f / (f0 quality))",
    signature=(
        "a peak in one channel at a frequency that is in no other, with the phase turning there; it multiplies "
        "what is measured and is not a mode of the rotor"
    ),
    confused_with=("pedestal", "coloured_excitation"),
    distinguish=(
        "no anti-resonance and no trace in the other direction or bearing; rises before the peak as 1 / (1 - (f/f0)^2)"
    ),
    reference=(
        "Serridge and Licht, Piezoelectric Accelerometers and Vibration Preamplifiers, Bruel and Kjaer 1987 "
        "(mounted resonance)"
    ),
    check="gain at f0 is the quality, far below it 1",
    on_machine="magnet, wax or hand-held probe instead of a stud; a loose stud; paint under the sensor",
    apply=apply,
    found_by="spectrum",
    channel_response=channel_response,
    spectral_factor=spectral_factor,
    typical={"frequency": (1.2, 0.7)},
)
