"""The index of a long log: small in memory until the end, and in the file what the library would have written."""

from __future__ import annotations

import io
import tracemalloc

import numpy as np
from sessions import make_block, make_estimate, make_session, make_status

from daq.log.encoder import LogEncoder


def chunks(encoder: LogEncoder, start: int, stop: int) -> None:
    """As a live log ends one each 0.4 s."""
    rng = np.random.default_rng(start)
    for k in range(start, stop):
        encoder.reading(make_block(12 * k, 12, t0_ns=10**12 + int(rng.integers(10**6))))
        encoder.estimate(make_estimate(k))
        if k % 5 < 2:
            encoder.status(make_status(k))
        encoder.flush()


def test_the_file_is_the_same() -> None:
    files = []
    for packed in (True, False):
        file = io.BytesIO()
        encoder = LogEncoder(file)
        if not packed:
            encoder._mcap._Writer__chunk_indices = []  # type: ignore[attr-defined]
        encoder.start(make_session(), 10**18)
        chunks(encoder, 0, 1000)
        encoder.finish()
        files.append(file.getvalue())
    assert files[0] == files[1]


class Counted:
    """An output that keeps nothing."""

    def __init__(self) -> None:
        self.size = 0

    def write(self, data: bytes, /) -> int:
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None: ...


def test_many_chunks_take_little_memory() -> None:
    """7 minutes of them; the library's list takes 0.7 MB for these."""
    encoder = LogEncoder(Counted())
    encoder.start(make_session(), 10**18)
    chunks(encoder, 0, 400)
    tracemalloc.start()
    try:
        chunks(encoder, 400, 1400)
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert grown < 0.15e6
