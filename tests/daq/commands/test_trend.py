"""`rotorscope trend`: table, JSON, page and recording of a trend that is known."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import jsonschema
import pyarrow
import pytest
from pyarrow import parquet

from daq.batch.tables import schema
from daq.commands.cli.app import main
from daq.trend.days import DayWriter, Row
from daq.trend.series import read_trend

DOCS_FOLDER = Path(__file__).parents[3] / "docs"
T0_NS, MINUTE_NS = 1_700_006_400 * 10**9, 60 * 10**9  # 2023-11-15, midnight
MINUTES = 3 * 1440
STARTED = datetime(2024, 3, 1, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three days: kL falls by a tenth, the velocity passes from zone A to C, six hours are missing, an alarm."""
    path = tmp_path_factory.mktemp("press")
    rows = [Row(T0_NS, "zone_limit", z, limit, unit="mm/s") for z, limit in zip("BCD", (1.4, 2.8, 4.5), strict=True)]
    for k in range(0, MINUTES, 2):
        time, share = T0_NS + k * MINUTE_NS, k / MINUTES
        if 2000 <= k < 2360:
            continue
        rows.append(Row(time, "estimate", "bearing1.x.kL", 1e7 * (1 - 0.1 * share), sd=1e4, unit="N/m"))
        velocity = 1.0 + 2.0 * share
        zone = "ABC"[(velocity > 1.4) + (velocity > 2.8)]
        rows.append(Row(time, "severity", "b1x.velocity_rms_mm_s", velocity, unit="mm/s", text=zone))
        rows.append(Row(time, "tone", "1X.b1x", 0.5, unit="m/s^2", text="35 Hz"))
    rows.append(Row(T0_NS + 2180 * MINUTE_NS, "gap", "reconnect", 25_600.0, unit="samples"))
    rows.append(Row(T0_NS + 4000 * MINUTE_NS, "alarm_raised", "bearing1.x.kL", 9.1e6, text="kL </script> has changed"))
    writer = DayWriter(path / "trend")
    writer.append(sorted(rows, key=lambda row: row.time_ns))
    writer.end_day()
    return path


def test_table_json_and_page(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, page = tmp_path / "t.json", tmp_path / "t.html"
    assert main(["trend", str(folder), "--json", str(out), "--html", str(page)]) == 0
    text = capsys.readouterr().out
    value: dict[str, Any] = json.loads(out.read_text())
    jsonschema.validate(value, json.loads((DOCS_FOLDER / "schemas" / "trend.json").read_text()))
    stiffness = next(s for s in value["series"] if s["name"] == "bearing1.x.kL")
    assert stiffness["values"] == (MINUTES - 360) // 2
    assert stiffness["last"]["value"] == pytest.approx(9e6, rel=1e-3)
    assert stiffness["value"][0] == pytest.approx(1e7, rel=1e-3)
    assert all(low <= v <= high for low, v, high in zip(*(stiffness[k] for k in ("low", "value", "high")), strict=True))
    velocity = next(s for s in value["series"] if s["kind"] == "severity")
    assert (velocity["zone"][0], velocity["zone"][-1]) == ("A", "C")
    assert re.search(r"bearing1.x.kL .*-9(\.\d)? %", text)
    assert "(zone C)" in text
    assert "lost: 25600 samples, reconnect" in text
    assert "kL </script> has changed" in text
    html = page.read_text()
    assert html.count("</script>") == 2  # its own two
    assert not re.search(r"(src|href)=|https?://(?!www.w3.org)", html)


def test_since(folder: Path) -> None:
    whole, day, dated = read_trend(folder), read_trend(folder, "1d"), read_trend(folder, "2023-11-17T12:00:00")
    assert whole.first_ns == T0_NS
    assert day.last_ns - day.first_ns == 1440 * MINUTE_NS
    assert day.bin_ns < whole.bin_ns
    assert dated.first_ns == T0_NS + 3600 * MINUTE_NS
    assert int(day.series["estimate", "bearing1.x.kL"].count.sum()) == 721


def test_what_is_wrong_is_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trend", str(tmp_path)]) == 4
    assert "holds no trend" in capsys.readouterr().err
    assert main(["trend", str(folder), "--since", "7"]) == 2
    assert "--since 7: give a number above 0 and a unit" in capsys.readouterr().err
    assert main(["trend", str(folder), "--since", "2030-01-01"]) == 2
    assert "the trend ends at 2023-11-17" in capsys.readouterr().err


def results(folder: Path, machines: Sequence[str | None]) -> Path:
    """Tables of `batch`: for each machine a record an hour, whose kL falls."""
    folder.mkdir()
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in ("runs", "parameters", "verdicts", "severity")}
    for machine in machines:
        for hour in range(30):
            time = {"started": STARTED + timedelta(hours=hour), "from_s": 3600.0 * hour}  # a window each hour of a log
            of = {"log": "a.mcap", "rig": "r.toml", "machine": machine} | time
            rows["runs"].append(of | {"task": "fit", "status": "done"})
            own = {"value": 1e7 - 1e5 * hour, "sd": 1e4, "unit": "N/m", "identifiable": True}
            rows["parameters"].append(of | own | {"name": "bearing1.x.kL"})
            rows["severity"].append(of | {"channel": "b1x", "unit": "m/s^2", "velocity_rms_mm_s": 3.0, "zone": "C"})
            named = {"verdict": "cubic", "at": ["bearing1"], "p_archive": 1e-9, "stands": hour == 29}
            rows["verdicts"].append(of | named | {"task": "diagnose"})
            rows["verdicts"].append(of | {"task": "compare", "missing_force_percent": 2.0})
    for name, own_rows in rows.items():
        parquet.write_table(pyarrow.Table.from_pylist(own_rows, schema=schema(name)), folder / f"{name}.parquet")
    return folder


def test_results_of_an_archive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trend", str(results(tmp_path / "one", [None])), "--json", str(tmp_path / "t.json")]) == 0
    assert re.search(r"bearing1.x.kL .*-27 %", out := capsys.readouterr().out)
    assert "said: cubic\n" in out
    value = json.loads((tmp_path / "t.json").read_text())
    jsonschema.validate(value, json.loads((DOCS_FOLDER / "schemas" / "trend.json").read_text()))
    assert value["from"] == "2024-03-01T12:00:00.000000Z"
    assert value["to"] == "2024-03-02T17:00:00.000000Z"
    assert {s["kind"] for s in value["series"]} == {"estimate", "severity", "missing_force"}
    several = results(tmp_path / "two", ["press", "fan"])
    assert main(["trend", str(several)]) == 2
    assert "holds 2 machines (press, fan): say which with --machine" in capsys.readouterr().err
    assert main(["trend", str(several), "--machine", "fan"]) == 0


def test_recording(folder: Path, tmp_path: Path) -> None:
    from recordings import entities

    assert main(["trend", str(folder), "--rerun", str(tmp_path / "t.rrd"), "--quiet"]) == 0
    rows = entities(tmp_path / "t.rrd")
    stiffness = next(n for name, n in rows.items() if name.endswith("kL/bearing1.x"))
    assert stiffness > 900
    assert rows["events"] == 2


SCRIPT = """
<script>
window.requestAnimationFrame = (draw) => setTimeout(draw, 0);
const canvas = document.querySelectorAll("canvas")[0], box = canvas.getBoundingClientRect(), seen = {};
const at = (share) => ({clientX: box.left + 64 + share * (box.width - 74), clientY: box.top + 50, bubbles: true});
const send = (name, share) => canvas.dispatchEvent(new PointerEvent(name, at(share)));
const span = () => document.getElementById("span").textContent;
const pixels = () => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
const steps = [
  () => { seen.whole = span(); seen.ink = pixels().filter((v, k) => k % 4 === 3 && v > 0).length; },
  () => send("pointermove", 0.25),
  () => { seen.hover = document.querySelector(".legend").textContent; },
  () => { send("pointerdown", 0.5); send("pointermove", 0.75); send("pointerup", 0.75); },
  () => { seen.zoomed = span(); canvas.dispatchEvent(new MouseEvent("dblclick", {bubbles: true})); },
  () => { seen.again = span(); document.body.dataset.seen = JSON.stringify(seen); },
];
steps.forEach((step, k) => setTimeout(step, 100 * k));
</script></body>"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_zoom_and_hover_in_a_browser(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "t.html"
    assert main(["trend", str(folder), "--html", str(page), "--quiet"]) == 0
    page.write_text(page.read_text().replace("</body>", SCRIPT))
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command = ["chromium", *options, "--virtual-time-budget=5000", "--dump-dom", page.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    found = re.search(r'data-seen="([^"]*)"', dom)
    assert found, dom[-2000:]
    seen = json.loads(found[1].replace("&quot;", '"'))
    assert seen["ink"] > 5000
    assert seen["whole"].startswith("2023-11-15 00:00:00 to 2023-11-17 23:58")
    assert "9.7" in seen["hover"]  # MN/m, a quarter of the way from 10 to 9
    assert "±" in seen["hover"]
    assert seen["zoomed"].startswith("2023-11-16 11:5")
    assert seen["again"].split(" |")[0] == seen["whole"]
