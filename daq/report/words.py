"""The report in plain language: findings, their certainty, and the next steps."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from estimator.results import NOT_CONCLUSIVE, NOT_JUDGED, RIG_FILE

from .numbers import number, odds, parameter, percent

Json = Mapping[str, Any]
AS_GOOD = 1e-4  # nats per sample


def message_text(result: Json, codes: Collection[str]) -> str:
    """The first message of a result that has one of some codes; "" without one."""
    messages = zip(result.get("message_codes", ()), result.get("messages", ()), strict=False)
    return next((text for code, text in messages if code in codes), "")


def summary(comparison: Json | None, diagnoses: Sequence[Json], ladder: Sequence[Json]) -> list[str]:
    """Two to six sentences, the most important first. diagnoses : of the models of the ladder, in order."""
    said: list[str] = []
    if len(ladder) > 1:
        first, last = ladder[0]["missing_force_percent"]["value"], ladder[-1]["missing_force_percent"]["value"]
        added = [e for e in ladder[-1]["effects"] if e not in ladder[0]["effects"]]
        if percent(first) == percent(last):
            said.append(f"Adding {listed(added)} explains tones, which the fit leaves out.")
        else:
            said.append(
                f"Adding {listed(added)} to the model brings the missing force down from {percent(first)} to "
                f"{percent(last)} of the bearing force, on data that no model was fitted to."
            )
    elif len(ladder) == 1:
        said.append("Nothing was added: the model stays as it is.")
    if comparison is not None:
        said += about_comparison(comparison)
    for step, diagnosis in enumerate(diagnoses):
        said += about_diagnosis(diagnosis, past=step + 1 < len(ladder))
    return said


def regions(before: Json | None, now: Json | None) -> list[tuple[str, Json]]:
    """Rows of the map with the name of their model, largest share first; of each the most important."""
    out: list[tuple[str, Json]] = []
    for name, comparison in (("before", before), ("this model", now)):
        rows = sorted(comparison["where"], key=lambda r: -r["share_percent"]) if comparison else []
        out += [(name, r) for r in rows if r["share_percent"] >= 0.5][:12]
    return out


def heading_of_map(comparison: Json | None) -> str:
    """Heading of the residual map; it calls the model inadequate only if it is judged so."""
    if comparison is None or comparison["adequate"] or message_text(comparison, {NOT_JUDGED, NOT_CONCLUSIVE}):
        return "What the model leaves over"
    return "Where the model fails"


def about_comparison(comparison: Json) -> list[str]:
    missing = comparison["missing_force_percent"]
    span = f"{percent(missing['value'])} (95 % interval {percent(missing['low'])} to {percent(missing['high'])})"
    if text := message_text(comparison, {NOT_JUDGED, NOT_CONCLUSIVE}):
        said = [f"{text[0].upper()}{text[1:]}."]
    elif comparison["adequate"]:
        said = [f"The model explains this record: the missing force is {span} of the bearing force."]
    else:
        said = [
            f"Something acts on the bearings that the model does not contain: {span} of the bearing force can still "
            "be predicted from the motion, which a complete model would leave at zero."
        ]
        top = max(comparison["where"], key=lambda w: w["share_percent"], default=None)
        if top is not None:
            said.append(
                f"It shows most clearly in {top['channel']} against {top['against'].replace('_', ' ')} "
                f"({top['region']}, {percent(top['share_percent'])} of the missing force)."
            )
    left = comparison["heldout_nll"] - comparison["reference_nll"]
    if abs(left) < AS_GOOD:
        said.append("It predicts the held-out data as well as a flexible black box does: nothing is left to win.")
    elif left > 0:
        said.append(
            f"A flexible black box predicts the same held-out data {number(left, 2)} nats per sample better than the "
            "model: that is what is left to win."
        )
    return said


def about_diagnosis(diagnosis: Json, past: bool = False) -> list[str]:
    verdict, rows = diagnosis["verdict"], diagnosis["ranking"]
    if verdict == "complete":
        return ["Diagnosis: complete. No effect of the catalogue improves the prediction by more than chance would."]
    if text := message_text(diagnosis, {RIG_FILE}):
        return [f"Diagnosis: a mistake in the rig file. {text[0].upper()}{text[1:]}."]
    if verdict == "unknown":
        from estimator.diagnosis.verdict import NO_LAW_CODES

        if text := message_text(diagnosis, {NOT_JUDGED, NOT_CONCLUSIVE}):
            return [f"Diagnosis: unknown. {text[0].upper()}{text[1:]}."]
        if laid := message_text(diagnosis, NO_LAW_CODES):
            return [f"Diagnosis: unknown. A force is missing that is not a law of a bearing: {laid}."]
        near = f" The nearest are {listed([r['effect'] for r in rows[:3]])}." if rows else ""
        return [
            "Diagnosis: unknown. A force is missing, but no effect of the catalogue explains it; its shape is drawn "
            "below, and a law of your own can be typed into the rig file and tested." + near
        ]
    best = next((r for r in rows if r["effect"] == verdict), None)
    if best is None:
        return [f"Diagnosis: {verdict}."]
    before, after = best["missing_force_before_percent"], best["missing_force_after_percent"]
    where, p = listed(best["at"]), odds(best["p_value"])
    seen = f"{'was' if past else 'is'} missing" if is_of_the_model(diagnosis) else "is found in the signal"
    text = f"Diagnosis: {verdict} at {where} {seen} (p {p})."
    if after < before:
        fall = f"{'fell' if past else 'falls'} from {percent(before)} to {percent(after)}"
        text += f" With it the missing force there {fall}."
    said = [text]
    second = runner_up(diagnosis)
    if second is not None:
        said.append(f"The runner-up is {second['effect']} at {listed(second['at'])}.")
    return said


def is_of_the_model(diagnosis: Json) -> bool:
    """Whether the verdict is about the model of the bearings, and not about channels and spectra."""
    judged = diagnosis.get("bearing", {}).get("judged", True)
    best = next((r for r in diagnosis["ranking"] if r["effect"] == diagnosis["verdict"]), None)
    return bool(judged and (best is None or best["missing_force_before_percent"]))


def runner_up(diagnosis: Json) -> Json | None:
    """The best-ranked effect other than the verdict."""
    return next((r for r in diagnosis["ranking"] if r["effect"] != diagnosis["verdict"]), None)


def listed(names: Sequence[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else "nothing"


def detectable(row: Json) -> str:
    """The weakest strength of the effect that this record would show."""
    limit = row.get("detectable_from")
    return parameter({"value": limit["value"], "unit": limit["unit"]}, digits=2) if limit else ""
