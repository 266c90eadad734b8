"""A fast device for the benchmarks: serial frames made beforehand, written to a pseudo-terminal at their pace.

python device_process.py RATE_HZ SECONDS STAMPS: prints the port, waits for a line, streams, writes to STAMPS the host
monotonic time (ns, int64) at which each frame of 64 samples had left, then holds the port until it is killed.
"""

from __future__ import annotations

import os
import sys
import termios
import time
import tty

import numpy as np

from drivers.contract.reading import Signal
from drivers.protocol.protocol import SERIAL16_LAYOUT, InfoRecord
from drivers.serial import cobs
from drivers.serial.serial_decoder import pack_info_body, pack_samples

ROWS = 64
CHANNELS = ("b1x", "b1y", "b2x", "b2y")


def resonance(rows: int, rate_hz: float = 25_600.0, seed: int = 0) -> np.ndarray:
    """(rows, 4) counts of a bearing on its spring, 1.1 kHz, driven by noise."""
    from scipy.signal import lfilter

    pole = np.exp((-0.05 + 1j) * 2 * np.pi * 1100.0 / rate_hz)
    drive = np.random.default_rng(seed).standard_normal((rows, 4))
    motion = lfilter([1.0, -2.0, 1.0], [1.0, -2 * pole.real, abs(pole) ** 2], drive, axis=0)
    return np.round(motion / motion.std() * 3000).astype(np.int32)


def frames(rate_hz: float, seconds: float) -> tuple[bytes, list[bytes]]:
    """The info frames, and every frame of samples."""
    info = b"".join(
        cobs.encode(
            pack_info_body(
                InfoRecord(
                    SERIAL16_LAYOUT.code,
                    4,
                    c,
                    16,
                    serial_number=1,
                    rate_hz=rate_hz,
                    signal=Signal(name, "m/s^2", 490.5 / 32767),
                    full_scale=490.5,
                    epoch=1,
                )
            )
        )
        for c, name in enumerate(CHANNELS)
    )
    count = int(seconds * rate_hz / ROWS)
    counts = resonance(count * ROWS, rate_hz)  # noise that repeats has a spectrum of lines
    flags = (1 << 2) | (1 << 4)
    out = []
    for k in range(count):
        time_us = round(k * ROWS * 1e6 / rate_hz)
        out.append(cobs.encode(pack_samples(k * ROWS, 0, flags, time_us, counts[k * ROWS : (k + 1) * ROWS])))
    return info, out


def main() -> None:
    rate_hz, seconds, stamps_path = float(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    info, made = frames(rate_hz, seconds)
    master, slave = os.openpty()
    tty.setraw(slave, termios.TCSANOW)
    print(os.ttyname(slave), flush=True)
    sys.stdin.readline()
    time.sleep(0.3)
    os.write(master, b"\0" + info)
    time.sleep(0.1)
    stamps = np.memmap(stamps_path, np.int64, "w+", shape=(len(made),))  # is there even if we are killed
    start = time.monotonic()
    sent = 0
    tick_s = max(0.002, ROWS / rate_hz)
    while sent < len(made):
        due = min(len(made), int((time.monotonic() - start) * rate_hz / ROWS))
        if due > sent:
            data = memoryview(b"".join(made[sent:due]))
            while data:
                data = data[os.write(master, data) :]
            stamps[sent:due] = time.monotonic_ns()
            sent = due
        time.sleep(tick_s)
    time.sleep(3600)


if __name__ == "__main__":
    main()
