"""Realistic records of another simulator, put to the product as a user would: python -m tests.foreign.campaign.

    python -m tests.foreign.campaign --kind complete --cases 200 --out DIR     goes on where it stopped
    python -m tests.foreign.campaign --out DIR --table                         the table of what is there, judged anew
    python -m tests.foreign.campaign --kind one --show 7                       one case whole

Kinds: complete, one (effect), two (effects), mistake (in the rig file). `judge.py` says what is right.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from .judge import HONEST, LATE, RIGHT, RULES, WRONG, judge
from .machine import Machine, sized
from .own import own_record
from .recorder import given_rate, recorded, rig_file
from .scene import KINDS, Scene, draw

ROOT = Path(__file__).parents[2]
Z95 = 1.959964


def truth_of(scene: Scene, machine: Machine, share: float | None) -> dict[str, Any]:
    """What is true of a case, for the judge and for a reader."""
    s = scene
    f0 = {p: float(np.sqrt(s.kL[p] / s.m[p[:8]]) / (2 * np.pi)) for p in s.measured}
    zeta = {p: float(s.c[p] / (2 * np.sqrt(s.kL[p] * s.m[p[:8]]))) for p in s.measured}
    disc_hz = float(np.sqrt(2 * s.ks / s.disc) / (2 * np.pi)) if s.shaft != "none" else None
    line = machine.numbers.get("bearing1.line", (None,))[0]
    return asdict(s) | {
        "f0": f0["bearing1.x"], "zeta": zeta["bearing1.x"], "f0_of": f0, "disc_hz": disc_hz, "line_hz": line,
        "stiff": s.ks / s.kL["bearing1.x"] if s.shaft != "none" else 0.0, "got_share": share, "sway": machine.sway,
        "numbers": {k: list(v) for k, v in machine.numbers.items()},
    }  # fmt: skip


def run(kind: str, seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Truth and answer of one case."""
    effects = tuple(given.only.split(",")) if given.only else ()
    scene = draw(kind, seed, given.seconds, effects)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep / f"{kind}_{seed}" if given.keep else Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        rig, log, npz = folder / "rig.toml", folder / "record.mcap", folder / "record.npz"
        rig.write_text(rig_file(scene, filters=knows_filters()))
        start_s, share = time.perf_counter(), None
        if given.simulator == "own":
            machine = Machine(own_record(scene, folder, given.timeout))
            answer: dict[str, Any] = {"status": "ok"}
        else:
            scene = sized(scene)
            machine = Machine(scene)
            moved = machine.moved()
            share = moved.share(machine)
            np.savez(npz, rate_hz=given_rate(scene), **recorded(machine, moved))  # type: ignore[arg-type]
            del moved
            answer, _ = rotorscope(given.timeout, "import", npz, "--rig", rig, "--out", log)
        made_s, start_s = time.perf_counter() - start_s, time.perf_counter()
        if answer["status"] == "ok":
            command = given.command or ("improve" if kind == "two" else "diagnose")
            answer = ask(command, log, rig, folder, given.timeout)
        seconds = time.perf_counter() - start_s
        rig_text = rig.read_text()
        if given.keep and npz.exists():
            npz.unlink()
    truth = truth_of(scene, machine, share)
    return {
        "kind": kind, "seed": seed, "what": "+".join(scene.hidden) or scene.mistake or "-", "revision": revision(),
        "made_s": round(made_s, 1), "seconds": round(seconds, 1), "truth": truth, "answer": answer, "rig": rig_text,
    }  # fmt: skip


def ask(command: str, log: Path, rig: Path, folder: Path, limit: float) -> dict[str, Any]:
    """What the product says, in the few words that the judge reads."""
    more = ["--out", folder / "better.toml"] if command == "improve" else []
    answer, found = rotorscope(limit, command, log, "--rig", rig, *more)
    if found is None:
        return answer
    bearing = found.get("bearing") or {}
    added = {"added": _added(found, rig)} if "ladder" in found else {}
    ranking = [
        {key: row.get(key) for key in ("effect", "at", "heldout_gain", "p_value", "parameters", *_percents(row))}
        for row in found.get("ranking", [])[:5]
    ]
    return answer | added | {
        "verdict": found["verdict"], "ranking": ranking, "separates": str(found.get("separates") or ""),
        "messages": found.get("messages", []), "codes": found.get("message_codes", []),
        "judged": bearing.get("judged", True), "reason": str(bearing.get("reason") or ""),
        "order": next((t.get("order") for t in (found.get("machine") or {}).get("strikes", [])), None),
        "findings": (found.get("record") or {}).get("findings", []), "machine": found.get("machine"),
        "parameters": {k: v.get("value") for k, v in found.get("parameters", {}).items()},
        "ladder": found.get("ladder"), "modes": (found.get("structure") or {}).get("modes"),
    }  # fmt: skip


def _percents(row: dict[str, Any]) -> list[str]:
    return [key for key in row if key.startswith("missing_force_")]


def _added(found: dict[str, Any], rig: Path) -> list[str]:
    base = ["cubic"] if "effects = ['cubic']" in rig.read_text() else []
    return [name for name in found["ladder"][-1]["effects"] if name not in base]


def rotorscope(limit: float, *words: object) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Status of a command with its error, and its JSON."""
    command = [sys.executable, "-m", "daq", *map(str, words), "--json", "-"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, start_new_session=True
    ) as process:
        try:
            out, error = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return {"status": "late", "error": str(words[0])}, None
    status = "ok" if process.returncode == 0 else "refused" if process.returncode == 4 else "failed"
    answer = {"status": status, "error": error.strip()[-600:]}
    if status != "ok":
        return answer, None
    try:
        return answer, json.loads(out)
    except ValueError:
        return {"status": "failed", "error": f"no JSON: {out[-200:]} {error[-300:]}"}, None


@cache
def knows_filters() -> bool:
    """Whether a rig file can give the recorder's filter."""
    _, found = rotorscope(60.0, "schema")
    return "anti_alias" in json.dumps(found)


@cache
def revision() -> str:
    """Of the product's source, "+" where it is changed."""
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+", "--exclude", "*"]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip() or "?"


def wilson(k: int, n: int) -> tuple[float, float]:
    """95 % interval of a share, by Wilson (1927), in %."""
    if not n:
        return 0.0, 100.0
    p, z2 = k / n, Z95**2 / n
    middle, half = p + z2 / 2, Z95 * np.sqrt(p * (1 - p) / n + z2 / (4 * n))
    return 100 * float(middle - half) / (1 + z2), 100 * float(middle + half) / (1 + z2)


def table(results: Iterable[dict[str, Any]]) -> str:
    """Right, honest, wrong by kind and by what is hidden, as Markdown."""
    groups: dict[str, Counter[str]] = defaultdict(Counter)
    for result in results:
        found = judge(result["truth"], result["answer"])
        parts = result["what"].split("+") if result["kind"] != "complete" else []
        keys = [f"**{result['kind']}**", *(f"{result['kind']}: {name}" for name in parts)]
        for key in keys:
            groups[key].update([found.what, *(["missed"] if found.why == "missed" else []), *found.broken])
            groups[key]["n"] += 1
    head = "kind | cases | right | honest | confidently wrong | of these missed | no answer | right, 95 % | wrong, 95 %"
    lines = [f"| {head} |", "|---" * 9 + "|"]
    for key in sorted(groups, key=lambda k: (k.strip("*").split(":")[0], not k.startswith("*"), k)):
        c = groups[key]
        spans = ["{:.0f} to {:.0f} %".format(*wilson(c[what], c["n"])) for what in (RIGHT, WRONG)]
        counts = [c["n"], c[RIGHT], c[HONEST], c[WRONG], c["missed"], c[LATE]]
        lines.append(f"| {key} | " + " | ".join(map(str, counts)) + f" | {spans[0]} | {spans[1]} |")
    broken = ((rule, sum(c[rule] for key, c in groups.items() if key.startswith("*"))) for rule in RULES)
    if found := [f"{rule} {count}" for rule, count in broken if count]:
        lines += ["", f"rules broken: {', '.join(found)}"]
    return "\n".join(lines)


def line_of(result: dict[str, Any]) -> str:
    """One case for the eye."""
    t, a, found = result["truth"], result["answer"], judge(result["truth"], result["answer"])
    disc = f"disc {t['disc_hz']:.0f} ks/kL {t['stiff']:.2g}" if t["disc_hz"] else "no shaft"
    record = f"{t['rate_hz'] / 1e3:.1f} kHz {t['seconds']:.0f} s {len(t['channels'])} ch"
    rig = f"{record} f0 {t['f0']:.0f} zeta {100 * t['zeta']:.1f} % {disc}"
    took = f"{result['made_s']:4.0f} +{result['seconds']:4.0f} s"
    said = f"{found.what:6s} {a.get('verdict', a['status']):12s} {found.why[:90]} {', '.join(found.broken)}"
    return f"{result['kind']:8s} {result['seed']:4d} {result['what']:24s} {rig:66s} {took}  {said}"


def show(result: dict[str, Any]) -> str:
    """One case whole: rig file, truth, answer."""
    found = judge(result["truth"], result["answer"])
    parts = [result["rig"], json.dumps({"truth": result["truth"], "answer": result["answer"]}, indent=1, default=float)]
    return "\n".join([*parts, line_of(result), f"{found.what}: {found.why} {found.broken}"])


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", default="complete", help=f"of {', '.join(KINDS)}; several by commas")
    parser.add_argument("--cases", type=int, default=16, help="of each kind; seeds count up from --first")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder of results.jsonl")
    parser.add_argument("--keep", type=Path, help="folder for the records")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seconds", default="10:20", help="LOW:HIGH of a record; up to 10:600")
    parser.add_argument("--timeout", type=float, default=240.0, help="s for one command of the product")
    parser.add_argument("--command", choices=["diagnose", "improve"], help="improve for two effects, else diagnose")
    parser.add_argument("--simulator", choices=["foreign", "own"], default="foreign", help="own: clean complete rigs")
    parser.add_argument("--only", default="", help="effects to hide, or the mistake, by commas")
    parser.add_argument("--show", type=int, help="seed of one case to be shown whole")
    parser.add_argument("--table", action="store_true", help="print the table only")
    given = parser.parse_args()
    low, high = given.seconds.split(":")
    given.seconds = (float(low), float(high))
    return given


def main() -> None:
    given = options()
    kinds = given.kind.split(",")
    path = given.out / "results.jsonl" if given.out else None
    done = [json.loads(line) for line in path.read_text().splitlines()] if path and path.exists() else []
    if given.show is not None:
        kept = [r for r in done if (r["kind"], r["seed"]) == (kinds[0], given.show)]
        print(show(kept[0] if kept else run(kinds[0], given.show, given)))
        return
    if path is None:
        raise SystemExit("--out DIR is missing; add it")
    if not given.table:
        if strange := {r["revision"] for r in done} - {revision()}:
            raise SystemExit(f"{path} is of revision {', '.join(strange)}, this is {revision()}: take another --out")
        known = {(r["kind"], r["seed"]) for r in done}
        seeds = range(given.first, given.first + given.cases)
        todo = [(k, seed) for k in kinds for seed in seeds if (k, seed) not in known]
        given.out.mkdir(parents=True, exist_ok=True)
        each = partial(_run_of, given=given)
        with ProcessPoolExecutor(given.workers) as pool, path.open("a") as lines:
            for result in pool.map(each, todo) if given.workers > 1 else map(each, todo):
                lines.write(json.dumps(result, default=float) + "\n")
                lines.flush()
                print(line_of(result), flush=True)
                done.append(result)
    revisions = ", ".join(sorted({r["revision"] for r in done}))
    print(f"\nrevision {revisions}, {time.strftime('%d %B %Y')}\n\n{table(done)}")


def _run_of(case: tuple[str, int], given: argparse.Namespace) -> dict[str, Any]:
    return run(*case, given)


if __name__ == "__main__":
    main()
