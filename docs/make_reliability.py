"""Makes docs/reliability.md from the suite's own output:

    pytest tests/daq tests/drivers tests/contracts -m "not bench and not guest and not soak" --junitxml=report.xml
    pytest -n 0 -m soak --junitxml=soak.xml             # ten minutes
    GUEST_XML=guest.xml tests/guest/run.sh              # five minutes
    python tests/fuzz/mass.py tally.json                # hours, in pieces if need be
    python tests/fuzz/mass.py tally.json --report fuzz.xml
    python docs/make_reliability.py report.xml soak.xml guest.xml fuzz.xml

A test adds a row with pytest's record_property("reliability", "fault | how it is provoked | promised | measured").
"""

from __future__ import annotations

# ruff: noqa: E501 - the lines of a table
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

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
| reader to core loop | 32 MiB of readings | the oldest samples go; the reader never waits | gap `overflow` with exact indices, `dropped.reader` in the status, exit summary |
| core loop to estimator | 250 blocks (10 s) or 32 MiB | nothing is dropped: the core loop takes no more, and the reader's queue fills | `lag_s.estimate` in the status |
| core loop to disk | 64 MiB of readings, 16 MiB of file | the newest samples are not stored; the core loop never waits | gap `storage`, notices `log_overflow` and `log_resumed`, `dropped.LogWriter` |
| core loop to viewer | see `daq/rerun_sink.py` | the oldest samples are not shown | notice, `dropped.RerunSink` |

Replay, import and capture wait instead: nothing is dropped, and a fault of the disk ends them with one line and status 4.

## What lies at `--out`

A log of a live link, and any file that is no log, is never overwritten: it is kept beside the new one as `NAME-1.mcap`, and one line says
so. It gets its name back if nothing was acquired. Logs that a command can make again (of `virtual:`, `simulate`, `replay`, `import`) are
overwritten. A log that another process is writing is refused. `import`, `recover` and `export` give a file its name when it is whole: a
stop, a full disk or an error half-way leaves nothing, or what lay there before. So do `simulate` and `replay` but for a stop, after
which the log ends there, complete, with status 130.

## After a crash

`rotorscope info LOG` says whether a log is complete. `rotorscope recover LOG --out LOG2` gives a complete one, every intact message bit
for bit, and says what was lost. All reading commands take a cut log as it is.
"""


def main() -> None:
    rows: dict[str, None] = {}  # a property test records its row for every example
    for case in (case for path in sys.argv[1:] for case in ElementTree.parse(path).getroot().iter("testcase")):
        failed = case.find("failure") is not None or case.find("error") is not None
        for item in case.iter("property"):
            if item.get("name") == "reliability":
                test = f"`{case.get('classname', '').rpartition('.')[2]}::{case.get('name')}`"
                measured = " **FAILED**" if failed else ""
                rows[f"| {item.get('value')}{measured} | {test} |"] = None
    if not rows:
        sys.exit(f"{' '.join(sys.argv[1:])}: no test recorded a row; give the reports of pytest --junitxml")
    Path(__file__).with_name("reliability.md").write_text(HEAD + "\n".join(rows) + "\n" + TAIL, encoding="utf-8")


if __name__ == "__main__":
    main()
