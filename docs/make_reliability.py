"""Makes docs/reliability.md from the suite's own output:

    pytest tests/daq tests/drivers tests/contracts -m "not bench and not guest and not root and not soak" --junitxml=report.xml
    pytest -n 0 -m soak --junitxml=soak.xml             # ten minutes
    sudo ... pytest -n 0 -m root --junitxml=root.xml    # a minute
    GUEST_XML=guest.xml tests/guest/run.sh              # five minutes
    python tests/fuzz/mass.py tally.json                # hours, in pieces if need be
    python tests/fuzz/mass.py tally.json --report fuzz.xml
    python docs/make_reliability.py report.xml soak.xml root.xml guest.xml fuzz.xml

Of a test in two reports the later one counts. With --keep, rows of tests that are in none of the reports stay as the page has them: a part can be measured anew.
A test adds a row with pytest's record_property("reliability", "fault | how it is provoked | promised | measured").
"""

from __future__ import annotations

# ruff: noqa: E501 - the lines of a table
import argparse
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

_TEST = re.compile(r"\| (`\w+::[^|]*`) \|$")

HEAD = """\
# What can go wrong, and what then happens

Each row is a test that provokes the fault for real and says what it measured; this page is made from the suite's output by
`docs/make_reliability.py`. Times are those of the machine that ran it.

| fault | how it is provoked | promised | measured | test |
|---|---|---|---|---|
"""
TAIL = """
## Overflow: who drops what

| queue | bound | when full | told by |
|---|---|---|---|
| reader to core loop | 32 MiB of readings | the oldest samples go; the reader never waits | gap `overflow` with exact indices, notice `overflow` to the operator at once, `dropped.reader` in the status, exit summary |
| core loop to estimator | 250 blocks (10 s) or 32 MiB | nothing is dropped: the core loop takes no more, and the reader's queue fills | `lag_s.estimate` in the status |
| core loop to disk | 64 MiB of readings, 16 MiB of file | the newest samples are not stored; the core loop never waits | gap `storage`, notices `log_overflow` and `log_resumed`, `dropped.LogWriter` |
| core loop to viewer | 8 MB for a live viewer, 64 MB for a file | the oldest samples are not shown | notice, `dropped.RerunSink` |

Replay, import and capture wait instead: nothing is dropped, and a fault of the disk ends them with one line and status 4.

## What lies at `--out`

A log of a live link, and any file that is no log, is never overwritten: it is kept beside the new one as `NAME-1.mcap`, and one line says
so. It gets its name back if nothing was acquired. Logs that a command can make again (of `virtual:`, `simulate`, `replay`, `import`) are
overwritten. A log that another process is writing is refused. `import`, `recover` and `export` give a file its name when it is whole: a
stop, a full disk or an error half-way leaves nothing, or what lay there before. So do `simulate` and `replay` but for a stop, after
which the log ends there, complete, with status 130.

A result (`--json`, `--html`, a rig file's `--out`) is not written over a log or a data file, nor over a rig file if it is none: the
command is refused before it begins.

## Hostile input: how far it went

The rows say how many inputs each kind was run with; ten million are wanted of each. Whole files of `npz`, `uff`,
`rig`, `mcap`, .mat, .mf4 and of the `answer` process are few, as opening one costs more than what is in it; their members, data sets,
tables, records, messages, variables and files of one channel are read by themselves too, ten million of each, and stand in
for them. Rows by atheris, which is slow where a library reads, are few as well.

On 28 November 2026, after the changes to recorded traffic, files of others and parts of logs, one million new inputs of each of `parts`,
`lvm`, `uff-sets`, `mapped`, `serial`, `can`, `slcan`, `candump`, `asc`, `messages`, `records`, `csv`, `answer-members`, `blf` and
`mat-variables` (`python tests/fuzz/mass.py TALLY.json KIND --inputs 1000000` from an empty tally): nothing broke a promise. Again the
same day, after names of codes, dates of `candump -tA` and sound heads changed, one million each of `candump`, `mapped`, `csv` and
`wav`; and one million of `mapped` after the look-ahead of devices without a counter changed.

The same evening, after the time axis, units beside samples and time stamps in tables changed, one million more of each of `mapped`, `asc`,
`slcan` and `csv`, and half a million of `mat-variables` (`python tests/fuzz/mass.py TALLY.json KIND --inputs 11000200`, which goes on
from the rows above): nothing broke a promise.

The libraries for .mat and .mf4 crash, or come to no end, on some damaged files, which is why they run in a process of their own. Variables
of a .mat (`mat-variables`) and small .mf4 files (`mf4-files`) are read with the libraries' own code, many in a request; one that kills the
process costs a new one, and those behind it are read all the same. What that process may answer is tried by itself (`answer`,
`answer-members`).

## Two hours in real time

A session of 4 channels at 6.4 kHz for 100 minutes on 28 November 2026, on a machine at load 17 to 26 (`rotorscope simulate RIG --serve
serial:socket://127.0.0.1:47311`, `rotorscope run RIG --link serial:socket://127.0.0.1:47311 --out a.mcap`; private memory of
`/proc/PID/status` each minute): 245.3 MB after 12 minutes, 245.9 MB after 101, between 226 and 246 MB meanwhile. More comes only from samples that wait
on a computer that is too busy: at most 32 MB before the core loop, 64 MB before the disk, both bounded and said as lags.

## After a crash

`rotorscope info LOG` says whether a log is complete. `rotorscope recover LOG --out LOG2` gives a complete one, every intact message bit
for bit, and says what was lost. All reading commands take a cut log as it is.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reports", nargs="+", type=Path)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    page = Path(__file__).with_name("reliability.md")
    new: dict[str, dict[str, None]] = {}  # a property test records its row for every example
    for path in options.reports:
        own: dict[str, dict[str, None]] = {}
        for test, row in rows_of(path):
            own.setdefault(test, {})[row] = None
        new |= own
    if not new:
        names = " ".join(map(str, options.reports))
        sys.exit(f"{names}: no test recorded a row; give the reports of pytest --junitxml")
    rows: dict[str, dict[str, None]] = {}
    for row in page.read_text(encoding="utf-8").splitlines() if options.keep else ():
        if found := _TEST.search(row):
            rows.setdefault(found[1], {})[row] = None
    rows |= new  # in its old place, if it had one
    lines = [row for ones in rows.values() for row in ones]
    page.write_text(HEAD + "\n".join(lines) + "\n" + TAIL, encoding="utf-8")


def rows_of(path: Path) -> Iterator[tuple[str, str]]:
    """Of a report: the test and its row."""
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        failed = case.find("failure") is not None or case.find("error") is not None
        for item in case.iter("property"):
            if item.get("name") == "reliability":
                test = f"`{case.get('classname', '').rpartition('.')[2]}::{case.get('name')}`"
                yield test, f"| {item.get('value')}{' **FAILED**' if failed else ''} | {test} |"


if __name__ == "__main__":
    main()
