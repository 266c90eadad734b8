"""Golden results: fit, compare, diagnose and improve of twelve records.

python -m tests.golden.make                # write tests/golden/results/*.json
python -m tests.golden.make --check        # compare: verdicts equal, numbers within the tolerance of `differences`
python -m tests.golden.make --check --exact   # compare every number bit by bit: same machine, same libraries

The tests set OPENBLAS_CORETYPE=Haswell before numpy is loaded. With another kernel the text of a gate may name another
p-value.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jsonschema

from estimator import compare, diagnose, fit, improve

from .records import RECORDS, GoldenRecord

RESULTS = Path(__file__).parent / "results"
SCHEMA_FOLDER = Path(__file__).parents[1] / "data" / "schemas"
COMMANDS = {"fit": fit, "compare": compare, "diagnose": diagnose, "improve": improve}
TEXTS = {"messages", "message_codes", "notes", "region", "separates", "reason"}  # wording is free
LAYERS = {"record", "machine", "structure", "bearing"}  # of a diagnosis: each layer has its own tests
MAX_P_VALUE = 1e-3  # of a candidate in a ranking, above which rounding decides its place and its numbers
DRAWN = {"curves", "laws", "spectra", "densities", "orbits", "shape"}  # long series: in the digest alone


def answers(record: GoldenRecord, commands: Sequence[str] = tuple(COMMANDS)) -> dict[str, Any]:
    """The golden result of a record: by command the numbers, and a digest of all numbers bit by bit."""
    model, y, rate_hz = record.make()
    out: dict[str, Any] = {"samples_sha256": hashlib.sha256(y.tobytes()).hexdigest()}
    for name in commands:
        answer = json.loads(json.dumps(COMMANDS[name](model, y, rate_hz).to_json()))
        jsonschema.validate(answer, json.loads((SCHEMA_FOLDER / f"{name}.json").read_text("utf-8")))
        full = without(answer, TEXTS | LAYERS)
        digest = hashlib.sha256(json.dumps(full, sort_keys=True).encode()).hexdigest()
        out[name] = {"digest": digest, "result": without(full, DRAWN)}
    return out


def without(value: Any, keys: set[str]) -> Any:
    """A JSON value without some keys, at any depth."""
    if isinstance(value, dict):
        return {k: without(v, keys) for k, v in value.items() if k not in keys}
    return [without(v, keys) for v in value] if isinstance(value, list) else value


def differences(golden: Any, now: Any, at: str = "") -> Iterator[str]:
    """Where a result differs from the golden one by more than rounding on another machine.

    Another machine rounds the simulated samples otherwise. Values of parameters may move by 0.5 standard deviations
    (a processor without fused multiplication moves the gap of a clearance by 0.4), standard deviations by 5 %,
    percentages by 0.1, distances from the simulated twin by 5 % (it is one random record, and the last bits of a fit
    decide which), other numbers by 1 %. Candidates of a ranking without significance are left out.
    """
    if isinstance(golden, dict) and isinstance(now, dict):
        if golden.keys() != now.keys():
            yield f"{at}: keys {sorted(golden.keys() ^ now.keys())} on one side only"
            return
        sd = golden.get("sd") if isinstance(golden.get("sd"), float) else None
        for key in golden:
            if key == "value" and sd is not None and isinstance(now[key], float):
                apart = now[key] - golden[key]
                if golden.get("unit") == "rad":
                    apart = math.remainder(apart, 2.0 * math.pi)  # an angle is known up to whole turns
                if abs(apart) > 0.5 * sd:
                    yield f"{at}.{key}: {now[key]:g}, was {golden[key]:g} +- {sd:g}"
            elif key not in ("digest", "p_value", "p_equal"):
                yield from differences(golden[key], now[key], f"{at}.{key}")
    elif isinstance(golden, list) and isinstance(now, list):
        golden, now = significant(golden), significant(now)
        if len(golden) != len(now):
            yield f"{at}: {len(now)} entries, were {len(golden)}"
            return
        for i, (one, other) in enumerate(zip(golden, now, strict=True)):
            yield from differences(one, other, f"{at}[{i}]")
    elif isinstance(golden, float) and isinstance(now, float | int):
        wide = at.endswith(".sd") or "_distance" in at
        if abs(now - golden) > (0.05 if wide else 0.01) * abs(golden) + (0.1 if "percent" in at else 1e-3):
            yield f"{at}: {now:g}, was {golden:g}"
    elif golden != now:
        yield f"{at}: {now!r}, was {golden!r}"


def significant(entries: list[Any]) -> list[Any]:
    """A list without the candidates that explain nothing significantly."""
    return [e for e in entries if not isinstance(e, dict) or e.get("p_value", 0.0) <= MAX_P_VALUE]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with the stored results, write nothing")
    parser.add_argument("--exact", action="store_true", help="with --check: every number bit by bit")
    parser.add_argument("--only", default="", metavar="NAME", help="records whose name contains this")
    parser.add_argument("--skip", default="\0", metavar="NAME", help="leave out records whose name contains this")
    given = parser.parse_args()
    bad = 0
    RESULTS.mkdir(exist_ok=True)
    for record in (r for r in RECORDS if given.only in r.name and given.skip not in r.name):
        begun = time.monotonic()
        now = answers(record)
        path = RESULTS / f"{record.name}.json"
        said = "written"
        if given.check:
            golden = json.loads(path.read_text())
            moved = [name for name in COMMANDS if golden[name]["digest"] != now[name]["digest"]]
            found = [f"bits of {name}" for name in moved] if given.exact else list(differences(golden, now))
            if golden["samples_sha256"] != now["samples_sha256"] and (given.exact or found):
                found.insert(0, "the simulated samples")
            said = "equal" if not found else "DIFFERS in " + "; ".join(found[:5])
            bad += bool(found)
        else:
            path.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n")
        print(f"{record.name}: {said} ({time.monotonic() - begun:.1f} s)", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
