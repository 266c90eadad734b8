"""What goes into a log comes out of it, bit for bit; and other tools can read it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from sessions import CHANNELS, DBC_TEXT, RIG_TEXT, make_block, make_info, make_session, make_stream, truth, write_log

from daq.base.contract.errors import LogError
from daq.base.contract.sink import ClockState
from daq.commands.cli.app import main
from daq.exchange.measurement import measure
from daq.log import codec as codec
from daq.log.reader import read_log
from daq.log.schema import message
from daq.rig.rig import load_rig
from drivers.contract.reading import Block, Gap, Info, Notice, Signal

CONFIG = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"


def test_everything_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    stream = write_log(path)
    log = read_log(path)
    first, counts = truth(stream)
    assert log.complete
    assert log.damage == ()
    assert (log.first, log.n_samples, log.lost_samples) == (first, 40 * 320, 107)
    np.testing.assert_array_equal(log.counts(), counts)
    scale = np.array([s.scale for s in make_info().signals])
    missing = counts[:, 0] == np.iinfo(np.int32).min
    np.testing.assert_array_equal(log.samples(), np.where(missing[:, None], np.nan, counts * scale))
    assert log.gaps == tuple(r for r in stream if isinstance(r, Gap))
    assert log.notices == tuple(r for r in stream if isinstance(r, Notice))
    assert log.rig_text == RIG_TEXT
    assert log.dbc == DBC_TEXT
    assert log.channels == tuple(c.name for c in CHANNELS)
    assert log.info == make_info()
    assert log.metadata == {"rotorscope": "0.1.0", "link": "virtual:"}
    assert log.head.device == "dev1"
    assert log.clock == ClockState(123456789, 25601.28, 50.0, 700_000)
    assert log.last_status is not None
    assert log.last_status.link.other == {"odd": 2}
    assert log.seconds == pytest.approx(len(counts) / 25600.0)
    for logged in log.estimates:
        assert codec.encode_estimate(logged.estimate) == logged.data
        assert np.isnan(logged.estimate.parameters["bearing1.y.kL"].value or 0.0)
        assert logged.estimate.parameters["bearing1.x.c"].value is None


def test_readings_come_back_in_order(tmp_path: Path) -> None:
    stream = write_log(tmp_path / "a.mcap")
    back = list(read_log(tmp_path / "a.mcap").readings())
    assert back[0] == make_info()
    assert [r for r in back if isinstance(r, Gap | Notice)] == [r for r in stream if isinstance(r, Gap | Notice)]
    blocks = [r for r in back if isinstance(r, Block)]
    np.testing.assert_array_equal(truth(list(blocks))[1], truth(stream)[1])
    last = next(r for r in reversed(stream) if isinstance(r, Block))
    assert blocks[-1].t_host_ns == last.t_host_ns
    assert blocks[0].t_device_ns == next(r for r in stream if isinstance(r, Block)).t_device_ns


@settings(max_examples=25, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 700), min_size=1, max_size=12),
    holes=st.lists(st.sampled_from([0, 0, 0, 1, 5000]), min_size=12, max_size=12),
    bits=st.sampled_from([8, 16, 24, 32]),
    device=st.booleans(),
    first=st.integers(0, 2**40),
)
def test_any_stream_comes_back(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], holes: list[int], bits: int, device: bool, first: int
) -> None:
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    stream: list[Block | Gap] = []
    index = first
    for n, hole in zip(lengths, holes, strict=False):
        stream.append(make_block(index, n, bits, device))
        index += n
        if hole:
            stream.append(Gap(index, hole, "sequence"))
            index += hole
    write_log(path, list(stream), make_session(bits))
    log = read_log(path)
    counts = log.counts()
    expected = truth(list(stream))[1]
    np.testing.assert_array_equal(counts[: len(expected)], expected)
    assert (counts[len(expected) :] == np.iinfo(np.int32).min).all()
    assert log.complete
    assert log.gaps == tuple(r for r in stream if isinstance(r, Gap))


def test_blocks_are_joined_and_keep_their_times(tmp_path: Path) -> None:
    blocks = [make_block(64 * k, 64) for k in range(100)]
    write_log(tmp_path / "a.mcap", list(blocks))
    with (tmp_path / "a.mcap").open("rb") as file:
        raw = [codec.decode_block(m.data) for _, c, m in make_reader(file).iter_messages() if c.topic == "/raw"]
    assert len(raw) < 13
    assert [t for r in raw for t in r.part_host_ns] == [b.t_host_ns for b in blocks]
    assert [t for r in raw for t in r.part_device_ns] == [b.t_device_ns for b in blocks]
    back = [r for r in read_log(tmp_path / "a.mcap").readings(joined=False) if isinstance(r, Block)]
    for ours, theirs in zip(back, blocks, strict=True):
        assert (ours.index, ours.t_host_ns, ours.t_device_ns) == (theirs.index, theirs.t_host_ns, theirs.t_device_ns)
        np.testing.assert_array_equal(ours.counts, theirs.counts)


def test_other_tools_read_it(tmp_path: Path) -> None:
    """The schemas in the file decode its messages; preview is ROS 2 CDR; nothing of ours is needed."""
    from mcap_protobuf.decoder import DecoderFactory

    stream = write_log(tmp_path / "a.mcap", make_stream(80))
    topics: dict[str, list[object]] = {}
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, raw in reader.iter_messages():
            if schema is not None and schema.encoding == "protobuf":
                topics.setdefault(channel.topic, []).append(DecoderFactory().decoder_for("protobuf", schema)(raw.data))  # type: ignore[misc]
            elif channel.message_encoding == "json":
                topics.setdefault(channel.topic, []).append(json.loads(raw.data))
            else:
                topics.setdefault(channel.topic, []).append(np.frombuffer(raw.data, "<f8", offset=20 - 20 % 8 + 4))
    numbers = {f"/preview/{s.name}" for s in make_info().signals}
    assert {t.name for t in codec.LOG_TOPICS} - {"/preview"} | numbers <= set(topics)
    assert "/estimates" in topics
    assert sum(m.rows for m in topics["/raw"]) == sum(len(r.counts) for r in stream if isinstance(r, Block))  # type: ignore[attr-defined]
    assert topics["/log"][0].message == "a frame was damaged"  # type: ignore[attr-defined]


@pytest.mark.parametrize("recovered", [False, True])
def test_the_schema_of_the_estimates_names_every_number(recovered: bool, tmp_path: Path) -> None:
    """Foxglove takes no JSON topic whose schema has no properties, and offers these names in a plot."""
    path = tmp_path / "a.mcap"
    write_log(path, make_stream(80))
    if recovered:
        path = tmp_path / "b.mcap"
        assert main(["recover", str(tmp_path / "a.mcap"), "--out", str(path), "--quiet"]) == 0
    with path.open("rb") as file:
        found = [(s, json.loads(m.data)) for s, _, m in make_reader(file).iter_messages(topics=["/estimates"]) if s]
    assert found
    for schema, values in found:
        about = json.loads(schema.data)
        for part in ("bearing1", "x"):
            about, values = about["properties"][part], values[part]
        assert set(values) <= set(about["properties"])
        assert all(kind["type"] == "number" for kind in about["properties"].values())


def test_rerun_plots_preview_and_notices_with_no_help(tmp_path: Path) -> None:
    import subprocess

    import rerun_cli

    write_log(tmp_path / "a.mcap", make_stream(80))
    rerun = str(Path(rerun_cli.__file__).parent / "rerun")
    target = str(tmp_path / "a.rrd")
    subprocess.run([rerun, "mcap", "convert", str(tmp_path / "a.mcap"), "-o", target], check=True, capture_output=True)
    out = subprocess.run([rerun, "rrd", "print", target], check=True, capture_output=True, text=True).stdout
    for signal in make_info().signals:
        assert f"- /preview/{signal.name} - data columns: [Scalars:scalars]" in out
    assert "- /log - data columns: [TextLog:level TextLog:text]" in out


def test_the_preview_is_the_envelope(tmp_path: Path) -> None:
    stream = write_log(tmp_path / "a.mcap", make_stream(80))
    scale = np.array([s.scale for s in make_info().signals])
    _, counts = truth(stream)
    present = counts[counts[:, 0] > np.iinfo(np.int32).min] * scale
    with (tmp_path / "a.mcap").open("rb") as file:
        messages = [(c, m) for _, c, m in make_reader(file).iter_messages() if c.topic.startswith("/preview/")]
    for k, signal in enumerate(make_info().signals):
        preview = [m for c, m in messages if c.topic == f"/preview/{signal.name}"]
        assert {c.metadata["unit"] for c, _ in messages if c.topic == f"/preview/{signal.name}"} == {signal.unit}
        values = np.array([np.frombuffer(m.data[20:], "<f8")[0] for m in preview])
        np.testing.assert_allclose(values.max(), present[:, k].max())
        np.testing.assert_allclose(values.min(), present[:, k].min())
        spacing = np.diff([m.log_time for m in preview])
        assert np.median(spacing) == pytest.approx(1e7, rel=1e-3)  # 100 Hz


def test_a_full_scale_change_is_kept(tmp_path: Path) -> None:
    """A device that changes its range in the middle: each sample has the scale that was announced for it."""
    first, second = make_info(), Info(tuple(Signal(c.name, "m/s^2", 2.0, 0.5) for c in CHANNELS), 25600.0)
    stream = [make_block(0, 100), second, make_block(100, 100), first, make_block(200, 100)]
    write_log(tmp_path / "a.mcap", stream)
    samples = read_log(tmp_path / "a.mcap").samples()
    np.testing.assert_array_equal(samples[100:200], make_block(100, 100).counts * 2.0 + 0.5)
    np.testing.assert_array_equal(samples[200:, 0], make_block(200, 100).counts[:, 0] * first.signals[0].scale)
    assert [r for r in read_log(tmp_path / "a.mcap").readings() if isinstance(r, Info)] == [first, second, first]


OTHERS = {  # name and unit of each signal, and the rate
    "another rate": ([(c.name, "m/s^2") for c in CHANNELS], 100.0, "100 Hz instead of 25600 Hz"),
    "fewer": ([(c.name, "m/s^2") for c in CHANNELS[1:]], 25600.0, "channels b1y, b2x, b2y instead of"),
    "another unit": ([(c.name, "V") for c in CHANNELS], 25600.0, "b1x in V instead of m/s^2"),
}


@pytest.mark.parametrize("which", OTHERS)
def test_what_is_no_continuation_is_left_out_and_told(
    tmp_path: Path, which: str, record_property: Callable[[str, object], None]
) -> None:
    """A device that came back with other settings costs what follows, not the hours before; and is no wrong number."""
    path = tmp_path / "a.mcap"
    signals, rate_hz, said = OTHERS[which]
    other = Info(tuple(Signal(name, unit, 2.0, 0.0) for name, unit in signals), rate_hz)
    block = make_block(100, 50)
    write_log(path, [make_block(0, 100), other, replace(block, counts=block.counts[:, : len(signals)])])
    log = read_log(path)
    assert (log.n_samples, [(o.index, o.samples) for o in log.others]) == (150, [(100, 50)])
    assert said in log.others[0].what
    samples, counts = log.samples(), log.counts()
    np.testing.assert_array_equal(counts[:100], make_block(0, 100).counts)
    assert np.isnan(samples[100:]).all()
    assert np.isfinite(samples[:100]).all()
    assert (counts[100:] == np.iinfo(np.int32).min).all()
    notes: list[str] = []
    y = measure(path, load_rig(CONFIG), notes.append).y
    assert np.isnan(y[100:]).all()
    np.testing.assert_array_equal(y[1:100], samples[1:100])  # the first is at full scale
    assert [line for line in notes if f"{log.others[0]} are left out" in line]
    row = f"device comes back with other settings | {said} | what was before is used, the rest left out and told"
    record_property("reliability", f"{row} | {log.others[0].samples} samples left out, no wrong number")


def test_channels_that_come_in_another_order_stay_themselves(tmp_path: Path) -> None:
    """By name, as in the live run; one more does not matter."""
    path, order = tmp_path / "a.mcap", [3, 1, 0, 2]
    names = [*(CHANNELS[k].name for k in order), "spare"]
    other = Info(tuple(Signal(name, "m/s^2" if k < 4 else "V", 2.0, 0.0) for k, name in enumerate(names)), 25600.0)
    block = make_block(100, 50)
    counts = np.column_stack([block.counts[:, order], block.counts[:, 0]])
    write_log(path, [make_block(0, 100), other, replace(block, counts=counts)])
    log = read_log(path)
    assert log.others == ()
    np.testing.assert_array_equal(log.counts()[100:], block.counts)
    np.testing.assert_array_equal(log.samples()[100:], block.counts * 2.0)


def test_a_gap_of_ages_allocates_nothing(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", [make_block(0, 100), Gap(100, 10**12, "sequence"), make_block(100 + 10**12, 100)])
    log = read_log(tmp_path / "a.mcap")
    assert log.lost_samples == 10**12
    with pytest.raises(LogError, match="too many"):
        log.samples()


def test_not_a_log(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.mcap: cannot be read: No such file"):
        read_log(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(LogError, match="no Rotorscope log"):
        read_log(tmp_path / "text.mcap")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(LogError, match="is empty"):
        read_log(tmp_path / "empty.mcap")
    from mcap.writer import Writer

    writer = Writer(str(tmp_path / "other.mcap"))
    writer.start()
    schema = writer.register_schema("x", "jsonschema", b"{}")
    writer.add_message(writer.register_channel("/imu", "json", schema), 0, b"{}", 0)
    writer.finish()
    with pytest.raises(LogError, match="not a Rotorscope log"):
        read_log(tmp_path / "other.mcap")


def test_messages_that_contradict_themselves() -> None:
    good = message("rotorscope.Block").FromString(codec.encode_blocks([make_block(0, 10)]))
    for name, value in (("rows", 11), ("width", 3), ("channels", 5), ("index", -1)):
        bad = type(good)()
        bad.CopyFrom(good)
        setattr(bad, name, value)
        with pytest.raises(ValueError, match="block at"):
            codec.decode_block(bad.SerializeToString())
