"""The bodies of fit, compare, diagnose, improve, theory and reproduce."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.table import Table
from rich.text import Text

from estimator.effects import CATALOGUE, MORE_LINES
from estimator.results import NOT_JUDGED, Fit, Parameter, shared

if TYPE_CHECKING:
    from estimator.diagnosis.verdict import Improvement

from daq.base.console.ahead import loaded
from daq.base.console.memory import keep_freed
from daq.base.console.output import Output, spare, write_whole
from daq.base.console.tables import ladder_table, number, parameters_table
from daq.base.contract.errors import ConfigError, LogError
from daq.exchange.measurement import Measurement, measure
from daq.report.words import message_text
from daq.rig.edit import with_effect, with_values
from daq.rig.rig import Rig, load_rig

MIN_MISSING_SHARE = 1e-4  # of the samples missing: it may be that which leaves too few stretches
IN_USE = ("scipy.optimize", "scipy.ndimage")  # of every comparison
_OUTSIDE_CATALOGUE = "the catalogue does not hold; type a law of your own into the rig file"
_NO_LAW = "is not a law of a bearing: see the notes, and correct what they name first"
BELOW_DETECTION = (
    'an effect weaker than "detectable from" cannot be seen in a record of this length and level; a record four times '
    "as long halves the limit"
)
Method = Literal["spectral", "fokker-planck", "score-matching", "volterra"]
NOT_ADEQUATE = "the model is not adequate: rotorscope diagnose says what is missing"


def fit(output: Output, log: Path, rig_path: Path, method: Method, out: Path | None) -> None:
    if out is not None:
        spare(out)
    rig, data = given(output, log, rig_path)
    with output.progress(f"fitting ({method})"), about(log, data):
        result = fitted(rig, data, method)
    if out is not None:
        write_whole(out, with_values(with_lines(rig, result.parameters), result.parameters))
    people: list[Any] = [parameters_table(result.parameters), ""]
    people += [value.sentence(name) for name, value in shared(result.parameters).items()]
    people += [f"note: {message.text}" for message in result.messages]
    people.append(f"{result.samples} samples, method {result.method}" + _likelihood(result))
    if out is not None:
        people.append(f"{out}: the rig file with the fitted values")
    output.result(result.to_json(), *people)


def with_lines(rig: Rig, parameters: Mapping[str, Parameter]) -> Rig:
    """The rig with the further lines that a fit found for one without a frequency, where it found them."""
    for name in MORE_LINES:
        there = dict.fromkeys(full.rsplit(".", 2)[0] for full in parameters if full.split(".")[-2] == name)
        known = next((u.at for u in rig.model.effects if u.name == name), ())
        if new := [place for place in there if place not in known]:
            rig = Rig.parse(with_effect(rig, name, new), rig.base, rig.path)
    return rig


def given(output: Output, log: Path, rig_path: Path, needed: Sequence[str] = ()) -> tuple[Rig, Measurement]:
    """Model and measurement of a command, checked. needed : modules to load while the log is read; to be
    imported after it."""
    from .check import check_laws

    keep_freed()
    rig = load_rig(rig_path)
    check_laws(rig, rig_path)
    loaded(needed)
    return rig, measure(log, rig, output.note)


@contextmanager
def about(log: Path, data: Measurement) -> Iterator[None]:
    """Say which record it is that cannot answer."""
    from estimator.errors import DataError

    try:
        yield
    except DataError as problem:
        holes = float(np.mean(np.isnan(data.y).any(axis=1)))
        why = f" ({100 * holes:.2g} % of it is missing or at full scale: mend the link, or use a larger range)"
        raise LogError(f"{log}: {problem}{why if holes > MIN_MISSING_SHARE else ''}") from problem


def fitted(rig: Rig, data: Measurement, method: Method) -> Fit:
    """The fit of a record by the method's name."""
    import estimator

    return estimator.fit(rig.model, data.y, data.rate_hz, method=method)


def _likelihood(result: Fit) -> str:
    return "" if result.log_likelihood is None else f", log-likelihood {result.log_likelihood:.6g}"


def compare(output: Output, log: Path, rig_path: Path, html: Path | None, rerun: str | None) -> None:
    pages = Pages(html, rerun)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.comparison.comparison", *IN_USE))
    with about(log, data):
        value = _compared(output, rig, data)
    pages.write(rig, data, comparison=value)
    output.result(value, *comparison_text(value), *pages.said())


def _compared(output: Output, rig: Rig, data: Measurement) -> dict[str, Any]:
    from estimator.diagnosis.comparison import compare as compare_model

    with output.progress("comparing") as progress:
        return compare_model(rig.model, data.y, data.rate_hz, progress=progress).to_json()


def comparison_text(value: Mapping[str, Any]) -> list[Any]:
    """A comparison for people."""
    missing = value["missing_force_percent"]
    interval = f"{missing['low']:.2f} to {missing['high']:.2f}"
    left = value["heldout_nll"] - value["reference_nll"]
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("channel", "fails against", "region", "share [%]"):
        table.add_column(Text(heading), justify="right" if heading.endswith("[%]") else "left")
    for row in value["where"]:
        cells = (row["channel"], row["against"].replace("_", " "), row["region"], f"{row['share_percent']:.0f}")
        table.add_row(*(Text(c) for c in cells))
    people: list[Any] = [table, ""] if value["where"] else []
    people.append(f"missing force: {missing['value']:.2f} % of the bearing force ({interval})")
    people.append(
        f"held-out error: {value['heldout_nll']:.5f} nats per sample; black box {value['reference_nll']:.5f}, "
        f"so {max(left, 0.0):.5f} at most are left to win"
    )
    for name, text in (("psd_distance_db", "spectra differ by [dB]"), ("pdf_distance", "densities differ by"),
                       ("simulation_rmse", "free-run simulation error")):  # fmt: skip
        if value.get(name):
            people.append(f"{text}: " + ", ".join(f"{c} {number(d)}" for c, d in value[name].items()))
    people += [f"note: {message}" for message in value.get("messages", ())]
    if not message_text(value, {NOT_JUDGED}):  # a note above
        people.append("the model is adequate" if value["adequate"] else NOT_ADEQUATE)
    return people


def diagnose(output: Output, log: Path, rig_path: Path, html: Path | None, rerun: str | None) -> None:
    pages = Pages(html, rerun)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.verdict", *IN_USE))
    from estimator.diagnosis.verdict import diagnose as diagnose_model

    with output.progress("diagnosing") as progress, about(log, data):
        value = diagnose_model(rig.model, data.y, data.rate_hz, progress=progress).to_json()
    if pages:
        now = _compared(output, rig, data)
        better = with_verdict(rig, value)
        if better is None:
            pages.write(rig, data, comparison=now, diagnoses=[value])
        else:
            after = _compared(output, better, data)
            ladder = [step(rig, now), step(better, after)]
            pages.write(better, data, comparison=after, before=now, diagnoses=[value], ladder=ladder)
    output.result(value, *diagnosis_text(value), *pages.said())


def with_verdict(rig: Rig, diagnosis: Mapping[str, Any]) -> Rig | None:
    """The rig with the effect that a diagnosis names, as found; None if it names none."""
    row = next((r for r in diagnosis["ranking"] if r["effect"] == diagnosis["verdict"]), None)
    if row is None:
        return None
    values: dict[str, dict[str, dict[str, float]]] = {}  # by effect (of several lines each is one), by place
    for full, p in row["parameters"].items():
        if p["value"] is not None:
            place, effect, parameter = full.rsplit(".", 2)
            values.setdefault(effect, {}).setdefault(place, {})[parameter] = p["value"]
    try:
        for effect, own in (values or {row["effect"]: {}}).items():
            known = next((u.at for u in rig.model.effects if u.name == effect), ())
            new = [place for place in own if place not in known]
            text = with_effect(rig, effect, new or row["at"], {p: own[p] for p in new})
            rig = Rig.parse(text, rig.base, rig.path)
    except ConfigError:  # there already, and named again for another reason
        return None
    return rig


def step(rig: Rig, comparison: Mapping[str, Any]) -> dict[str, Any]:
    """The rung of a ladder that a comparison makes."""
    keys = ("heldout_nll", "missing_force_percent")
    return {"effects": [use.name for use in rig.model.effects]} | {k: comparison[k] for k in keys}


def diagnosis_text(value: Mapping[str, Any], most: int = 8) -> list[Any]:
    """A diagnosis for people."""
    from estimator.diagnosis.verdict import NO_LAW_CODES

    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("effect", "at", "held-out gain", "p-value", "missing there [%]", "parameters", "detectable from"):
        table.add_column(Text(heading), overflow="fold")
    for row in value["ranking"][:most]:
        before, after = row["missing_force_before_percent"], row["missing_force_after_percent"]
        parameters = ", ".join(
            f"{k} {number(p['value'], p['sd'])} {p['unit']}" for k, p in row["parameters"].items() if p["identifiable"]
        )
        seen = row.get("detectable_from")
        limit = f"{number(seen['value'])} {seen['unit']}" if seen else ""
        cells = (row["effect"], ", ".join(row["at"]), f"{row['heldout_gain']:.5g}", _p(row["p_value"]),
                 f"{before:.2f} -> {after:.2f}", parameters, limit)  # fmt: skip
        table.add_row(*(Text(c) for c in cells))
    people: list[Any] = [table, ""] if value["ranking"] else []
    people += [f"note: {message}" for message in value.get("messages", ())]
    if value["verdict"] == "complete" and any("detectable_from" in row for row in value["ranking"]):
        people.append(BELOW_DETECTION)
    if value["verdict"] == "unknown" and value.get("shape"):
        shape = value["shape"]
        peak = max(map(abs, shape["force"]), default=0.0)
        where = f" at {shape['channel']}" if "channel" in shape else ""
        people.append(f"what is missing depends on {shape['against']}{where}, up to {peak:.3g} N; --html draws it")
    name = value["verdict"]
    known = f"rotorscope effects {name} says what to look at" if name in CATALOGUE else "rotorscope add puts it in"
    verdict = {
        "complete": "the model is complete: nothing in the catalogue earns its place",
        "unknown": f"something is missing that {_NO_LAW if message_text(value, NO_LAW_CODES) else _OUTSIDE_CATALOGUE}",
    }.get(name, f"missing: {name}; {known}")
    return [*people, f"verdict: {name}", message_text(value, {NOT_JUDGED}) or verdict]


def _p(value: float) -> str:
    """Beyond 1e-20 the figures mean nothing."""
    return "< 1e-20" if value < 1e-20 else f"{value:.2g}"


def improve(output: Output, log: Path, rig_path: Path, out: Path, html: Path | None, rerun: str | None) -> None:
    pages = Pages(html, rerun)
    spare(out)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.verdict.improvement", *IN_USE))
    from estimator.diagnosis.verdict import improve as improve_model

    with output.progress("improving") as progress, about(log, data):
        ladder = improve_model(rig.model, data.y, data.rate_hz, progress=progress)
    value = ladder.to_json()
    text, better = improved(rig, ladder)
    write_whole(out, text)
    if pages:
        before = _compared(output, rig, data)
        now = _compared(output, better, data) if len(ladder.rungs) > 1 else None
        pages.write(
            better, data, comparison=now or before, before=now and before, ladder=value["ladder"],
            diagnoses=[d.to_json() for d in ladder.diagnoses], notes=value["messages"],
        )  # fmt: skip
    added = [u.name for u in better.model.effects if u.name not in [v.name for v in rig.model.effects]]
    said = f"added: {', '.join(added)}" if added else "nothing more is earned: the model stays as it is"
    notes = [f"note: {message.text}" for message in ladder.messages]
    files = [f"{out}: the improved rig file", *pages.said()]
    output.result(value, ladder_table(value["ladder"]), "", *notes, said, ending(ladder.last.to_json(), added), *files)


def ending(last: Mapping[str, Any], added: Sequence[str] = ()) -> str:
    """Why an improvement stops, from its last diagnosis and what was added."""
    from estimator.diagnosis.verdict import NO_LAW_CODES

    verdict = last["verdict"]
    if verdict == "complete":
        return "the last model is complete: nothing of the catalogue predicts the record better than chance would"
    if text := message_text(last, {NOT_JUDGED}):
        return text
    if verdict == "unknown":
        laid = message_text(last, NO_LAW_CODES)
        return f"something is left: {laid}" if laid else f"something is left that {_OUTSIDE_CATALOGUE}"
    if verdict in added:  # the last that one run adds
        return "what the last model lacks was not examined: run improve again on the rig file that it wrote"
    return f"the last diagnosis names {verdict}, which was not added"


def improved(rig: Rig, ladder: Improvement) -> tuple[str, Rig]:
    """The rig file of a ladder's last model with its fitted values."""
    now = rig
    for use in ladder.model.effects:
        known = next((u for u in now.model.effects if u.name == use.name), None)
        new = [place for place in use.at if known is None or place not in known.at]
        if new:
            now = Rig.parse(with_effect(now, use.name, new), now.base, now.path)
    return (text := with_values(now, ladder.parameters)), Rig.parse(text, now.base, now.path)


def theory(output: Output, rig_path: Path) -> None:
    from estimator.model import theory as hertz

    rig = load_rig(rig_path)
    if rig.model.bearing is None:
        text = "balls, ball_diameter_mm, pitch_diameter_mm and groove_radius_mm"
        raise ConfigError(f"{rig_path}: theory needs the bearing's geometry: add [rig.bearing] with {text}")
    result = hertz(rig.model, _values(rig))
    table = Table(box=None, header_style="bold", pad_edge=False)
    rows = result.table()
    keys = list(dict.fromkeys(k for row in rows for k in row))
    for key in keys:
        table.add_column(Text(_THEORY_HEADINGS.get(key, key)), justify="left" if key == "row" else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(key)) for key in keys))
    orders = ", ".join(f"{k} {v:.3f}" for k, v in result.kinematics.items())
    K_n = f"K_n = {result.K_n:.4g} N/m^1.5 ({result.K_n * 1e-3**1.5:.4g} N/mm^1.5)"
    output.result(result.to_json(), table, "", f"{K_n}; orders of the shaft speed: {orders}")


_THEORY_HEADINGS = {
    "row": "",
    "preload_um": "preload [um]",
    "kL_N_per_mm": "kL [N/mm]",
    "kNL_N_per_mm3": "kNL [N/mm^3]",
    "tangent_k0": "tangent k0 [N/mm]",
    "tangent_k2": "k2 [N/mm^3]",
    "secant_k0": "secant k0 [N/mm]",
    "secant_k2": "k2 [N/mm^3]",
}


def _cell(value: Any) -> Text:
    return Text("" if value is None else value if isinstance(value, str) else f"{value:.4g}")


def _values(rig: Rig) -> Fit | None:
    """The stiffness values of the rig file as a fit, for the theory to stand beside."""
    found = {
        f"{place}.kL": Parameter(s["kL"].value, None, "N/m")
        for place, s in rig.model.linear.items()
        if s["kL"].value is not None
    }
    for use in rig.model.effects:
        if use.name == "cubic":
            for place, s in use.parameters.items():
                if s["kNL"].value is not None:
                    found[f"{place}.cubic.kNL"] = Parameter(s["kNL"].value, None, "N/m^3")
    return Fit(found, None, 0, "spectral") if found else None


def reproduce(output: Output, out: Path) -> None:
    from daq.commands.study.reproduce import reproduce as make

    with output.progress("reproducing the paper") as progress:
        value = make(out, progress)
    output.result(value, f"{out}/index.html: tables 1 to 3 and figures 4 to 19; numbers in {out}/numbers.json")


class Pages:
    """Where a comparison is to be shown: a report page, a Rerun recording or viewer, both or neither."""

    def __init__(self, html: Path | None, rerun: str | None) -> None:
        """Raises ConfigError for a place that cannot be written, before the work is done."""
        if html is not None and not html.absolute().parent.is_dir():
            raise ConfigError(f"--html {html}: folder {html.parent} does not exist; create it first")
        if html is not None:
            spare(html, ".toml")
        if rerun is not None:
            from daq.report.rerun.process import viewer_target

            rerun = viewer_target(rerun)
        self._html, self._rerun = html, rerun

    def __bool__(self) -> bool:
        return self._html is not None or self._rerun is not None

    def write(self, rig: Rig, data: Measurement, **parts: Any) -> None:
        """Parts as `report.render` names them."""
        title = f"Rotorscope: {rig.model.name}"
        if self._html is not None:
            from daq.report.page import write_report

            facts = {"rig": rig.model.name} | data.facts
            write_report(self._html, title, facts=facts, rig_text=rig.text, **parts)
        if self._rerun is not None:
            from daq.report.rerun.comparison import log_comparison

            log_comparison(self._rerun, title=title, **parts)

    def said(self) -> list[str]:
        out = [] if self._html is None else [f"report: {self._html}"]
        if self._rerun is None:
            return out
        return [*out, f"look at it: rerun {self._rerun}" if self._rerun.endswith(".rrd") else f"shown: {self._rerun}"]
