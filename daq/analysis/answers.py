"""The JSON documents of severity, fit, compare and diagnose: one function each, for a command and for an archive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from daq.base.console.output import Progress, quiet_progress
from daq.base.contract.errors import LogError
from daq.exchange.measurement import Measurement
from daq.report.first_numbers import with_severity
from daq.rig.rig import Rig

if TYPE_CHECKING:
    from estimator.identification.record import ChannelSeverity, RecordSurvey
    from estimator.results import Fit

Method = Literal["spectral", "fokker-planck", "score-matching"]
MIN_MISSING_SHARE = 1e-4  # of the samples missing: it may be that which leaves too few stretches


def origin(log: Path | str, rig_path: Path | str, rig: Rig, data: Measurement) -> dict[str, Any]:
    """Keys of every result of a record: what was analysed. from_s : where it begins in the record of the log."""
    part = {} if data.from_s is None else {"from_s": data.from_s, "seconds": len(data.y) / data.rate_hz}
    return part | {
        "log": str(log),
        "started": None if data.started is None else data.started.isoformat(),
        "rig": str(rig_path),
        "band": list(rig.model.band),
        "rate_hz": data.rate_hz,
    }


@contextmanager
def about(log: Path | str, data: Measurement) -> Iterator[None]:
    """Say which record it is that cannot answer."""
    from estimator.errors import DataError

    try:
        yield
    except DataError as problem:
        holes = float(np.mean(np.isnan(data.y).any(axis=1)))
        why = f" ({100 * holes:.2g} % of it is missing or at full scale: mend the link, or use a larger range)"
        raise LogError(f"{log}: {problem}{why if holes > MIN_MISSING_SHARE else ''}") from problem


def measured(rig: Rig, data: Measurement) -> tuple[RecordSurvey, dict[str, ChannelSeverity]]:
    """The survey of a record, and the severity of each channel."""
    from estimator.identification.record import severity, survey_record

    survey = survey_record(rig.model, data.y, data.rate_hz)
    return survey, severity(rig.model, data.y, data.rate_hz, survey, data.full_scale)


def severity_document(rig: Rig, survey: RecordSurvey, levels: Mapping[str, ChannelSeverity]) -> dict[str, Any]:
    """The severity of a record, as JSON."""
    channels = {name: own.to_json() for name, own in levels.items()}
    own = rig.model.iso20816
    return {
        "schema": 1,
        "channels": channels,
        "zone": max((c["zone"] for c in channels.values() if c["zone"]), default=None),
        "iso20816": None if own is None else own.to_json(),
        "findings": [finding.to_json() for finding in survey.findings],
    }


def fitted(rig: Rig, data: Measurement, method: Method = "spectral") -> Fit:
    """The fit of a record by the method's name."""
    import estimator

    return estimator.fit(rig.model, data.y, data.rate_hz, method=method)


def compared(rig: Rig, data: Measurement, progress: Progress = quiet_progress) -> dict[str, Any]:
    """The comparison of the model of a rig with a record, as JSON."""
    from estimator.diagnosis.comparison import compare

    return compare(rig.model, data.y, data.rate_hz, progress=progress).to_json()


def diagnosed(rig: Rig, data: Measurement, progress: Progress = quiet_progress) -> dict[str, Any]:
    """The diagnosis of a record with the severity of its channels, as JSON."""
    from estimator.diagnosis.verdict import diagnose
    from estimator.identification.record import severity

    found = diagnose(rig.model, data.y, data.rate_hz, progress=progress)
    value = found.to_json()
    levels = severity(rig.model, data.y, data.rate_hz, found.record, data.full_scale)
    return value | {"record": with_severity(value["record"], levels)}


DOCUMENT_OF: dict[str, Callable[[Rig, Measurement], dict[str, Any]]] = {  # by the command's name
    "severity": lambda rig, data: severity_document(rig, *measured(rig, data)),
    "fit": lambda rig, data: fitted(rig, data).to_json(),
    "compare": compared,
    "diagnose": diagnosed,
}
