"""The index of a log's chunks, which is written at the log's end and until then must not fill the memory."""

from __future__ import annotations

from collections.abc import Iterator

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex

PACKED_BYTES = 128 << 10  # bytes that are packed together


class Packed:
    """Records of the index as the file will hold them; they write themselves, as one ChunkIndex does."""

    def __init__(self, records: bytes) -> None:
        self._data = bytes(memoryview(zstandard.compress(records, 9)))  # copied: zstandard's answer keeps spare room

    def write(self, stream: RecordBuilder) -> None:
        stream.write(zstandard.decompress(self._data))


class PackedIndex:
    """Stands in for the list of ChunkIndex of `mcap.writer.Writer`: 6 MB for a day of chunks instead of 150."""

    def __init__(self) -> None:
        self._packed: list[Packed] = []
        self._open = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        index.write(self._open)
        if self._open.count >= PACKED_BYTES:
            self._pack()

    def __iter__(self) -> Iterator[Packed]:
        self._pack()
        return iter(self._packed)

    def _pack(self) -> None:
        if self._open.count:
            self._packed.append(Packed(self._open.end()))
