"""Hostile input, a little of it every time: hypothesis on every target, and every case that a fuzzer ever found."""

from __future__ import annotations

import io
import random
import re
import subprocess
import sys
from pathlib import Path
from tokenize import TokenError

import numpy as np
import pytest
import scipy.io
from again import remembering
from asammdf import MDF, Signal
from guard import Forbidden, guarded
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kinds import KINDS
from mat_parts import variables
from mat_variables import COLUMN, FORMATS, TIME, small_variables
from mf4_files import small_mf4s
from mf4_parts import files
from pyuff.datasets import dataset_58
from scipy.io.matlab._mio4 import MatFile4Reader
from seeds import seeds
from targets import PARSER, TARGETS, _array, _chunk, _message, _records

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.errors import LogError
from daq.exchange.child import READER_OF_SUFFIX, Found, answer, of_mat
from daq.exchange.formats import read
from daq.log import codec as codec
from daq.log.reader import read_log
from drivers.contract.reading import Gap

CASES = sorted(path for path in (Path(__file__).parent / "cases").glob("*-*"))
EXAMPLES = {"mf4can": 2, "mf4": 3, "mat": 6, "rig": 40, "uff": 40, "mapped": 40}


@st.composite
def damaged(draw: st.DrawFn, name: str) -> bytes:
    """A good input with a few of its pieces overwritten, cut out or doubled; or any bytes."""
    good = draw(st.sampled_from([*seeds(name), b""]))
    if not good:
        return draw(st.binary(max_size=400))
    data = bytearray(good)
    rng = random.Random(draw(st.integers(0, 2**32)))
    for _ in range(draw(st.integers(1, 6))):
        at, length = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 60))
        how = rng.randrange(4)
        if how == 0:
            data[at : at + length] = rng.randbytes(length)
        elif how == 1:
            del data[at : at + length]
        elif how == 2:
            data[at:at] = data[at : at + length]
        else:
            data[at : at + length] = rng.choice((b"\xff", b"\0", b"\x7f")) * length
    return bytes(data)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", TARGETS)
def test_any_input_is_read_or_refused(name: str, tmp_path: Path) -> None:
    for good in seeds(name):
        TARGETS[name](good, tmp_path)  # imports and compiles

    @settings(max_examples=EXAMPLES.get(name, 60), suppress_health_check=list(HealthCheck), database=None)
    @given(damaged(name))
    def try_it(data: bytes) -> None:
        with guarded(tmp_path):
            TARGETS[name](data, tmp_path)

    try_it()
    PARSER.close()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_what_a_fuzzer_found_stays_found(case: Path, tmp_path: Path) -> None:
    with guarded(tmp_path):
        TARGETS[max((n for n in TARGETS if case.name.startswith(f"{n}-")), key=len)](case.read_bytes(), tmp_path)
    PARSER.close()


REFUSED = """
import sys
from pathlib import Path
import daq.base.console.memory
from daq.base.contract.errors import LogError
from daq.exchange.formats import read

path = Path(sys.argv[1])
read(path, ["b1x"])  # and what is lazy is imported
daq.base.console.memory._free_bytes = lambda: 60_000_000
try:
    read(path, ["b1x"])
except LogError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".npz", ".mat", ".mf4"])
def test_a_small_file_that_unpacks_to_much_is_refused(suffix: str, tmp_path: Path) -> None:
    """80 MB of zeros in a hundred kB, where 30 MB may be used: of a process of its own, as one that has analysed before
    has room in its heap."""
    path = tmp_path / f"bomb{suffix}"
    column = np.zeros(10**7)
    if suffix == ".npz":
        np.savez_compressed(path, b1x=column, rate_hz=1.0)
    elif suffix == ".mat":
        scipy.io.savemat(path, {"b1x": column}, do_compression=True)
    else:
        with MDF() as file:
            file.append([Signal(column, np.arange(len(column)) * 1e-4, name="b1x")])
            file.save(path, compression=1)
    command = [sys.executable, "-c", REFUSED, path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    # what reads .mat and .mf4 does not always ask whether it got its memory; it crashes in a process of its own
    said = "takes more than 0.03 GB of memory.*; cut it into parts" + ("" if suffix == ".npz" else "|reads it crashed")
    assert re.search(said, done.stdout), done


@pytest.mark.slow
def test_a_file_without_end_is_refused(tmp_path: Path) -> None:
    """asammdf follows a circle of blocks in it: its process has 20 s of CPU time."""
    path = tmp_path / "a.mf4"
    path.write_bytes((CASES[0].parent / "mf4-parse-endless").read_bytes())
    with pytest.raises(LogError, match="the library that reads it comes to no end"):
        read(path, ["b1x", "b1y"])


def test_a_log_of_countless_events_is_refused(tmp_path: Path) -> None:
    data = b"".join(_records(b"")) + 30_000 * _message(codec.GAP_CHANNEL, codec.encode_gap(Gap(4, 0, "")))
    (tmp_path / "a.mcap").write_bytes(LOG_MAGIC + _chunk(data))
    assert (tmp_path / "a.mcap").stat().st_size < 2_000
    with pytest.raises(LogError, match="more than 20000 gaps"):
        read_log(tmp_path / "a.mcap", max_events=20_000)


def test_a_pickle_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return eval, (f"open({str(tmp_path / 'owned')!r}, 'w')",)

    np.savez(tmp_path / "a.npz", b1x=np.array([Evil()], dtype=object))
    with pytest.raises(LogError, match="holds Python objects"):
        read(tmp_path / "a.npz", ["b1x"])
    assert not (tmp_path / "owned").exists()


@pytest.mark.filterwarnings("ignore")
def test_what_a_library_says_again_is_what_it_said() -> None:
    """Damaged arrays and lines of data sets: asked, asked with a memory, and asked of the memory."""
    rng = random.Random(1)
    [(_, good)] = KINDS["npz-members"].pools("npz-members")
    arrays = [KINDS["npz-members"].damage(rng.choice(good), rng) for _ in range(1000)]
    lines = [line.decode("latin-1") for data in seeds("uff-sets") for line in data.splitlines()[2:14]]
    lines += [KINDS["uff"].damage(line.encode("latin-1"), rng).decode("latin-1") for line in lines * 20]

    def said() -> list[str]:
        told = []
        for ask, inputs in ((_array, arrays), (_line, lines)):
            for one in inputs:
                try:
                    told.append(repr(ask(one)))  # type: ignore[operator]
                except Exception as error:  # noqa: BLE001 - what it says is what is compared
                    text = re.sub(" at 0x[0-9a-f]+", "", repr(error))
                    no_python = isinstance(error, TokenError) or "Cannot parse header" in text  # either: ours is told
                    told.append("no header" if no_python else text)
        return told

    asked = said()
    with remembering():
        assert said() == asked
        assert said() == asked
    assert len(set(asked)) > 400
    assert said() == asked


def test_a_part_is_read_as_in_a_file_of_its_own(tmp_path: Path) -> None:
    """Short ways into scipy and asammdf, see mat_parts.py and mf4_parts.py: the same numbers, names, units."""
    small = small_mf4s()
    for k, data in enumerate(small):
        (tmp_path / "a.mf4").write_bytes(data)
        _same(files(small)(k), READER_OF_SUFFIX[".mf4"](tmp_path / "a.mf4", ("b1x",)))
    head = io.BytesIO()
    scipy.io.savemat(head, {})
    good = {"b1x": COLUMN, "time": TIME}
    for piece in small_variables():
        data = piece[1:] if FORMATS[piece[0] // 8][0] is MatFile4Reader else head.getvalue()[:128] + piece[1:]
        own = scipy.io.loadmat(io.BytesIO(data), squeeze_me=True)
        _same(variables([b"", piece])(1), of_mat(good | own, ("b1x",)))


def _same(short: Found, long: Found) -> None:
    one, other = ({name: (a.dtype, a.tolist()) for name, a in answer(found).items()} for found in (short, long))
    assert one == other


def _line(text: str) -> object:
    names = ["a", "b", "c", "d", "e", "f"]
    return dataset_58._parse_header_line(text, 4, [10, 5, 5, 5, 21, 21], [2, 2, 2, 2, 1, 1], names)


def test_the_guard_guards(tmp_path: Path) -> None:
    import subprocess

    with guarded(tmp_path):
        (tmp_path / "a").write_text("allowed")
    with pytest.raises(Forbidden, match="open"), guarded(tmp_path):
        (tmp_path.parent / "b").write_text("elsewhere")
    with pytest.raises(Forbidden, match="Popen"), guarded(tmp_path):
        subprocess.run(["true"], check=False)
