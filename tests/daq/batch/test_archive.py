"""Which files are logs of an archive, and which rig file each has."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.base.contract.errors import ConfigError
from daq.batch.archive import LogSource, RigsByField, RigSource, find_logs, read_rig

ONE_CAP = Path(__file__).parents[2] / "data" / "one_cap.toml"
SOME_RIG = RigSource(path="rig.toml", digest="0", name="a rig")


def found(pattern: str) -> dict[str, LogSource]:
    return {Path(log.url).name: log for log in find_logs([pattern], lambda _url, _fields: SOME_RIG)}


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two machines with a log each, and a rig file for each; and one that has none."""
    for machine in ("pump7", "fan2", "new"):
        (tmp_path / "archive" / machine / "2026").mkdir(parents=True)
        (tmp_path / "archive" / machine / "2026" / f"{machine}-a.mcap").write_bytes(machine.encode())
    (tmp_path / "rigs").mkdir()
    for machine in ("pump7", "fan2"):
        (tmp_path / "rigs" / f"{machine}.toml").write_text(ONE_CAP.read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_patterns_name_files_once_and_in_order(archive: Path) -> None:
    logs = find_logs(["archive/**/*.mcap", str(archive / "archive/fan2/2026/fan2-a.mcap")], lambda *_: SOME_RIG)
    assert [Path(log.url).name for log in logs] == ["fan2-a.mcap", "new-a.mcap", "pump7-a.mcap"]
    assert {log.machine for log in logs} == {"a rig"}
    with pytest.raises(ConfigError, match="no file matches"):
        find_logs(["archive/*.mcap"], lambda *_: SOME_RIG)
    with pytest.raises(ConfigError, match="nowhere"):
        find_logs(["nowhere://bucket/*.mcap"], lambda *_: SOME_RIG)


def test_the_stamp_changes_with_the_file(archive: Path) -> None:
    before = found("archive/fan2/**/*.mcap")["fan2-a.mcap"].stamp
    (archive / "archive/fan2/2026/fan2-a.mcap").write_bytes(b"longer than before")
    assert found("archive/fan2/**/*.mcap")["fan2-a.mcap"].stamp != before


def test_fields_of_the_pattern_choose_the_rig_file(archive: Path) -> None:
    logs = find_logs(["archive/{machine}/**/{machine}-{part}.mcap"], RigsByField("rigs/{machine}.toml"))
    rigs = archive / "rigs"
    assert [(log.machine, log.rig.path) for log in logs] == [
        ("fan2/a", str(rigs / "fan2.toml")), ("new/a", str(rigs / "new.toml")), ("pump7/a", str(rigs / "pump7.toml")),
    ]  # fmt: skip
    assert [bool(log.rig.problem) for log in logs] == [False, True, False]
    assert "no such rig file" in logs[1].rig.problem


def test_a_field_that_no_pattern_names_is_a_folder_with_a_rig_file(archive: Path) -> None:
    logs = find_logs(["archive/**/*.mcap"], RigsByField("rigs/{machine}.toml"))
    rigs = archive / "rigs"
    assert [(log.machine, log.rig.path) for log in logs] == [
        ("fan2", str(rigs / "fan2.toml")), ("", ""), ("pump7", str(rigs / "pump7.toml")),
    ]  # fmt: skip
    assert "add it, or name the field" in logs[1].rig.problem


def test_two_rig_files_that_fit_are_refused(archive: Path) -> None:
    (archive / "rigs" / "2026.toml").write_text(ONE_CAP.read_text())
    logs = find_logs(["archive/fan2/**/*.mcap"], RigsByField("rigs/{machine}.toml"))
    assert "rigs/2026.toml and rigs/fan2.toml both fit" in logs[0].rig.problem
    with pytest.raises(ConfigError, match="names no field"):
        RigsByField("rigs/rig.toml")


def test_the_digest_of_a_rig_changes_with_its_text(archive: Path) -> None:
    before = read_rig("rigs/fan2.toml").digest
    assert read_rig(str(archive / "rigs" / "fan2.toml")) == read_rig("./rigs/fan2.toml")
    (archive / "rigs/fan2.toml").write_text(ONE_CAP.read_text() + "# a remark\n")
    assert read_rig("rigs/fan2.toml").digest != before
