"""Vector .blf: this reader unpacks the containers, python-can reads the objects in them.

python-can alone does not bound the size of an unpacked container. It takes an object of a wrong length for one that
continues in the next container. It skips containers of an unknown compression without a message, joins the halves of
two objects if a container between them is lost, and ends at the first damage. This reader bounds containers and
objects. Damage costs the container that it is in, and is reported.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any, BinaryIO

import can

LARGEST_HEAD = 1 << 16  # bytes; it has 144
LARGEST_CONTAINER = 16 << 20  # bytes, packed or not; loggers write 128 kB
LARGEST_OBJECT = 1 << 20  # bytes
LEAST_BODY_BYTES = {1: 16, 86: 16, 73: 32, 100: 84, 101: 40}  # bytes behind the headers of an object of CAN, by type
HEADER_BYTES = {1: 32, 2: 40}  # bytes, by version
CONTAINER_TYPE, UNCOMPRESSED_KIND, DEFLATED_KIND = 10, 0, 2  # of an object that holds others; its compression
READ_BYTES = 1 << 16  # a call
_OBJECT_STRUCT = struct.Struct("<4sHHII")  # signature, length of the header, its version, length of the whole, type
_CONTAINER_STRUCT = struct.Struct("<H6xI4x")  # how, and the size before


class BlfReader(can.BLFReader):  # type: ignore[misc]
    """python-can's reader, whose iteration can be restarted after an error and continues behind the damage."""

    goes_on = True
    _tail: bytes  # python-can's: of an object that goes on in the next container
    _lost = False  # containers before this one: it may begin within an object

    def __init__(self, file: BinaryIO) -> None:
        size = int.from_bytes(file.read(8)[4:], "little")
        if not 144 <= size <= LARGEST_HEAD:
            raise ValueError(f"a head of {size} bytes")
        file.seek(0)
        super().__init__(file)

    def __iter__(self) -> Iterator[Any]:
        while (data := self._next(self.file)) is not None:
            if self._lost:
                at = data.find(b"LOBJ")
                data = data[at:] if at >= 0 else b""
                self._lost = not data
            try:
                _check(bytes(self._tail) + data)
                yield from self._parse_container(data)
                if len(self._tail) > LARGEST_OBJECT:
                    raise ValueError("an object without end")
            except GeneratorExit:
                raise
            except Exception:
                self._forget()
                raise
        left, self._tail = bytes(self._tail).strip(b"\0"), b""
        if left:
            raise ValueError("the file ends inside an object")

    def _forget(self) -> None:
        self._tail, self._lost = b"", True

    def _next(self, file: BinaryIO) -> bytes | None:
        """Content of the next container; None at the end of the file. Raises ValueError once for each damage."""
        while True:
            at = file.tell()
            head = file.read(_OBJECT_STRUCT.size)
            if not head:
                return None
            try:
                kind, content = _object(head, file)
                if kind == CONTAINER_TYPE:
                    return _unpacked(content)
                if kind in LEAST_BODY_BYTES:  # in no container
                    return head + content
                if self._tail or content[:1] == b"\2" and content[_CONTAINER_STRUCT.size :][:1] == b"x":
                    raise ValueError(f"an object of type {kind} where a container should be")
            except (ValueError, struct.error, zlib.error):
                self._forget()
                _seek_container(file, at + 1)
                raise


def _object(head: bytes, file: BinaryIO) -> tuple[int, bytes]:
    signature, _, _, size, kind = _OBJECT_STRUCT.unpack(head)
    if signature != b"LOBJ" or not _OBJECT_STRUCT.size <= size <= LARGEST_CONTAINER:
        raise ValueError("no object where one should begin")
    content = file.read(size - _OBJECT_STRUCT.size)
    if len(content) < size - _OBJECT_STRUCT.size:
        raise ValueError("the file ends inside a container")
    file.read(size % 4)
    return kind, content


def _unpacked(content: bytes) -> bytes:
    how, _ = _CONTAINER_STRUCT.unpack_from(content)
    content = content[_CONTAINER_STRUCT.size :]
    if how == UNCOMPRESSED_KIND:
        return content
    if how != DEFLATED_KIND:
        raise ValueError(f"a container packed in an unknown way ({how})")
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(content, LARGEST_CONTAINER)
    if not unpacker.eof:
        raise ValueError("a container that is cut, or unpacks to more than it may")
    return data


def _seek_container(file: BinaryIO, at: int) -> None:
    """Go to the next container after `at`, or to the end."""
    while True:
        file.seek(at)
        piece = file.read(READ_BYTES)
        found = piece.find(b"LOBJ")
        if found < 0 and len(piece) < READ_BYTES:
            file.seek(0, 2)
            return
        if found < 0:
            at += READ_BYTES - 3
            continue
        file.seek(at + found)
        head = file.read(_OBJECT_STRUCT.size)
        if len(head) == _OBJECT_STRUCT.size:
            _, size, _, whole, kind = _OBJECT_STRUCT.unpack(head)
            outer = size == _OBJECT_STRUCT.size and kind == CONTAINER_TYPE
            if outer and whole >= _OBJECT_STRUCT.size + _CONTAINER_STRUCT.size:
                file.seek(at + found)
                return
        at += found + 1


def _check(data: bytes) -> None:
    """Raise ValueError unless each object is as long as its type needs, and no longer than one may be."""
    at = 0
    while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and at + _OBJECT_STRUCT.size <= len(data):
        _, _, version, size, kind = _OBJECT_STRUCT.unpack_from(data, at)
        least = HEADER_BYTES.get(version, 16) + LEAST_BODY_BYTES.get(kind, 0)
        if not least <= size <= LARGEST_OBJECT or kind == CONTAINER_TYPE:
            raise ValueError(f"an object of {size} bytes")
        at += size
