"""The intact messages of an MCAP file that may be cut, flipped or hostile.

Only what a checksum vouches for is handed on: chunks whose CRC is right, attachments whose CRC is right. Nothing is
read by way of the index at the end, so a cut file gives what it holds. After damage the scan goes on at the next chunk.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.errors import LogError

# Opcodes of MCAP records
FOOTER_OPCODE, SCHEMA_OPCODE, CHANNEL_OPCODE, MESSAGE_OPCODE, CHUNK_OPCODE = 0x02, 0x03, 0x04, 0x05, 0x06
ATTACHMENT_OPCODE, STATISTICS_OPCODE = 0x09, 0x0B
RECORD_STRUCT = struct.Struct("<BQ")  # opcode, length
CHUNK_HEAD = struct.Struct("<QQQII4s")  # start, end, uncompressed size, CRC, length of the next: "zstd"
SIZE_STRUCT = struct.Struct("<Q")
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
ZSTD_SIGNATURE = b"\x04\x00\x00\x00zstd"
SIGNATURE_AT = RECORD_STRUCT.size + 28
MAX_CHUNK_BYTES = 64 << 20  # bytes of a chunk, before and after compression: no file makes us allocate more at once
READ_BYTES = 1 << 20  # a call


class Message(NamedTuple):
    channel: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(slots=True)
class Findings:
    """What a scan learns besides the messages. damage : one line each, for the user."""

    damage: list[str] = field(default_factory=list)
    attachments: dict[str, tuple[str, bytes]] = field(default_factory=dict)  # name -> media type, data
    topics: dict[int, str] = field(default_factory=dict)
    chunks: int = 0
    messages: int = 0
    size: int | None = None  # of the file at the first look: it may be growing
    closed: bool = False  # footer and index are there and agree with what was read

    @property
    def complete(self) -> bool:
        return self.closed and not self.damage


def scan(path: Path, findings: Findings) -> Iterator[list[Message]]:
    """The messages of each intact chunk, in the file's order. Raises LogError if the file cannot be read."""
    try:
        if path.is_fifo():  # to open it would wait for somebody who writes
            raise LogError(f"{path}: is a pipe; write the log to a file first")
        with path.open("rb", READ_BYTES) as file:
            findings.size = os.fstat(file.fileno()).st_size if findings.size is None else findings.size
            yield from _scan(file, findings.size, findings)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}; check the path") from error


def _scan(file: BinaryIO, size: int, findings: Findings) -> Iterator[list[Message]]:
    if file.read(len(LOG_MAGIC)) != LOG_MAGIC:
        findings.damage.append("the first 8 bytes are not those of an MCAP file")
    at, budget, unpacker = len(LOG_MAGIC), 4 * size + MAX_CHUNK_BYTES, zstandard.ZstdDecompressor()
    while at < size:
        file.seek(at)
        head = file.read(RECORD_STRUCT.size)
        op, length = RECORD_STRUCT.unpack(head) if len(head) == RECORD_STRUCT.size else (0, 0)
        end = at + RECORD_STRUCT.size + length
        if not 1 <= op <= 0x0F or end > size:
            problem = "ends inside a record" if end > size or len(head) < RECORD_STRUCT.size else "is not a record"
        elif op == CHUNK_OPCODE:
            chunk = (
                _chunk(file.read(length), unpacker) if length <= MAX_CHUNK_BYTES else "is a chunk too large to be ours"
            )
            if not isinstance(chunk, str):
                messages = list(_messages(chunk, findings))
                findings.chunks += 1
                findings.messages += len(messages)
                yield messages
                at = end
                continue
            problem = chunk
            budget -= min(length, MAX_CHUNK_BYTES)
        elif op == FOOTER_OPCODE:
            findings.closed = _closed(file, at, size, findings)
            return
        else:
            problem = _attachment(file.read(length), findings) if op == ATTACHMENT_OPCODE else ""
            if op != ATTACHMENT_OPCODE and _next_chunk(file, at + 1, end) is not None:
                problem = "has a record that swallows a chunk"  # its length has no checksum: never trust it that far
            if not problem:
                at = end
                continue
        findings.damage.append(f"at byte {at} of {size} the file {problem}")
        found = _next_chunk(file, at + 1, size)
        if found is None or budget < 0:
            return
        at = found


def _chunk(content: bytes, unpacker: zstandard.ZstdDecompressor) -> bytes | str:
    """The records of a chunk, or what is wrong with it."""
    if len(content) < CHUNK_HEAD.size + SIZE_STRUCT.size:
        return "has a chunk that is too short"
    *_, unpacked, crc, name_length, name = CHUNK_HEAD.unpack_from(content)
    (packed,) = SIZE_STRUCT.unpack_from(content, CHUNK_HEAD.size)
    data = memoryview(content)[CHUNK_HEAD.size + SIZE_STRUCT.size :]
    if name_length != 4 or name != b"zstd" or packed != len(data) or unpacked > MAX_CHUNK_BYTES:
        return "has a damaged chunk header"
    try:
        if zstandard.frame_content_size(data) != unpacked:
            return "has a damaged chunk"
        records = unpacker.decompress(data, unpacked)
    except zstandard.ZstdError:
        return "has a damaged chunk"
    return records if len(records) == unpacked and zlib.crc32(records) == crc else "has a damaged chunk"


def _messages(records: bytes, findings: Findings) -> Iterator[Message]:
    at, size = 0, len(records)
    while at + RECORD_STRUCT.size <= size:
        op, length = RECORD_STRUCT.unpack_from(records, at)
        at += RECORD_STRUCT.size
        if at + length > size:
            findings.damage.append("a chunk holds half a record")
            return
        if op == MESSAGE_OPCODE and length >= MESSAGE_HEAD.size:
            channel, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(records, at)
            yield Message(channel, log_time, publish_time, records[at + MESSAGE_HEAD.size : at + length])
        elif op == CHANNEL_OPCODE and length >= 8:
            number, _, name_length = struct.unpack_from("<HHI", records, at)
            findings.topics[number] = records[at + 8 : at + min(8 + name_length, length)].decode("utf-8", "replace")
        at += length


def _attachment(content: bytes, findings: Findings) -> str:
    """Keep an attachment; what is wrong with it, else ""."""
    wrong = "has a damaged attachment"
    if len(content) < 36 or zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
        return wrong
    at, texts = 16, []
    for _ in range(2):
        length = int.from_bytes(content[at : at + 4], "little")
        texts.append(content[at + 4 : at + 4 + length].decode("utf-8", "replace"))
        at += 4 + length
    if at + 12 > len(content) or int.from_bytes(content[at : at + 8], "little") != len(content) - at - 12:
        return wrong
    findings.attachments[texts[0]] = (texts[1], content[at + 8 : -4])
    return ""


def _closed(file: BinaryIO, footer_at: int, size: int, findings: Findings) -> bool:
    """Whether footer, magic and summary are whole and count the same chunks and messages as were found."""
    file.seek(footer_at)
    footer = file.read(size - footer_at) if size - footer_at == RECORD_STRUCT.size + 20 + len(LOG_MAGIC) else b""
    if not footer.endswith(LOG_MAGIC):
        findings.damage.append("the end of the file is damaged")
        return False
    start, _, crc = struct.unpack_from("<QQI", footer, RECORD_STRUCT.size)
    if start > footer_at:
        findings.damage.append("the index at the end is damaged")
        return False
    file.seek(start)
    statistics: tuple[int, ...] = ()
    summary = file.read(footer_at - start)
    if zlib.crc32(footer[: RECORD_STRUCT.size + 16], zlib.crc32(summary)) != crc:
        findings.damage.append("the index at the end is damaged")
        return False
    at = 0
    while at + RECORD_STRUCT.size <= len(summary):
        op, length = RECORD_STRUCT.unpack_from(summary, at)
        if op == STATISTICS_OPCODE and at + RECORD_STRUCT.size + 26 <= len(summary):
            statistics = struct.unpack_from("<QHIIII", summary, at + RECORD_STRUCT.size)
        at += RECORD_STRUCT.size + length
    if statistics and (statistics[0], statistics[5]) != (findings.messages, findings.chunks):
        findings.damage.append(
            f"{statistics[5]} chunks with {statistics[0]} messages were written, "
            f"{findings.chunks} with {findings.messages} are readable"
        )
    if statistics and statistics[3] != len(findings.attachments):
        findings.damage.append(f"{statistics[3]} attachments were written, {len(findings.attachments)} are readable")
    return True


def _next_chunk(file: BinaryIO, at: int, size: int) -> int | None:
    """Where the next chunk after `at` may begin."""
    seek, stop = at + SIGNATURE_AT, size + SIGNATURE_AT  # of a chunk that begins before `size`
    while seek < stop:
        file.seek(seek)
        piece = file.read(min(READ_BYTES, stop - seek) + len(ZSTD_SIGNATURE))
        found = piece.find(ZSTD_SIGNATURE)
        while found >= 0:
            start = seek + found - SIGNATURE_AT
            if start >= size:
                return None
            file.seek(start)
            head = file.read(RECORD_STRUCT.size + CHUNK_HEAD.size + SIZE_STRUCT.size)
            if (
                head[:1] == bytes([CHUNK_OPCODE])
                and len(head) == RECORD_STRUCT.size + CHUNK_HEAD.size + SIZE_STRUCT.size
            ):
                length, packed = (
                    SIZE_STRUCT.unpack_from(head, 1)[0],
                    SIZE_STRUCT.unpack_from(head, len(head) - SIZE_STRUCT.size)[0],
                )
                if length == CHUNK_HEAD.size + SIZE_STRUCT.size + packed:
                    return start
            found = piece.find(ZSTD_SIGNATURE, found + 1)
        seek += READ_BYTES
    return None
