"""A damaged .blf: its cost, and its notices; the reader of python-can reports little of it."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import psutil
import pytest

from drivers.foreign.blf import LARGEST_CONTAINER
from drivers.foreign.capture_batches import Batch
from drivers.foreign.capture_files import open_capture

REAL = Path(__file__).parents[2] / "data" / "canedge_imu" / "canedge_imu.blf"
Row = Callable[[str, object], None]


def read(path: Path) -> list[Batch]:
    return list(open_capture(str(path), None))


def payloads(batches: list[Batch]) -> list[bytes]:
    return [row.tobytes() for batch in batches for row in batch.frames.payload]


def frames(batches: list[Batch]) -> list[tuple[int, int, bytes]]:
    each = (zip(b.frames.ids, b.frames.t_ns, b.frames.payload, strict=True) for b in batches)
    return [(int(number), int(t_ns), row.tobytes()) for batch in each for number, t_ns, row in batch]


def containers(data: bytes) -> list[int]:
    """Where they begin."""
    at, out = 144, []
    while at < len(data):
        out.append(at)
        size = int.from_bytes(data[at + 8 : at + 12], "little")
        at += size + size % 4
    return out


def container(content: bytes, how: int = 0) -> bytes:
    packed = zlib.compress(content) if how == 2 else content
    head = struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, 32 + len(packed), 10, how, len(content))
    return head + packed + bytes(len(head + packed) % 4)


def objects(path: Path, n: int) -> list[bytes]:
    """Of n classic frames 0, 1 ..., each with its padding."""
    with can.BLFWriter(path) as writer:
        for k in range(n):
            writer.on_message_received(can.Message(timestamp=1.7e9 + k, arbitration_id=9, data=bytes((k,))))
    data = path.read_bytes()
    size = int.from_bytes(data[152:156], "little")
    content = zlib.decompress(data[176 : 144 + size])
    each = len(content) // n
    return [content[k : k + each] for k in range(0, len(content), each)]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def file(*parts: bytes) -> Path:
        path = tmp_path / "a.blf"
        path.write_bytes(struct.pack("<4sI136x", b"LOGG", 144) + b"".join(parts))
        return path

    return file


@pytest.mark.slow
def test_a_flipped_bit_costs_the_container_that_it_is_in(tmp_path: Path, record_property: Row) -> None:
    whole, data = frames(read(REAL)), REAL.read_bytes()
    starts = containers(data)
    assert len(starts) > 3
    path, least = tmp_path / "a.blf", len(whole)
    for k, at in enumerate(starts[:-1]):
        for offset in (0, 9, 12, 16, 200):  # signature, length, type, packing, content
            broken = bytearray(data)
            broken[at + offset] ^= 0x40
            path.write_bytes(broken)
            batches = read(path)
            left = frames(batches)
            assert sum(batch.damaged for batch in batches) >= 1, (k, offset)
            lost = len(whole) - len(left)
            before = next((i for i, frame in enumerate(left) if frame != whole[i]), len(left))
            assert left[before:] == whole[before + lost :]
            least = min(least, len(left))
    share = f"{100 * (1 - least / len(whole)):.0f} % of the frames lost at most, the others bit for bit"
    row = f".blf with a flipped bit | {5 * len(starts[:-1])} times | told, the container lost that it is in"
    record_property("reliability", f"{row} | {share} ({len(starts)} containers)")
    assert least > len(whole) * (1 - 2 / len(starts))


@pytest.mark.parametrize(("at", "value"), [(8, 40), (8, 5000), (8, 2**31), (8, 0), (0, 0)])
def test_an_object_of_wrong_length_is_reported(at: int, value: int, write: Callable[..., Path], tmp_path: Path) -> None:
    """It hides neither those before it, nor the containers behind it, and its neighbour's bytes are not its own."""
    good = objects(tmp_path / "w.blf", 6)
    wrong = bytearray(good[1])
    wrong[at : at + 4] = struct.pack("<I", value)
    path = write(container(good[0] + bytes(wrong) + good[2]), *(container(bytes(6000)) for _ in range(value == 5000)),
                 container(b"".join(good[3:]), 2))  # fmt: skip
    batches = read(path)
    assert sum(batch.damaged for batch in batches) >= 1
    # the frame is whole, if its object is not too short for it or longer than any
    assert [row[0] for row in payloads(batches)] == ([0, 1, 3, 4, 5] if value == 5000 else [*([0] * (not at)), 3, 4, 5])


def test_objects_over_two_containers_and_in_none(write: Callable[..., Path], tmp_path: Path) -> None:
    good = b"".join(objects(tmp_path / "w.blf", 4))
    batches = read(write(container(good[:70]), container(good[70:100], 2), container(good[100:])))
    assert [row[0] for row in payloads(batches)] == [0, 1, 2, 3]
    assert not any(batch.damaged for batch in batches)
    batches = read(write(good))
    assert [row[0] for row in payloads(batches)] == [0, 1, 2, 3]
    batches = read(write(container(good[:70]), container(b"", 7), container(good[100:], 2)))
    assert [row[0] for row in payloads(batches)] == [0, 3]
    assert "unknown way (7)" in batches[0].why
    batches = read(write(container(good[:-10])))
    assert [row[0] for row in payloads(batches)] == [0, 1, 2]
    assert batches[0].why == "the file ends inside an object"


def test_a_small_container_that_unpacks_to_much_is_refused(write: Callable[..., Path], tmp_path: Path) -> None:
    packer = zlib.compressobj()
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(400)) + packer.flush()
    head = struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2, 400 << 20)
    good = container(b"".join(objects(tmp_path / "w.blf", 2)), 2)
    path = write(good, head + packed + bytes(len(packed) % 4), good)
    process = psutil.Process()
    before, batches, most = process.memory_info().rss, [], 0
    for batch in open_capture(str(path), None):
        batches.append(batch)
        most = max(most, process.memory_info().rss - before)
    assert [row[0] for row in payloads(batches)] == [0, 1, 0, 1]
    assert "unpacks to more than it may" in batches[0].why
    assert most < 4 * LARGEST_CONTAINER
