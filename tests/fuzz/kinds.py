"""How the inputs of a mass run are made: which good pieces, damaged how, how many in one stream."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from damage import (
    damaged,
    damaged_answer,
    damaged_answer_member,
    damaged_blocks,
    damaged_evenly,
    damaged_npy,
    damaged_table,
    damaged_text,
    damaged_variable,
    damaged_zip,
)
from seeds import (
    BLF_HEAD,
    LOG_HEAD,
    PART_HEAD,
    RIG_HEAD,
    blf_containers,
    log_ends,
    rig_tables,
    seeds,
    small_logs,
    small_rigs,
    tiny_logs,
)


@dataclass(frozen=True, slots=True)
class Kind:
    """How a target's inputs are made. split : a good file -> its inputs; pack : an input -> its part of the stream;
    many : inputs in one stream.

    whole : share of those that are not damaged, for what a stream carries on behind a damaged one; 0 where each is read
    by itself. once : each good piece once in a stream. head : what comes before them; tails : one of these, or a
    damaged copy of it, behind them; first, last : which of the good files; good : these instead of seeds.py's; damage :
    how one is damaged.
    """

    what: str
    many: int = 1
    split: Callable[[bytes], list[bytes]] = lambda data: [data]
    pack: Callable[[bytes], bytes] = lambda piece: piece
    head: tuple[bytes, ...] = (b"",)
    target: str = ""
    whole: float = 0.3
    once: bool = False
    first: int = 0
    last: int | None = None
    good: Callable[[], list[bytes]] | None = None
    tails: Callable[[], list[bytes]] | None = None
    damage: Callable[[bytes, random.Random], bytes] = damaged

    def pools(self, name: str) -> list[tuple[bytes, list[bytes]]]:
        """(head, good pieces): one for each head, if a head belongs to each good file."""
        good = self.good() if self.good else seeds(name)[self.first : self.last]
        heads = self.head if len(self.head) == len(good) else self.head * len(good)
        files = [self.split(data.removeprefix(head)) for head, data in zip(heads, good, strict=True)]
        if len(self.head) == len(files):
            return list(zip(self.head, files, strict=True))
        return [(self.head[0], [piece for pieces in files for piece in pieces])]


def _after(end: bytes) -> Callable[[bytes], list[bytes]]:
    return lambda data: [piece + end for piece in data.split(end) if piece]


def _sized(at: int) -> Callable[[bytes], list[bytes]]:
    """Pieces of two bytes and a body; byte `at` is the body's length and is left out here."""

    def split(data: bytes) -> list[bytes]:
        out = []
        while len(data) > 2:
            stop = 2 + data[at]
            out.append(data[1 - at : 2 - at] + data[2:stop])
            data = data[stop:]
        return out

    return split


def _with_size(at: int) -> Callable[[bytes], bytes]:
    def pack(piece: bytes) -> bytes:
        size = bytes((min(max(len(piece) - 1, 0), 255),))
        one = piece[:1] or b"\0"
        return (size + one if at == 0 else one + size) + piece[1:256]

    return pack


def _frames(data: bytes) -> list[bytes]:
    """Of the target "can": a head whose top bits tell the length."""
    out = []
    while data:
        stop = 1 + (64 if data[0] >> 5 else 8)
        out.append(bytes((data[0] | 16,)) + data[1:stop])
        data = data[stop:]
    return out


def _frame(piece: bytes) -> bytes:
    head = piece[0] if piece else 0
    length = (8, 64, 12, 64, 8, 64, 0, 64)[head >> 5]
    if head >> 5 == 6:  # of any length; the first byte tells
        body = piece[1:65] or b"\0"
        return bytes((head, len(body))) + body[1:]
    return bytes((head,)) + piece[1 : 1 + length].ljust(length, b"\0")


def _tens(data: bytes) -> list[bytes]:
    return [data[k : k + 10] for k in range(0, len(data), 10)]


def _ten(piece: bytes) -> bytes:
    return piece[:10].ljust(10, b"\0")


def _padded(piece: bytes) -> bytes:
    """And what lies between two of them."""
    return piece + bytes(int.from_bytes(piece[8:12], "little") % 4)


def _records(data: bytes) -> list[bytes]:
    """Of an MCAP file: an operation, eight bytes of length, the content."""
    out = []
    while len(data) >= 9:
        stop = 9 + int.from_bytes(data[1:9], "little")
        out.append(data[:stop])
        data = data[stop:]
    return out


def _behind_length(data: bytes) -> list[bytes]:
    out = []
    while len(data) > 2:
        stop = 2 + int.from_bytes(data[:2], "little")
        out.append(data[2:stop])
        data = data[stop:]
    return out


def _with_length(piece: bytes) -> bytes:
    return len(piece).to_bytes(2, "little") + piece


def _sets(data: bytes) -> list[bytes]:
    """What lies between two lines of -1; a damaged one of them would cost all sets behind it."""
    return [part for part in data.split(b"    -1\n") if part]


def _set(piece: bytes) -> bytes:
    return b"    -1\n" + piece + b"\n    -1\n"


KINDS = {
    "cobs": Kind("frames", 500, _after(b"\0")),
    "slcan": Kind("lines", 500, _after(b"\r")),
    "serial": Kind("frames", 250, _sized(0), _with_size(0)),
    "can": Kind("frames", 250, _frames, _frame, head=(b"\0", b"\1", b"\2")),
    "messages": Kind("messages of a log", 250, _sized(1), _with_size(1), head=(b"\2",), target="mcap", first=1),
    "expression": Kind("texts"),
    "mapped": Kind("frames", 300, _tens, _ten),
    "candump": Kind("lines", 250, _after(b"\n")),
    "records": Kind(
        "records of a log", 100, _records, head=(LOG_HEAD,), target="mcap", good=small_logs, tails=log_ends
    ),  # fmt: skip
    "recover": Kind(
        "records of a log that is recovered", 100, _records, head=(LOG_HEAD,), good=small_logs, tails=log_ends
    ),
    "recover-messages": Kind(
        "messages of a log that is recovered", 100, _sized(1), _with_size(1), head=(b"\2",), target="recover", first=1
    ),
    "rig": Kind("files", good=small_rigs, damage=damaged_text),
    "rig-tables": Kind(
        "tables",
        len(rig_tables()),
        head=(RIG_HEAD,),
        target="rig",
        good=rig_tables,
        once=True,
        damage=damaged_table,
        pack=lambda piece: piece + b"\n",
    ),
    "csv": Kind("files", damage=damaged_evenly),
    "lvm": Kind("files", damage=damaged_evenly),
    "parts": Kind(
        "records of a log of which a part is read",
        100,
        _records,
        head=(PART_HEAD + LOG_HEAD,),
        good=lambda: [PART_HEAD + log for log in small_logs()],
        tails=log_ends,
    ),  # fmt: skip
    "npz": Kind("files", damage=damaged_zip),
    "npz-members": Kind("members of an archive", 25, _behind_length, _with_length, whole=0.0, damage=damaged_npy),
    "answer-members": Kind(
        "members of answers of the process that reads .mat and .mf4",
        25,
        _behind_length,
        _with_length,
        whole=0.0,
        damage=damaged_answer_member,
    ),
    "uff-sets": Kind("data sets", 30, _sets, _set, whole=0.0),
    "wav": Kind("files"),
    "uff": Kind("files", damage=damaged_evenly),
    "asc": Kind("lines", 100, _after(b"\n"), damage=damaged_evenly),
    "blf": Kind("containers", 100, pack=_padded, head=(BLF_HEAD,), good=blf_containers),
    "answer": Kind("answers of the process that reads .mat and .mf4", damage=damaged_answer),
    "mat-parse": Kind("files, parsed by scipy in a process that lives on"),
    "mf4-parse": Kind("files, parsed by asammdf in a process that lives on"),
    "mat-variables": Kind(
        "variables of a .mat, parsed by scipy in a process that lives on",
        25,
        _behind_length,
        _with_length,
        whole=0.0,
        damage=damaged_variable,
    ),
    "mf4-files": Kind(
        "files of a channel, parsed by asammdf in a process that lives on",
        25,
        _behind_length,
        _with_length,
        whole=0.0,
        damage=damaged_blocks,
    ),
    "mcap": Kind("files", good=tiny_logs),
}
