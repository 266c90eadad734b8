"""Sound files: tracks in the order of the rig's channels, and what their heads say of scale and date."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from daq.base.contract.errors import LogError

from .columns import Columns, date_ns

MOST_CHUNKS = 10_000  # of a .wav
LONGEST_TEXT = 1 << 20  # bytes of a chunk of text that is read
DATE_AT, TIME_AT = 320, 330  # bytes, in a bext chunk (EBU Tech 3285)


def read_wav(path: Path, names: Sequence[str]) -> Columns:
    from scipy.io import wavfile

    texts, missing, unsaid = _texts(path)
    if unsaid:
        text = f"{unsaid} bytes follow where its head announces no samples: it was written through a pipe, or not ended"
        raise LogError(f"{path}: {text}; copy or export it again")
    if missing:
        text = f"{missing} bytes of the samples it announces are missing: it is cut, or was written through a pipe"
        raise LogError(f"{path}: {text}; copy or export it again")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # chunks that carry no samples
        rate, data = wavfile.read(path, mmap=False)
    if not data.size:
        raise LogError(f"{path}: holds no samples; check how it was written")
    data = data.reshape(len(data), -1)
    if data.shape[1] != len(names):
        text = f"{data.shape[1]} tracks, where the rig has {len(names)} channels ({', '.join(names)})"
        raise LogError(f"{path}: {text}; a .wav names none, so their number and order must be the rig's")
    about = _about(texts)
    started_ns = date_ns(str(about.get("started", ""))) or _recorded(texts)
    values = {n: data[:, i] for i, n in enumerate(names)}
    if data.dtype.kind != "f":
        if data.dtype == np.uint8:
            raise LogError(f"{path}: 8-bit sound; 16, 24 or 32 bits, or floats, are needed")
        counts = 2 ** (8 * data.dtype.itemsize - 1)
        return Columns(values, float(rate), full_scale_counts=counts, started_ns=started_ns)
    units = about.get("units")
    if isinstance(units, list) and len(units) == len(names):  # one of our own exports
        return Columns(values, float(rate), None, dict(zip(names, map(str, units), strict=True)), started_ns=started_ns)
    largest = float(np.nanmax(np.abs(data)))
    if largest <= 1.0:
        return Columns(values, float(rate), full_scale_counts=1, started_ns=started_ns)
    odd = f"its samples are floats up to {largest:.3g}: taken as values in the rig's units, not as parts of full scale"
    return Columns(values, float(rate), odd=odd, started_ns=started_ns)


def _about(texts: dict[bytes, bytes]) -> dict[str, Any]:
    """The remark of `rotorscope export` on values and date."""
    try:
        value = json.loads(texts.get(b"ICMT", b"").rstrip(b"\0"))
    except ValueError:
        return {}
    about = value.get("rotorscope") if isinstance(value, dict) else None
    return about if isinstance(about, dict) else {}


def _recorded(texts: dict[bytes, bytes]) -> int | None:
    """The date of a Broadcast Wave file, Unix time in ns."""
    head = texts.get(b"bext", b"")
    day, time = (head[at : at + length].decode("ascii", "replace") for at, length in ((DATE_AT, 10), (TIME_AT, 8)))
    return date_ns(f"{day.replace(':', '-').replace('_', '-')} {time.replace('-', ':')}")


def _texts(path: Path) -> tuple[dict[bytes, bytes], int, int]:
    """Chunks of text by name, the bytes of samples that the file announces and does not hold, and those it holds and
    does not announce.

    The library takes what there is, and is silent.
    """
    size, texts, missing, unsaid = path.stat().st_size, dict[bytes, bytes](), 0, 0
    with path.open("rb") as file:
        order: Literal["little", "big"] = "big" if file.read(12)[:4] == b"RIFX" else "little"
        for name, length, at in _chunks(file, order):
            if name == b"data":
                missing, unsaid = max(at + length - size, 0), 0 if length else size - at
            elif name in (b"bext", b"LIST"):
                file.seek(at)
                content = file.read(min(length, LONGEST_TEXT))
                texts |= {name: content} if name == b"bext" else _listed(content, order)
    return texts, missing, unsaid


def _chunks(file: BinaryIO, order: Literal["little", "big"]) -> Iterator[tuple[bytes, int, int]]:
    """Name, length and place of each chunk; of a file above 4 GB the length of its samples as it says elsewhere."""
    long: int | None = None
    at = 12
    for _ in range(MOST_CHUNKS):
        file.seek(at)
        head = file.read(8)
        if len(head) < 8:
            return
        name, length = head[:4], int.from_bytes(head[4:], order)
        if name == b"ds64":
            long = int.from_bytes(file.read(16)[8:], "little")
        elif name == b"data" and long is not None:
            length = long
        yield name, length, at + 8
        at += 8 + length + length % 2


def _listed(content: bytes, order: Literal["little", "big"]) -> dict[bytes, bytes]:
    """The texts of a LIST chunk of kind INFO."""
    out, at = dict[bytes, bytes](), 4
    while content[:4] == b"INFO" and at + 8 <= len(content):
        length = int.from_bytes(content[at + 4 : at + 8], order)
        out[content[at : at + 4]] = content[at + 8 : at + 8 + length]
        at += 8 + length + length % 2
    return out
