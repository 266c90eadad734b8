"""The intact messages of an MCAP file that may be cut, flipped or hostile.

The scan returns chunks and attachments only if their CRC is right. It does not use the index at the end, so a cut file
gives the messages that it holds. After damage the scan goes on at the next chunk.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.errors import LogError

# Opcodes of MCAP records
FOOTER_OPCODE, SCHEMA_OPCODE, CHANNEL_OPCODE, MESSAGE_OPCODE, CHUNK_OPCODE = 0x02, 0x03, 0x04, 0x05, 0x06
ATTACHMENT_OPCODE, STATISTICS_OPCODE, DATA_END_OPCODE = 0x09, 0x0B, 0x0F
RECORD_STRUCT = struct.Struct("<BQ")  # opcode, length
CHUNK_HEAD = struct.Struct("<QQQII4s")  # start, end, uncompressed size, CRC, length of the next: "zstd"
SIZE_STRUCT = struct.Struct("<Q")
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
ZSTD_SIGNATURE = b"\x04\x00\x00\x00zstd"
SIGNATURE_AT = RECORD_STRUCT.size + 28
HEADS_BYTES = RECORD_STRUCT.size + CHUNK_HEAD.size + SIZE_STRUCT.size  # of a chunk, before its packed content
FOOTER_BYTES = RECORD_STRUCT.size + 20 + len(LOG_MAGIC)  # with the magic at the end
TOO_MUCH = "holds more than a log of its size can: it was not made by Rotorscope"
MAX_CHUNK_BYTES = 64 << 20  # bytes of a chunk, before and after compression: the largest allocation at once
READ_BYTES = 1 << 20  # a call
PROBE_BYTES = 1 << 16  # a call that looks for a place in the file


class Message(NamedTuple):
    channel: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(slots=True, kw_only=True)
class Findings:
    """Results of a scan besides the messages. damage : one line each, for the user."""

    damage: list[str] = field(default_factory=list)
    attachments: dict[str, tuple[str, bytes]] = field(default_factory=dict)  # name -> media type, data
    topics: dict[int, str] = field(default_factory=dict)
    chunks: int = 0
    messages: int = 0
    size: int | None = None  # of the file at the first look: it may be growing
    closed: bool = False  # footer and index are there and agree with what was read
    partial: bool = False  # only a part of the file was read: what lies outside is not known to be intact

    @property
    def complete(self) -> bool:
        return self.closed and not self.damage


def scan(path: Path, findings: Findings, at: int = 0) -> Iterator[list[Message]]:
    """The messages of each intact chunk, in the file's order. Raises LogError if the file cannot be read.

    at : where to begin: 0, or where a chunk begins.
    """
    try:
        with opened(path, PROBE_BYTES if findings.partial else READ_BYTES) as file:
            first = findings.size is None
            findings.size = os.fstat(file.fileno()).st_size if findings.size is None else findings.size
            checksum = _Checksum(zlib.crc32(LOG_MAGIC) if first else None)
            yield from _scan(file, findings.size, findings, checksum, at)
    except IsADirectoryError as error:
        raise LogError(f"{path}: is a folder; give a log in it") from error
    except PermissionError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; ask its owner to let you read it") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}; check the path") from error


@contextmanager
def opened(path: Path, buffer_bytes: int = PROBE_BYTES) -> Iterator[BinaryIO]:
    """The file of a log. Raises LogError if it is a pipe: to open it would wait for somebody who writes."""
    if path.is_fifo():
        raise LogError(f"{path}: is a pipe; write the log to a file first")
    with path.open("rb", buffer_bytes) as file:
        yield file


def ends_closed(path: Path, findings: Findings) -> bool:
    """Whether a file ends as a closed log does. Only its end is read."""
    with opened(path) as file:
        file.seek(max(0, (findings.size or 0) - FOOTER_BYTES))
        end = file.read(FOOTER_BYTES)
    return len(end) == FOOTER_BYTES and end[0] == FOOTER_OPCODE and end.endswith(LOG_MAGIC)


@dataclass(slots=True)
class _Limits:
    """Limits on messages and unpacked bytes of a file of this size.

    A Rotorscope log has at least 16 bytes of index for each message, and its chunks expand 500 times at most.
    """

    unpacked_bytes: int
    records: int
    damaged_bytes: int

    @classmethod
    def of(cls, size: int) -> _Limits:
        return cls(1000 * size + MAX_CHUNK_BYTES, size // 8 + 100_000, 4 * size + MAX_CHUNK_BYTES)

    @property
    def spent(self) -> bool:
        return min(self.unpacked_bytes, self.records, self.damaged_bytes) < 0


@dataclass(slots=True)
class _Checksum:
    """Checksum of the file up to the end of its data, with indexes and names that no other checksum covers.

    value : None in another pass over a file that was verified. compared : the end of the data was found.
    """

    value: int | None
    compared: bool = False

    def add(self, data: bytes) -> None:
        if self.value is not None:
            self.value = zlib.crc32(data, self.value)

    def compare(self, said: int, findings: Findings) -> None:
        self.compared = True
        if self.value is not None and said not in (0, self.value) and not findings.damage:  # 0: it was never written
            findings.damage.append("a byte is changed that is part of no sample: in an index, or a name")


class _Record(NamedTuple):
    """Head of a record: its bytes, opcode, size of the content, and end. packed : size of the chunk it looks like."""

    head: bytes
    op: int
    length: int
    end: int
    packed: int | None


def _scan(
    file: BinaryIO, size: int, findings: Findings, checksum: _Checksum, at: int
) -> Iterator[list[Message]]:  # fmt: skip
    if at == 0 and file.read(len(LOG_MAGIC)) != LOG_MAGIC:
        findings.damage.append("the first 8 bytes are not those of an MCAP file")
    at, limits, unpacker = max(at, len(LOG_MAGIC)), _Limits.of(size), zstandard.ZstdDecompressor()
    file.seek(at)
    while at < size:
        record, problem = _record(file, at, size), ""
        if record.packed is not None:  # a chunk, even if a flipped bit changed its kind or length
            content = record.head[RECORD_STRUCT.size :] + file.read(record.packed)
            chunk = _chunk(content, unpacker, limits)
            if not isinstance(chunk, str):
                if record.op != CHUNK_OPCODE or record.length != len(content):
                    findings.damage.append(f"at byte {at} of {size} the head of a chunk is damaged, its content is not")
                messages = list(_messages(chunk, findings, limits))
                findings.chunks += 1
                findings.messages += len(messages)
                yield messages
                checksum.add(record.head[: RECORD_STRUCT.size])
                checksum.add(content)
                at += RECORD_STRUCT.size + len(content)
                if limits.spent:
                    findings.damage.append(f"{TOO_MUCH}; the rest is left out")
                    return
                continue
            problem = chunk if record.op == CHUNK_OPCODE or record.length == len(content) else ""
            limits.damaged_bytes -= record.packed
        if not problem:
            problem = _other(file, at, size, record, checksum, findings)
        if not problem:
            if record.op == FOOTER_OPCODE:
                return
            at = record.end
            continue
        findings.damage.append(f"at byte {at} of {size} the file {problem}")
        found = next_chunk(file, at + 1, size)
        if found is None or limits.spent:
            return
        at = found


def _record(file: BinaryIO, at: int, size: int) -> _Record:
    """The head of the record at `at`; opcode 0 if there is no whole one."""
    head = _at(file, at, HEADS_BYTES)
    if len(head) < RECORD_STRUCT.size:
        return _Record(head, 0, 0, size + 1, packed=None)
    op, length = RECORD_STRUCT.unpack_from(head)
    packed = None
    if len(head) == HEADS_BYTES and head[SIGNATURE_AT : SIGNATURE_AT + len(ZSTD_SIGNATURE)] == ZSTD_SIGNATURE:
        (said,) = SIZE_STRUCT.unpack_from(head, HEADS_BYTES - SIZE_STRUCT.size)
        alike = op == CHUNK_OPCODE or length == HEADS_BYTES - RECORD_STRUCT.size + said
        packed = said if alike and said <= min(MAX_CHUNK_BYTES, size - at - HEADS_BYTES) else None
    return _Record(head, op, length, at + RECORD_STRUCT.size + length, packed=packed)


def _other(
    file: BinaryIO, at: int, size: int, record: _Record, checksum: _Checksum, findings: Findings
) -> str:  # fmt: skip
    """The fault of a record that is no chunk, else ""."""
    if record.end > size:
        return "ends inside a record"
    if not 1 <= record.op <= DATA_END_OPCODE:
        return "is not a record"
    if record.op == CHUNK_OPCODE:
        return "has a damaged chunk header"
    if record.op == FOOTER_OPCODE:
        if size - at != FOOTER_BYTES:
            return "has an end that is not at its end"
        if not checksum.compared:
            findings.damage.append("the end of the data is damaged")
        findings.closed = _closed(file, at, size, findings)
        return ""
    if record.op == ATTACHMENT_OPCODE:
        content = _at(file, at, record.end - at)
        checksum.add(content)
        return _attachment(content[RECORD_STRUCT.size :], findings)
    ahead = _at(file, at, min(record.end - at, READ_BYTES) + SIGNATURE_AT + len(ZSTD_SIGNATURE))
    long = record.length > READ_BYTES
    if (long or ZSTD_SIGNATURE in ahead) and next_chunk(file, at + 1, size, record.end) is not None:
        return "has a record that swallows a chunk"  # the length has no checksum, so it is not trusted that far
    if record.op == DATA_END_OPCODE and record.length == 4:
        checksum.compare(int.from_bytes(ahead[RECORD_STRUCT.size : RECORD_STRUCT.size + 4], "little"), findings)
    elif not long:
        checksum.add(ahead[: record.end - at])
    elif checksum.value is not None:
        for start in range(at, record.end, READ_BYTES):
            checksum.add(_at(file, start, min(READ_BYTES, record.end - start)))
    return ""


def _at(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)


def _chunk(content: bytes, unpacker: zstandard.ZstdDecompressor, limits: _Limits) -> bytes | str:
    """The records of a chunk, or what is wrong with it."""
    *_, unpacked, crc, _, _ = CHUNK_HEAD.unpack_from(content)
    data = memoryview(content)[CHUNK_HEAD.size + SIZE_STRUCT.size :]
    if unpacked > MAX_CHUNK_BYTES:
        return "has a damaged chunk header, or a chunk too large to be ours"
    limits.unpacked_bytes -= unpacked
    if limits.spent:
        return TOO_MUCH
    try:
        if zstandard.frame_content_size(data) != unpacked:
            return "has a damaged chunk"
        records = unpacker.decompress(data, unpacked, allow_extra_data=False)  # of a false length: the next chunks
    except zstandard.ZstdError:
        return "has a damaged chunk"
    return records if len(records) == unpacked and zlib.crc32(records) == crc else "has a damaged chunk"


def _messages(records: bytes, findings: Findings, limits: _Limits) -> Iterator[Message]:
    at, size, allowed = 0, len(records), limits.records
    while at + RECORD_STRUCT.size <= size:
        op, length = RECORD_STRUCT.unpack_from(records, at)
        at += RECORD_STRUCT.size
        if at + length > size:
            findings.damage.append("a chunk holds half a record")
            break
        if op == MESSAGE_OPCODE and length >= MESSAGE_HEAD.size:
            channel, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(records, at)
            yield Message(channel, log_time, publish_time, records[at + MESSAGE_HEAD.size : at + length])
        elif op == CHANNEL_OPCODE and length >= 8:
            number, _, name_length = struct.unpack_from("<HHI", records, at)
            findings.topics[number] = records[at + 8 : at + min(8 + name_length, length)].decode("utf-8", "replace")
        elif op not in (SCHEMA_OPCODE, CHANNEL_OPCODE, MESSAGE_OPCODE):
            findings.damage.append("a chunk holds what belongs into none")
            break
        at += length
        allowed -= 1
        if allowed < 0:
            break
    limits.records = allowed


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
    """Whether footer, magic and summary are complete and count the chunks and messages that were found."""
    file.seek(footer_at)
    footer = file.read(size - footer_at)
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
    if findings.partial:
        return True
    if statistics and (statistics[0], statistics[5]) != (findings.messages, findings.chunks):
        findings.damage.append(
            f"{statistics[5]} chunks with {statistics[0]} messages were written, "
            f"{findings.chunks} with {findings.messages} are readable"
        )
    if statistics and statistics[3] != len(findings.attachments):
        findings.damage.append(f"{statistics[3]} attachments were written, {len(findings.attachments)} are readable")
    return True


def next_chunk(
    file: BinaryIO, at: int, size: int, before: int | None = None, piece_bytes: int = READ_BYTES
) -> int | None:  # fmt: skip
    """Where the next chunk from `at` on, and before `before`, may begin."""
    before = size if before is None else before
    seek, stop = at + SIGNATURE_AT, before + SIGNATURE_AT
    while seek < stop:
        file.seek(seek)
        piece = file.read(min(piece_bytes, stop - seek) + len(ZSTD_SIGNATURE))
        found = piece.find(ZSTD_SIGNATURE)
        while found >= 0:
            start = seek + found - SIGNATURE_AT
            if start >= before:
                return None
            if _record(file, start, size).packed is not None:
                return start
            found = piece.find(ZSTD_SIGNATURE, found + 1)
        seek += piece_bytes
    return None
