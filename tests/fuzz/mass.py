"""Millions of inputs of each target, without coverage feedback:  python tests/fuzz/mass.py TALLY.json [TARGET ...]

run.py (atheris) finds new paths but is slow in Python; this goes far along known ones. An input is a damaged copy of a
good frame, line, message or file; where a decoder reads a stream, many make one stream, so that an input costs what a
frame costs. The tally is kept every few seconds, and a run goes on from it; where there is none, it begins with what
docs/reliability.md says. --report writes it for docs/make_reliability.py. What breaks a promise is made smaller and
written to tests/fuzz/cases/.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1])]

from again import remembering  # noqa: E402
from guard import guarded  # noqa: E402
from kinds import KINDS, Kind  # noqa: E402
from targets import PARSER, TARGETS, Target  # noqa: E402

from daq.base.console.memory import bounded_memory  # noqa: E402
from daq.exchange import formats  # noqa: E402

HANG_S = 30
SAVE_S = 5.0
PAGE = HERE.parents[1] / "docs" / "reliability.md"
GROUP = 256  # inputs between two looks at the clock: what guards them costs as much as some of them


def _batch(kind: Kind, good: list[bytes], rng: random.Random) -> list[bytes]:
    """Inputs of one stream: of any order, or one after the other; some of them whole."""
    if kind.many == 1:
        return [kind.damage(rng.choice(good), rng)]
    if not kind.once and rng.random() < 0.5:
        pieces = rng.choices(good, k=kind.many)
    else:
        start = int(rng.random() * len(good))
        pieces = [good[(start + k) % len(good)] for k in range(kind.many)]
    return [kind.pack(piece if rng.random() < kind.whole else kind.damage(piece, rng)) for piece in pieces]


class _Hang(BaseException):
    pass


_late: list[bool] = []


def _alarm(*_: object) -> None:
    """The first is forgiven: the whole run may have been stopped for a while."""
    if _late:
        raise _Hang(f"no answer within {2 * HANG_S} s")
    _late.append(True)
    signal.alarm(HANG_S)


@contextmanager
def _bounded_once() -> Iterator[None]:
    """The bound on memory that an importer sets for each file, set for many: it is not what is tried here."""
    with bounded_memory(0) as bound:
        before = formats.bounded_memory
        formats.bounded_memory = lambda size: nullcontext(bound)  # type: ignore[assignment]
        try:
            yield
        finally:
            formats.bounded_memory = before


def fuzz(name: str, tally: dict[str, dict[str, float]], wanted: int, save: Callable[[], None]) -> str:
    """Go on to the wanted number; what broke, or ""."""
    kind, mine = KINDS[name], tally.setdefault(name, {"inputs": 0, "cpu_s": 0.0, "peak_mb": 0.0})
    target, tails = TARGETS[kind.target or name], kind.tails() if kind.tails else [b""]
    pools = kind.pools(kind.target or name)
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None
    rng = random.Random(f"{name} {mine['inputs']:.0f}")
    with tempfile.TemporaryDirectory(dir=base) as scratch:
        folder = Path(scratch)
        for head, good in pools:
            target(head + b"".join(map(kind.pack, good)) + tails[0], folder)  # imports and compiles
        saved, cpu = time.monotonic(), time.process_time()
        while mine["inputs"] < wanted:
            streams = []
            for _ in range(max(1, GROUP // kind.many)):
                head, good = pools[int(rng.random() * len(pools))]
                tail = tails[int(rng.random() * len(tails))]
                tail = tail if not tail or rng.random() < 0.5 else kind.damage(tail, rng)
                streams.append((head, _batch(kind, good, rng), tail))
            broken, problem = _tried(target, streams, folder)
            if problem:
                head, batch, tail = streams[broken]
                case = head + b"".join(_smaller(target, head, batch, tail, folder)) + tail
                path = HERE / "cases" / f"{kind.target or name}-mass-{zlib.crc32(case):08x}"
                path.write_bytes(case)
                return f"{path.name}: {problem}"
            mine["inputs"] += kind.many * len(streams)
            if time.monotonic() - saved > SAVE_S or mine["inputs"] >= wanted:
                mine["cpu_s"] += time.process_time() - cpu
                peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
                mine["peak_mb"] = max(mine["peak_mb"], max(peaks) / 1024)
                if PARSER.crashes:
                    mine["crashes"] = mine.get("crashes", 0) + PARSER.crashes
                    PARSER.crashes = 0
                saved, cpu = time.monotonic(), time.process_time()
                save()
    PARSER.close()
    return ""


Stream = tuple[bytes, list[bytes], bytes]


def _tried(target: Target, streams: list[Stream], folder: Path) -> tuple[int, str]:
    """Which of them breaks a promise, and how; or -1 and ""."""
    at = -1
    _late.clear()
    signal.alarm(HANG_S)
    try:
        with guarded(folder), _bounded_once():
            for at, (head, batch, tail) in enumerate(streams):  # noqa: B007 - which one is told
                target(head + b"".join(batch) + tail, folder)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a Forbidden or a hang, too
        return at, repr(error)
    finally:
        signal.alarm(0)
    return -1, ""


def _smaller(target: Target, head: bytes, batch: list[bytes], tail: bytes, folder: Path) -> list[bytes]:
    """The batch without what it does not need to fail."""
    step = len(batch) // 2
    while step:
        at = 0
        while at < len(batch):
            less = batch[:at] + batch[at + step :]
            if _tried(target, [(head, less, tail)], folder)[1]:
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
        promised = "read or refused, memory bounded, no hang, no write elsewhere, nothing executed"
        value = f"{mine['inputs']:.0f} inputs, at most {mine['peak_mb']:.0f} MB"
        if "crashes" in mine:
            how_often = f"{mine['crashes']:.0f} times"
            value += f"; the library crashed, or came to no end, {how_often} in its process, which is told"
        row = f"hostile input: {name} | {_how(kind)} | {promised} | {value}"
        ElementTree.SubElement(ElementTree.SubElement(case, "properties"), "property", name="reliability", value=row)
    ElementTree.ElementTree(suite).write(path)


def begun(page: Path) -> dict[str, dict[str, float]]:
    """The tally that the page was made from, but for the times; of inputs as they are made today."""
    tally = {}
    row = re.compile(
        r"\| hostile input: (\S+) \| (damaged .*?) \|.*?\| (\d+) inputs, at most (\d+) MB(?:\D* (\d+) times)?.*`mass::"
    )
    for name, how, inputs, mb, crashes in row.findall(page.read_text(encoding="utf-8")):
        if name in KINDS and how == _how(KINDS[name]):
            tally[name] = {"inputs": float(inputs), "cpu_s": 0.0, "peak_mb": float(mb)}
            tally[name] |= {"crashes": float(crashes)} if crashes else {}
    return tally


def _how(kind: Kind) -> str:
    whole = f", {10 * kind.whole:.0f} of 10 whole" if kind.whole else ""
    return f"damaged {kind.what}" + (f", {kind.many} in a stream{whole}" if kind.many > 1 else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tally", type=Path)
    parser.add_argument("targets", nargs="*", choices=[[], *KINDS], metavar="TARGET")
    parser.add_argument("--inputs", type=int, default=10_000_000)
    parser.add_argument("--report", type=Path)
    options = parser.parse_args()
    tally = json.loads(options.tally.read_text()) if options.tally.exists() else begun(PAGE)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _alarm)
    failed = 0
    for name in options.targets or ([] if options.report else KINDS):
        with remembering():
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
