"""The comparison as a Rerun recording, read back with Rerun's own reader."""

from __future__ import annotations

from pathlib import Path

from made_up_results import CHANNELS, made_up
from recordings import entities

from daq.report.rerun.comparison import log_comparison


def test_everything_that_the_report_draws(tmp_path: Path) -> None:
    parts = made_up()
    out = tmp_path / "comparison.rrd"
    log_comparison(str(out), parts["comparison"], parts["before"], parts["diagnoses"], parts["ladder"], parts["title"])
    rows = entities(out)
    for channel in CHANNELS:
        drawn = (f"law/{channel}/velocity", f"residual/{channel}/displacement")
        for path in (*drawn, f"spectrum/{channel}", f"density/{channel}"):
            assert rows[f"{path}/curves"] == 2, "one row a step of the ladder"
    assert rows["orbit/bearing1/measured/curves"] == 2
    for page in ("summary", "map", "diagnosis", "parameters"):
        assert rows[page] == 1


def test_the_shape_of_what_is_unknown_is_drawn(tmp_path: Path) -> None:
    parts = made_up()
    curve = parts["comparison"]["curves"][0]
    found = {"verdict": "unknown", "ranking": [], "messages": [], "shape": curve}
    for name, shape in (("band", curve), ("bare", {k: v for k, v in curve.items() if not k.startswith("band")})):
        out = tmp_path / f"{name}.rrd"
        log_comparison(str(out), parts["comparison"], diagnoses=[found | {"shape": shape}])
        assert entities(out)["unknown/b1x/curves"] == 1


def test_only_the_contract_keys(tmp_path: Path) -> None:
    bare = {k: v for k, v in made_up()["comparison"].items() if k not in ("curves", "spectra", "densities", "orbits")}
    log_comparison(str(tmp_path / "bare.rrd"), bare)
    assert "summary" in entities(tmp_path / "bare.rrd")


def test_any_names(tmp_path: Path) -> None:
    parts = made_up()
    for curve in parts["comparison"]["curves"]:
        curve["channel"] = "a/b c$"
    parts["comparison"]["spectra"] = {"a/b c$": parts["comparison"]["spectra"]["b1x"]}
    log_comparison(str(tmp_path / "names.rrd"), parts["comparison"])
    assert r"spectrum/a\/b\ c\$/curves" in entities(tmp_path / "names.rrd")


def test_names_of_marks_stand_above_the_frame_in_rows_of_their_own() -> None:
    from daq.report.rerun.plane import MARK_ROW_UNITS, Axis, Plane, mark_names

    frame = Plane(Axis(0.0, 12.0, "order of the shaft"), Axis(1e-5, 1e-2, "m/s²", log=True))
    named = mark_names(frame, [(2.1, "BPFO"), (2.0, "2X"), (1.0, "1X")])
    positions = named.positions.as_arrow_array().to_pylist()
    assert [label.as_py() for label in named.labels.as_arrow_array()] == ["1X", "2X", "BPFO"]
    assert [y for _, y in positions] == [-MARK_ROW_UNITS, -2 * MARK_ROW_UNITS, -3 * MARK_ROW_UNITS]
