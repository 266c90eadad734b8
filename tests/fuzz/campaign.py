"""Fuzz all targets one after the other:  python tests/fuzz/campaign.py REPORT.xml [--seconds S] [TARGET=INPUTS ...]

The cheap codecs go on to some millions of inputs, the others for S seconds each. The report is for
docs/make_reliability.py.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

RUN = Path(__file__).with_name("run.py")
INPUTS = {"cobs": 6_000_000, "slcan": 4_500_000}
_COUNT = re.compile(r"number_of_executed_units:\s*(\d+)")
_PEAK = re.compile(r"peak_rss_mb:\s*(\d+)")


def targets() -> list[str]:
    return subprocess.run([sys.executable, RUN], capture_output=True, text=True, check=True).stdout.split()


def fuzz(name: str, seconds: int, inputs: int | None) -> str:
    """What libFuzzer says of a run."""
    more = [] if inputs is None else ["--inputs", str(inputs)]
    command = [sys.executable, RUN, name, "--seconds", str(seconds), *more]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False).stderr


def report(said: dict[str, str], path: Path) -> int:
    """Write the report; the number of inputs in all."""
    suite, total = ElementTree.Element("testsuite"), 0
    for name, text in said.items():
        count, peak = (int(found[1]) if (found := r.search(text)) else 0 for r in (_COUNT, _PEAK))
        case = ElementTree.SubElement(suite, "testcase", classname="campaign", name=name)
        if "ERROR: libFuzzer" in text or not count:
            ElementTree.SubElement(case, "failure")
        row = f"hostile input: {name} | atheris, coverage-guided | read or refused, memory bounded, no hang, no write"
        value = f"{row} elsewhere, nothing executed | {count} inputs, at most {peak} MB"
        ElementTree.SubElement(ElementTree.SubElement(case, "properties"), "property", name="reliability", value=value)
        total += count
    ElementTree.ElementTree(suite).write(path)
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("limits", nargs="*", metavar="TARGET=INPUTS")
    parser.add_argument("--seconds", type=int, default=120)
    options = parser.parse_intermixed_args()
    limits = INPUTS | {name: int(n) for name, _, n in (text.partition("=") for text in options.limits)}
    said = {}
    for name in targets():
        limit = limits.get(name)
        said[name] = fuzz(name, 1800 if limit else options.seconds, limit)
        print(name, *_COUNT.findall(said[name]), flush=True)
    print(f"{report(said, options.report)} inputs in all")


if __name__ == "__main__":
    main()
