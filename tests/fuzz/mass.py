"""Millions of inputs of each target, without coverage feedback:  python tests/fuzz/mass.py TALLY.json [TARGET ...]

run.py (atheris) finds new paths but is slow in Python; this goes far along known ones. An input is a damaged copy of a
good frame, line, message or file; where a decoder reads a stream, many make one stream, so that an input costs what a
frame costs. The tally is kept every few seconds, and a run goes on from it; --report writes it for
docs/make_reliability.py. What breaks a promise is made smaller and written to tests/fuzz/cases/.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1])]

from guard import guarded  # noqa: E402
from seeds import seeds  # noqa: E402
from targets import TARGETS  # noqa: E402

HANG_S = 20
SAVE_S = 5.0
ODD = (
    b"\0",
    b"\xff",
    b"\x7f",
    b"\x80",
    b"\r",
    b"\n",
    b",",
    b"0",
    b"-",
    b"\xff\xff\xff\xff",
    b"\0\0\0\x80",
    b"nan",
    b"9e9",
)


@dataclass(frozen=True, slots=True)
class Kind:
    """How a target's inputs are made. split : a good file -> its inputs; pack : an input -> its part of the stream;
    many : inputs in one stream.

    head : what comes before them; first, last : which of the good files.
    """

    what: str
    many: int = 1
    split: Callable[[bytes], list[bytes]] = lambda data: [data]
    pack: Callable[[bytes], bytes] = lambda piece: piece
    head: tuple[bytes, ...] = (b"",)
    target: str = ""
    first: int = 0
    last: int | None = None

    def pools(self, name: str) -> list[tuple[bytes, list[bytes]]]:
        """(head, good pieces): one for each head, if a head belongs to each good file."""
        good = seeds(name)[self.first : self.last]
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


KINDS = {
    "cobs": Kind("frames", 500, _after(b"\0")),
    "slcan": Kind("lines", 500, _after(b"\r")),
    "serial": Kind("frames", 250, _sized(0), _with_size(0)),
    "can": Kind("frames", 250, _frames, _frame, head=(b"\0", b"\1", b"\2")),
    "messages": Kind("messages of a log", 250, _sized(1), _with_size(1), head=(b"\2",), target="mcap", first=1),
    "expression": Kind("texts"),
    "mapped": Kind("frames", 300, _tens, _ten),
    "candump": Kind("lines", 250, _after(b"\n")),
    "rig": Kind("files"),
    "csv": Kind("files"),
    "wav": Kind("files"),
    "uff": Kind("files"),
    "npz": Kind("files"),
    "mcap": Kind("files", last=1),
    "asc": Kind("files"),
    "blf": Kind("files"),
}


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four pieces overwritten, cut out, doubled or flipped."""
    out = bytearray(data)
    for _ in range(1 + int(rng.random() * rng.random() * 4)):
        at, how = int(rng.random() ** 2 * (len(out) + 1)), int(rng.random() * 8)  # heads more often
        if how < 3 and at < len(out):
            out[at] = int(rng.random() * 256)
        elif how == 3 and at < len(out):
            out[at] ^= 1 << int(rng.random() * 8)
        elif how == 4:
            del out[at : at + 1 + int(rng.random() * rng.random() * 16)]
        elif how == 5:
            out[at:at] = out[at : at + 1 + int(rng.random() * 16)]
        elif how == 6:
            odd = ODD[int(rng.random() * len(ODD))]
            out[at : at + len(odd)] = odd
        else:
            out[at:at] = ODD[int(rng.random() * len(ODD))]
    return bytes(out)


def _batch(good: list[bytes], many: int, rng: random.Random) -> list[bytes]:
    """Inputs of one stream: of any order, or one after the other; some of them whole."""
    if many == 1:
        return [damaged(rng.choice(good), rng)]
    if rng.random() < 0.5:
        pieces = rng.choices(good, k=many)
    else:
        start = int(rng.random() * len(good))
        pieces = [good[(start + k) % len(good)] for k in range(many)]
    return [piece if rng.random() < 0.3 else damaged(piece, rng) for piece in pieces]


class _Hang(BaseException):
    pass


def _alarm(*_: object) -> None:
    raise _Hang(f"no answer within {HANG_S} s")


def fuzz(name: str, tally: dict[str, dict[str, float]], wanted: int, save: Callable[[], None]) -> str:
    """Go on to the wanted number; what broke, or ""."""
    kind, mine = KINDS[name], tally.setdefault(name, {"inputs": 0, "cpu_s": 0.0, "peak_mb": 0.0})
    target = TARGETS[kind.target or name]
    pools = kind.pools(kind.target or name)
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None
    rng = random.Random(f"{name} {mine['inputs']:.0f}")
    with tempfile.TemporaryDirectory(dir=base) as scratch:
        folder = Path(scratch)
        for head, good in pools:
            target(head + b"".join(map(kind.pack, good)), folder)  # imports and compiles
        saved, cpu = time.monotonic(), time.process_time()
        while mine["inputs"] < wanted:
            head, good = rng.choice(pools)
            batch = [kind.pack(piece) for piece in _batch(good, kind.many, rng)]
            problem = _tried(target, head, batch, folder)
            if problem:
                case = head + b"".join(_smaller(target, head, batch, folder))
                path = HERE / "cases" / f"{kind.target or name}-mass-{zlib.crc32(case):08x}"
                path.write_bytes(case)
                return f"{path.name}: {problem}"
            mine["inputs"] += kind.many
            if time.monotonic() - saved > SAVE_S or mine["inputs"] >= wanted:
                mine["cpu_s"] += time.process_time() - cpu
                mine["peak_mb"] = max(mine["peak_mb"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
                saved, cpu = time.monotonic(), time.process_time()
                save()
    return ""


def _tried(target: Callable[[bytes, Path], None], head: bytes, batch: list[bytes], folder: Path) -> str:
    signal.alarm(HANG_S)
    try:
        with guarded(folder):
            target(head + b"".join(batch), folder)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a Forbidden or a hang, too
        return repr(error)
    finally:
        signal.alarm(0)
    return ""


def _smaller(target: Callable[[bytes, Path], None], head: bytes, batch: list[bytes], folder: Path) -> list[bytes]:
    """The batch without what it does not need to fail."""
    step = len(batch) // 2
    while step:
        at = 0
        while at < len(batch):
            less = batch[:at] + batch[at + step :]
            if _tried(target, head, less, folder):
                batch = less
            else:
                at += step
        step //= 2
    return batch


def report(tally: dict[str, dict[str, float]], path: Path) -> None:
    suite = ElementTree.Element("testsuite")
    for name, mine in tally.items():
        kind = KINDS[name]
        case = ElementTree.SubElement(suite, "testcase", classname="mass", name=name)
        how = f"damaged {kind.what}" + (f", {kind.many} in a stream, 3 of 10 whole" if kind.many > 1 else "")
        promised = "read or refused, memory bounded, no hang, no write elsewhere, nothing executed"
        value = f"{mine['inputs']:.0f} inputs, at most {mine['peak_mb']:.0f} MB"
        row = f"hostile input: {name} | {how} | {promised} | {value}"
        ElementTree.SubElement(ElementTree.SubElement(case, "properties"), "property", name="reliability", value=row)
    ElementTree.ElementTree(suite).write(path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tally", type=Path)
    parser.add_argument("targets", nargs="*", choices=[[], *KINDS], metavar="TARGET")
    parser.add_argument("--inputs", type=int, default=10_000_000)
    parser.add_argument("--report", type=Path)
    options = parser.parse_args()
    tally = json.loads(options.tally.read_text()) if options.tally.exists() else {}
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _alarm)
    failed = 0
    for name in options.targets or ([] if options.report else KINDS):
        problem = fuzz(name, tally, options.inputs, lambda: _keep(options.tally, tally))
        print(name, f"{tally[name]['inputs']:.0f}", f"{tally[name]['cpu_s']:.0f} s", problem, flush=True)
        failed += bool(problem)
    if options.report:
        report(tally, options.report)
    return min(failed, 1)


def _keep(path: Path, tally: dict[str, dict[str, float]]) -> None:
    new = path.with_suffix(".new")
    new.write_text(json.dumps(tally, indent=1))
    new.replace(path)


if __name__ == "__main__":
    sys.exit(main())
