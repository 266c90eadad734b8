"""What counts as right, honest and confidently wrong: the one place that says it. The last figure counts most.

right
    complete: "complete". One or two effects: an effect that is hidden, at a bearing where it is, at its order (strikes)
    or frequency (line); of `improve` all that is hidden and nothing else. A mistake: `rig_file` with the right key.
honest
    "unknown", a refusal or a bearing that is not judged, unless its reason is untrue; "A or B" with the truth among
    them. Complete: the name of a surrounding that is really there. A mistake: "unknown", or a remark that names it.
wrong
    Everything else, also "complete" where something is hidden (told apart as "missed"), and a shaft or a mass that is
    blamed though it is right. An error that is no refusal is wrong, too.
late
    No answer within the time allowed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

RIGHT, HONEST, WRONG, LATE = "right", "honest", "wrong", "late"
ORDER_TOLERANCE = 0.02  # relative, of the order of strikes that are there, slip included: that of the real records
SPEED_TOLERANCE = 0.01  # relative: the speed wanders by up to as much
LINE_TOLERANCE_HZ = 0.5
RULES = ("over 100 %", "named at 0.00 %", "more than ten notes", "a warning")  # that no answer may break
BLAMED = ("shaft_differs", "rig_file")  # codes of remarks that blame the rig file
KEYS = {  # what an answer must name for each mistake: a key of the parameters, or channels
    "cap_mass": r"mass\.bearing1", "disc_mass": r"mass\.disc", "shaft_spring": r"shaft_spring", "speed": r"speed_rpm",
    "rate": r"rate_hz", "swapped": r"swap.*b(1y|2x)|b(1y|2x).*swap",
    "inverted": r"(polarity|inver|sign).*b[12]x|b[12]x.*(polarity|inver|sign)",  # one beside the other
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judgement:
    """Class and why. broken : rules of the specification that the answer breaks whatever its class."""

    what: str
    why: str
    broken: tuple[str, ...] = ()


def judge(truth: dict[str, Any], answer: dict[str, Any]) -> Judgement:
    """Class of an answer. truth : see `campaign.truth_of`; answer : see `campaign.ask`."""
    if answer["status"] == "late":
        return Judgement(LATE, "no answer in time")
    if answer["status"] == "failed":
        return Judgement(WRONG, f"failed: {answer['error'][-120:]}")
    if answer["status"] == "refused":
        false = _untrue(answer["error"], truth)
        return Judgement(WRONG if false else HONEST, f"refused{false}: {answer['error'][-160:]}")
    what, why = _verdict(truth, answer)
    return Judgement(what, why, _broken(answer))


def _verdict(truth: dict[str, Any], answer: dict[str, Any]) -> tuple[str, str]:
    verdict, hidden, mistake = answer["verdict"], truth["hidden"], truth["mistake"]
    blamed = [c for c in answer["codes"] if c in BLAMED]
    if verdict == "rig_file" or blamed and not mistake:
        named = verdict == "rig_file" and mistake and re.search(KEYS[mistake], _key_text(answer))
        return (RIGHT, "the mistake is named") if named else (WRONG, f"blames {_key_text(answer) or blamed}")
    if mistake:
        if verdict in ("unknown", "complete") and _remarked(mistake, answer, truth):
            return HONEST, f"{verdict}, and a remark names the mistake"
        return _without(verdict, answer, truth)
    if "added" in answer:
        return _improved(truth, answer)
    if not hidden:
        if verdict == "complete":
            return RIGHT, "complete"
        if _surrounding(verdict, answer, truth):
            return HONEST, f"{verdict} is there"
        return _without(verdict, answer, truth)
    if verdict in hidden:
        off = _off(verdict, answer, truth)
        return (WRONG, f"{verdict} {off}") if off else (RIGHT, f"{verdict} named")
    rivals = [name for name in hidden if re.search(rf"\bor {name}\b|\b{name} or\b", answer["separates"])]
    if rivals:
        return HONEST, f"{verdict} or {rivals[0]}"
    return _without(verdict, answer, truth)


def _without(verdict: str, answer: dict[str, Any], truth: dict[str, Any]) -> tuple[str, str]:
    """Of an answer that names nothing of what is hidden."""
    if verdict == "unknown":
        false = _untrue(answer["reason"], truth)
        return (WRONG if false else HONEST), f"unknown{false}{': ' + answer['reason'] if answer['reason'] else ''}"
    return (WRONG, "missed") if verdict == "complete" else (WRONG, f"{verdict} named")


def _improved(truth: dict[str, Any], answer: dict[str, Any]) -> tuple[str, str]:
    """Of what `improve` added, and how it ended."""
    hidden, added = {*truth["hidden"]}, {*answer["added"]}
    if extra := sorted(added - hidden):
        real = not hidden and all(_surrounding(name, answer, truth) for name in extra)
        return (HONEST if real else WRONG), f"added {', '.join(extra)}"
    if added == hidden:
        return RIGHT, f"added {', '.join(sorted(added)) or 'nothing'}"
    return _without(answer["verdict"], answer, truth)


def _off(name: str, answer: dict[str, Any], truth: dict[str, Any]) -> str:
    """What is wrong with an effect that is hidden and named; "" for nothing."""
    best = next((r for r in answer["ranking"] if r["effect"] == name), None)
    if best is None:
        return ""
    where = truth["hidden"][name]
    if where == "bearing1" and best["at"] and not any("bearing1" in at or at == "disc" for at in best["at"]):
        return f"at {best['at']}, not at bearing1"
    values = {key.rsplit(".", 1)[-1]: p.get("value") for key, p in (best["parameters"] or {}).items()}
    if name == "local_defect":
        order = values.get("order") or answer["order"]
        wanted = truth["strikes"]["order"]
        if order is None or abs(order / wanted - 1) > ORDER_TOLERANCE:
            return f"of order {order}, not {wanted:.4f}"
    if name == "line":
        found = [p.get("value") or 0.0 for key, p in best["parameters"].items() if key.endswith("frequency")]
        if not any(abs(hz - truth["line_hz"]) < LINE_TOLERANCE_HZ for hz in found):
            return f"at {found} Hz, not {truth['line_hz']:.2f}"
    return ""


def _surrounding(name: str, answer: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether a verdict names what is really around the rotor."""
    there = truth["around"]
    if name == "line":
        best = next((r for r in answer["ranking"] if r["effect"] == name), {"parameters": {}})
        found = [p["value"] for key, p in best["parameters"].items() if key.endswith("frequency") and p.get("value")]
        turn = truth["rpm"] / 60
        known = {hz: LINE_TOLERANCE_HZ for hz, _ in there["hum"]}
        known |= {k * turn: max(LINE_TOLERANCE_HZ, 2 * there["wander"] * k * turn) for k in (1, 2)}
        return all(any(abs(hz - f) < width for f, width in known.items()) for hz in found)
    coloured = any(zero != pole for zero, pole in there["colour"].values())
    in_band = there["mount"][0] < 2 * truth["band"][1]
    other = {"pedestal": True, "coloured_excitation": coloured, "sensor_noise": True, "sensor_resonance": in_band}
    return bool(other.get(name, False))  # every shaft has some 1 x and 2 x: imbalance would be a false alarm


def _untrue(reason: str, truth: dict[str, Any]) -> str:
    """ " untruly" where the reason of a refusal is not so; a reason that is not known here is taken for true."""
    low, high = truth["band"]
    untrue = {
        "no resonance": low < truth["f0"] < high and truth["zeta"] < 0.1,
        "clip": "sensor_clipping" not in truth["hidden"],
        "too short": truth["seconds"] * truth["f0"] * truth["zeta"] > 100,
        "mass is unknown": truth["masses_known"],
    }
    return next((f" untruly ({word})" for word, so in untrue.items() if word in reason and so), "")


def _key_text(answer: dict[str, Any]) -> str:
    first = next((r for r in answer["ranking"] if r["effect"] == "rig_file"), {"parameters": {}})
    return " ".join([*(first["parameters"] or {}), *(answer["parameters"] or {}), *answer["messages"][:3]])


def _remarked(mistake: str, answer: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether a remark beside the verdict names the mistake: for a speed with the true one."""
    if mistake == "speed":
        speed = ((answer.get("machine") or {}).get("speed_rpm") or {}).get("value") or 0.0
        return "speed_contradicted" in answer["codes"] and abs(speed / truth["rpm"] - 1) < SPEED_TOLERANCE
    return bool(re.search(KEYS[mistake], " | ".join([*answer["messages"], _findings(answer)])))


def _findings(answer: dict[str, Any]) -> str:
    return " ".join(f"{f['code']} {f['channels']} {f['text']}" for f in answer["findings"])


def _broken(answer: dict[str, Any]) -> tuple[str, ...]:
    """Rules that hold for every answer."""
    first, out = (answer["ranking"] or [{}])[0], []
    percents = [first.get(f"missing_force_{when}_percent") for when in ("before", "after")]
    if any(p is not None and p > 100 for p in percents):
        out.append(RULES[0])
    named = answer["verdict"] not in ("complete", "unknown", "rig_file")
    if named and first.get("effect") == answer["verdict"] and percents[0] is not None and percents[0] < 0.005:
        out.append(RULES[1])
    if len(answer["messages"]) > 10:
        out.append(RULES[2])
    if "Warning" in answer["error"]:
        out.append(RULES[3])
    return tuple(out)
