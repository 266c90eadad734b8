"""Makes the pictures of the documentation: `python docs/make_pictures.py [rerun] [log] [foxglove] [comparison]
[report]`.

rerun.png : the live view, of a session run through the real chain (simulated device, CAN FD frames on a virtual bus,
core loop, estimator, naming, Rerun sink), with an effect that the model lacks and one gap provoked. log.png :
a log as Rerun shows it by itself. foxglove.png : a log in Foxglove. comparison.png and report.png : made by
`rotorscope demo`. Needs xvfb-run and a Vulkan driver for Rerun (Debian: xvfb, xauth, mesa-vulkan-drivers,
libxkbcommon-x11-0, libx11-xcb1, libxcursor1, libxi6, libxrandr2), chromium for report and Foxglove, npm for Foxglove.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

DOCS = Path(__file__).resolve().parent
RIG = DOCS.parent / "daq" / "commands" / "demo_rig.toml"
SIZE = (1600, 1000)
SECONDS = 24.0


def main(wanted: list[str]) -> int:
    makers = {"rerun": rerun, "log": log, "foxglove": foxglove, "comparison": comparison, "report": report}
    unknown = [name for name in wanted if name not in makers]
    if unknown:
        sys.stderr.write(f"no picture {', '.join(unknown)}; there are {', '.join(makers)}\n")
        return 2
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted or list(makers):
            out = makers[name](Path(folder))
            sys.stdout.write(f"{out.relative_to(DOCS.parent)}: {out.stat().st_size / 1e3:.0f} kB\n")
    return 0


def rerun(folder: Path) -> Path:
    """The live view at the end of a session."""
    from daq.commands.demo import truth_text
    from daq.report.rerun.sink import RerunSink
    from daq.rig.rig import Rig, load_rig
    from daq.session.acquire import acquire_from
    from daq.session.naming import Naming
    from daq.session.simulation import machine
    from drivers.contract.link_config import VirtualConfig
    from drivers.links.links import make_driver
    from drivers.protocol.faults import Fault

    rig = load_rig(RIG)
    lost = Fault("drop", at=round(0.7 * SECONDS * 25600 / 7), count=900)  # frames of seven samples: a quarter second
    truth = Rig.parse(truth_text(rig))
    device = machine(rig, truth=truth, seed=3, seconds=SECONDS, config={"faults": (lost,), "clock_ppm": 35.0}).device
    recording = folder / "session.rrd"
    driver = make_driver(VirtualConfig(), device=device)
    sinks = [RerunSink(str(recording)), Naming(rig, live=False)]
    acquire_from(rig, driver, sinks, SECONDS, metadata={"command": "docs/make_pictures.py"})
    return screenshot(recording, DOCS / "rerun.png")


def comparison(folder: Path) -> Path:
    """The comparison in Rerun, from the demo."""
    return screenshot(demo(folder, ".rrd", "comparison"), DOCS / "comparison.png")


def report(folder: Path) -> Path:
    """The top of the demo's report page."""
    page = demo(folder, ".html", "")
    out = DOCS / "report.png"
    run([*browser(), "--window-size=1150,1530", f"--screenshot={out}", page.as_uri()])
    return out


def browser() -> list[str]:
    """Command line of a browser without a screen."""
    found = shutil.which("chromium") or shutil.which("google-chrome") or "chromium"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--disable-background-networking"]
    return [found, *options]


def demo(folder: Path, ending: str, word: str) -> Path:
    """The file of that kind that the demo writes."""
    out = folder / "demo"
    if not out.exists():
        run([sys.executable, "-m", "daq", "demo", "--quiet", "--out", str(out)])
    return next(p for p in sorted(out.iterdir()) if p.suffix == ending and word in p.name)


def log(folder: Path) -> Path:
    """A log as it is, in Rerun without a layout of ours."""
    file = folder / "day1.mcap"
    given = [str(RIG), "--out", str(file), "--seconds", "20", "--speed", "max", "--quiet"]
    run([sys.executable, "-m", "daq", "simulate", *given])
    return screenshot(file, DOCS / "log.png")


def foxglove(folder: Path) -> Path:
    """The log of a session in Foxglove."""
    from make_foxglove import picture

    file = folder / "live.mcap"
    given = [str(RIG), "--link", "virtual:", "--seconds", "15", "--out", str(file), "--quiet"]
    run([sys.executable, "-m", "daq", "run", *given])
    out = picture(file, folder / "foxglove", browser(), DOCS / "foxglove.png")
    smaller(out)
    return out


def screenshot(recording: Path, out: Path) -> Path:
    """A picture of a recording in Rerun's own viewer, on a screen in memory."""
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise SystemExit("rerun-sdk is not installed")
    viewer = Path(package.origin).with_name("rerun")  # not the script: a kill would leave its child
    width, height = SIZE
    screen = ["xvfb-run", "-a", "-s", f"-screen 0 {5 * width}x{5 * height}x24"]  # the pointer stays outside the window
    options = ["--renderer=vulkan", "--window-size", f"{width}x{height}", "--bind", "127.0.0.1", "--port", "auto"]
    run([*screen, str(viewer), *options, "--screenshot-to", str(out), str(recording)])
    smaller(out)
    return out


def smaller(out: Path) -> None:
    """Write a picture again with 255 colours, which is smaller."""
    from PIL import Image

    with Image.open(out) as picture:
        picture.convert("RGB").quantize(255, dither=Image.Dither.NONE).save(out, optimize=True)


def run(command: list[str]) -> None:
    """Run it; what it says is shown only if it fails."""
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        check=False,
        env=dict(os.environ),
    )
    if done.returncode:
        raise SystemExit(f"{command[0]} ended with status {done.returncode}:\n{done.stdout[-2000:]}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
