"""The bodies of fit, compare, theory and reproduce, and what all analyses of a record share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daq.analysis.answers import Method, about, compared, fitted, origin
from daq.base.console.ahead import loaded
from daq.base.console.extras import check_installed
from daq.base.console.fitting import FittingTable
from daq.base.console.memory import keep_freed
from daq.base.console.output import Output, check_place, spare, write_whole
from daq.base.console.tables import parameters_table
from daq.base.contract.errors import ConfigError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.exchange.measurement import Measurement, measure
from daq.report.words import message_text
from daq.rig.edit import of_channels, with_effect, with_values
from daq.rig.rig import Rig, check_laws, load_rig
from estimator.effects import MORE_LINES
from estimator.results import NOT_CONCLUSIVE, NOT_JUDGED, Fit, Parameter, shared

REPORT_MODULES = ("matplotlib", "jinja2")
IN_USE = ("scipy.optimize", "scipy.ndimage")  # of every comparison
NOT_ADEQUATE = "the model is not adequate: rotorscope diagnose says what is missing"


def fit(output: Output, log: Path, rig_path: Path, method: Method, out: Path | None, part: Part = WHOLE_RECORD) -> None:
    if out is not None:
        spare(out)
    rig, data = given(output, log, rig_path, ("estimator.identification.fit",), part)
    with output.progress(f"fitting ({method})"), about(log, data):
        result = fitted(rig, data, method)
    if out is not None:
        whole = load_rig(rig_path)  # with the channels that were left out, too
        write_whole(out, with_values(with_lines(whole, result.parameters), result.parameters))
    people: list[Any] = [parameters_table(result.parameters), ""]
    people += [value.sentence(name) for name, value in shared(result.parameters).items()]
    people += [f"note: {message.text}" for message in result.messages]
    people.append(f"{result.samples} samples, method {result.method}" + _likelihood(result))
    if out is not None:
        people.append(f"{out}: the rig file with the fitted values")
    output.result(result.to_json() | origin(log, rig_path, rig, data), *people)


def with_lines(rig: Rig, parameters: Mapping[str, Parameter]) -> Rig:
    """The rig with the further lines that a fit found for one without a frequency, where it found them."""
    for name in MORE_LINES:
        there = dict.fromkeys(full.rsplit(".", 2)[0] for full in parameters if full.split(".")[-2] == name)
        known = next((u.at for u in rig.model.effects if u.name == name), ())
        if new := [place for place in there if place not in known]:
            rig = Rig.parse(with_effect(rig, name, new), rig.base, rig.path)
    return rig


def given(
    output: Output, log: Path, rig_path: Path, needed: Sequence[str] = (), part: Part = WHOLE_RECORD
) -> tuple[Rig, Measurement]:
    """Model and measurement of a command, checked; the model has the channels of `part` only.

    needed : modules to load while the log is read; to be imported after it.
    """
    keep_freed()
    rig = of_channels(load_rig(rig_path), part.channels)
    check_laws(rig, rig_path)
    loaded(needed)
    return rig, measure(log, rig, output.note, part)


def _likelihood(result: Fit) -> str:
    return "" if result.log_likelihood is None else f", log-likelihood {result.log_likelihood:.6g}"


def compare(
    output: Output, log: Path, rig_path: Path, html: Path | None, rerun: str | None, part: Part = WHOLE_RECORD
) -> None:
    pages = Pages(html, rerun)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.comparison.comparison", *IN_USE), part)
    with about(log, data):
        value = shown_compared(output, rig, data)
    pages.write(rig, data, comparison=value)
    output.result(value | origin(log, rig_path, rig, data), *comparison_text(value), *pages.said())


def shown_compared(output: Output, rig: Rig, data: Measurement) -> dict[str, Any]:
    """The comparison of the model of a rig with a record, as JSON; with progress."""
    with output.progress("comparing") as progress:
        return compared(rig, data, progress)


def comparison_text(value: Mapping[str, Any]) -> list[Any]:
    """A comparison for people."""
    missing = value["missing_force_percent"]
    interval = f"{missing['low']:.2f} to {missing['high']:.2f}"
    left = value["heldout_nll"] - value["reference_nll"]
    rows = [
        (row["channel"], row["against"].replace("_", " "), row["region"], f"{row['share_percent']:.0f}")
        for row in value["where"]
    ]
    headings = ("channel", "predicted by", "region", "share [%]")
    table = FittingTable(headings=headings, rows=rows, order=(1, 3, 2), right=frozenset({3}))
    people: list[Any] = [table, ""] if rows else []
    people.append(f"missing force: {missing['value']:.2f} % of the bearing force ({interval})")
    people.append(
        f"held-out error: {value['heldout_nll']:.5f} nats per sample; black box {value['reference_nll']:.5f}, "
        f"so {max(left, 0.0):.5f} at most are left to win"
    )
    for name, text in (("psd_distance_db", "spectra differ by [dB]"), ("pdf_distance", "densities differ by"),
                       ("simulation_rmse", "free-run simulation error")):  # fmt: skip
        if value.get(name):
            people.append(f"{text}: " + ", ".join(f"{c} {d:.2g}" for c, d in value[name].items()))
    people += [f"note: {message}" for message in value.get("messages", ())]
    if not message_text(value, {NOT_JUDGED, NOT_CONCLUSIVE}):  # a note above
        people.append("the model is adequate" if value["adequate"] else NOT_ADEQUATE)
    return people


def step(rig: Rig, comparison: Mapping[str, Any]) -> dict[str, Any]:
    """The rung of a ladder that a comparison makes."""
    keys = ("heldout_nll", "missing_force_percent")
    return {"effects": [use.name for use in rig.model.effects]} | {k: comparison[k] for k in keys}


def theory(output: Output, rig_path: Path) -> None:
    from estimator.model import theory as hertz

    rig = load_rig(rig_path)
    if rig.model.bearing is None or rig.model.bearing.groove_radius is None:
        text = "balls, ball_diameter_mm, pitch_diameter_mm and groove_radius_mm"
        raise ConfigError(f"{rig_path}: theory needs the bearing's geometry: add [rig.bearing] with {text}")
    result = hertz(rig.model, _values(rig))
    rows = result.table()
    keys = list(dict.fromkeys(k for row in rows for k in row))
    important = [k for name in _THEORY_ORDER for k, key in enumerate(keys) if key == name]
    table = FittingTable(
        headings=[_THEORY_HEADINGS.get(key, key) for key in keys],
        rows=[[_cell(row.get(key)) for key in keys] for row in rows],
        order=important,
        right=frozenset(k for k, key in enumerate(keys) if key != "row"),
    )
    orders = ", ".join(f"{k} {v:.3f}" for k, v in result.kinematics.items())
    K_n = f"K_n = {result.K_n:.4g} N/m^1.5 ({result.K_n * 1e-3**1.5:.4g} N/mm^1.5)"
    output.result(result.to_json(), table, "", f"{K_n}; orders of the shaft speed: {orders}")


_THEORY_HEADINGS = {
    "row": "",
    "preload_um": "preload [um]",
    "kL_N_per_mm": "kL [N/mm]",
    "kNL_N_per_mm3": "kNL [N/mm^3]",
    "tangent_k0": "tangent k0 [N/mm]",
    "tangent_k2": "tangent k2 [N/mm^3]",
    "secant_k0": "secant k0 [N/mm]",
    "secant_k2": "secant k2 [N/mm^3]",
}


_THEORY_ORDER = ("kNL_N_per_mm3", "tangent_k0", "secant_k0", "tangent_k2", "secant_k2")  # the first ones stay longest


def _cell(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:.4g}"


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

    check_installed(REPORT_MODULES, "report", "reproduce")
    with output.progress("reproducing the paper") as progress:
        value = make(out, progress)
    output.result(value, f"{out}/index.html: tables 1 to 3 and figures 4 to 19; numbers in {out}/numbers.json")


class Pages:
    """Where a comparison is to be shown: a report page, a Rerun recording or viewer, both or neither."""

    def __init__(self, html: Path | None, rerun: str | None) -> None:
        """Raises ConfigError for a place that cannot be written, before the work is done."""
        if html is not None:
            check_place("--html", html)
            check_installed(REPORT_MODULES, "report", "--html")
            spare(html, ".toml")
            if html.suffix.lower() not in (".html", ".htm"):
                raise ConfigError(f"--html {html}: the report is a page of HTML; choose a name that ends in .html")
        if rerun is not None:
            check_installed(("rerun",), "", "--rerun")
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
