"""A log in Foxglove, for make_pictures.py: Foxglove Studio 1.48 as npm has it, in Chromium without a screen.

1.48 (2023) is the last version that is open and on npm. npm brings it with React (240 MB, into a folder that goes
again); the page is foxglove.html.
"""

from __future__ import annotations

import io
import json
import re
import subprocess
import threading
import time
from datetime import UTC, datetime
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO

NPM_PACKAGES = ("@foxglove/studio-base@1.48.0", "react@17.0.2", "react-dom@17.0.2")
LOADED_S = 20.0  # until the plots have all of the log
BEFORE_END_S = 0.2  # where the player stands
PREVIEW_PATHS = ("/preview/b1x.data[0]", "/preview/b2x.data[0]")
ESTIMATE_PATHS = ("/estimates.bearing1.x.kL", "/estimates.bearing2.x.kL")


def plot(paths: tuple[str, ...]) -> dict[str, Any]:
    """Settings of a Foxglove plot of some message paths against time."""
    series = [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths]
    axes = {"showXAxisLabels": True, "showYAxisLabels": True, "xAxisVal": "timestamp", "isSynced": True}
    return {"paths": series, "showLegend": True, "legendDisplay": "top", "sidebarDimension": 90, **axes}


def split(direction: str, first: Any, second: Any, percent: float = 50.0) -> dict[str, Any]:
    """Two panels of a Foxglove layout side by side ("row") or one above the other; percent : of the first."""
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percent}


PANEL_LAYOUT = {
    "configById": {
        "Plot!1": plot(PREVIEW_PATHS),
        "Plot!2": plot(ESTIMATE_PATHS),
        "RosOut!3": {"topicToRender": "/log", "searchTerms": [], "minLogLevel": 1},
        "RawMessages!4": {"topicPath": "/estimate", "diffEnabled": False},
    },
    "globalVariables": {},
    "userNodes": {},
    "playbackConfig": {"speed": 1},
    "layout": split(
        "row", split("column", "Plot!1", "Plot!2"), split("column", "RosOut!3", "RawMessages!4"), 65.0
    ),
}  # fmt: skip


class Page(SimpleHTTPRequestHandler):
    """A server of the files of a folder, also in parts, as Foxglove reads a log; /wait answers after `LOADED_S`."""

    def log_message(self, *_: Any) -> None:
        """Nothing."""

    def send_head(self) -> Any:
        if self.path == "/wait":
            time.sleep(LOADED_S)
        part, path = re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")), Path(self.translate_path(self.path))
        if part is None or not path.is_file():
            return super().send_head()
        size = path.stat().st_size
        first, last = int(part[1]), min(int(part[2] or size), size - 1)
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        self.send_header("Content-Length", str(last - first + 1))
        self.end_headers()
        with path.open("rb") as file:
            file.seek(first)
            body: BinaryIO = io.BytesIO(file.read(last - first + 1))
        return body

    def end_headers(self) -> None:
        self.send_header("Accept-Ranges", "bytes")
        super().end_headers()


def prepare(log: Path, folder: Path) -> None:
    """The application, the page, the log and what is to be seen of it, in a folder."""
    from mcap.reader import make_reader

    install = ["npm", "install", "--silent", "--no-audit", "--no-fund", *NPM_PACKAGES]
    (folder / "package.json").write_text("{}")
    subprocess.run(install, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    (folder / "index.html").write_bytes(Path(__file__).with_name("foxglove.html").read_bytes())
    (folder / log.name).write_bytes(log.read_bytes())
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    end_ns = summary.statistics.message_end_time if summary and summary.statistics else 0
    at = datetime.fromtimestamp(end_ns / 1e9 - BEFORE_END_S, UTC).isoformat(timespec="milliseconds")
    view = {"log": log.name, "time": at.replace("+00:00", "Z"), "layout": PANEL_LAYOUT}
    (folder / "view.json").write_text(json.dumps(view))


def picture(log: Path, folder: Path, browser: list[str], out: Path) -> Path:
    """Foxglove with the log open, as the browser shows it."""
    folder.mkdir()
    prepare(log, folder)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Page, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        page = f"http://127.0.0.1:{server.server_address[1]}/index.html"
        options = ["--window-size=1280,860", "--timeout=120000", f"--screenshot={out}", page]
        subprocess.run([*browser, *options], check=True, capture_output=True, timeout=240)
    finally:
        server.shutdown()
        server.server_close()
    return out
