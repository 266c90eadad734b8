"""The machine layer of a record: it needs spectra, and no resonance, mass or fitted model."""

from __future__ import annotations

from estimator.arrays import Array
from estimator.identification.record import RecordSurvey, moments
from estimator.model.rig import Model
from estimator.results import Message

from .line_bands import record_lines
from .machine_survey import MachineSurvey, Tone
from .spectra import channel_spectra
from .speed import SPEED_SUGGESTED, rate_remarks, shaft_speed
from .strikes import find_strikes
from .thresholds import LIMITS
from .tones import lines_to_leave_out, tones_of, without_strike_lines


def survey_machine(
    model: Model,
    y: Array,
    rate_hz: float,
    record: RecordSurvey | None = None,
    *,
    live: bool = False,
    without_strikes: bool = False,
) -> MachineSurvey:
    """Speed of the shaft, tones and strike trains of a record.

    Parameters
    ----------
    model : Model
        The rig; of it are used the channels, the nameplate speed and the geometry of the bearing.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``; NaN where a sample is missing. Rows of NaN may
        separate many short records.
    rate_hz : float
        Rows per second.
    record : RecordSurvey or None
        What the record layer says; channels that it calls unusable are left out.
    live : bool
        Whether these are the last seconds of a stream: strikes are looked for in fewer bands, at a third of the cost.
    without_strikes : bool
        Whether no strikes are looked for.

    Returns
    -------
    MachineSurvey
        Empty where no channel has a gap-free run of 256 samples.
    """
    skipped = record.unusable if record is not None else frozenset()
    columns = {c.name: i for i, c in enumerate(model.channels) if c.kind != "tacho" and c.name not in skipped}
    spectra = channel_spectra(y, rate_hz, columns)
    missing = [
        Message("no_gap_free_piece", f"channel {name}: no run of 256 samples without a gap", name)
        for name in columns if name not in spectra
    ]  # fmt: skip
    units = {c.name: c.unit for c in model.channels}
    speed, remarks = shaft_speed(model, y, rate_hz, spectra) if spectra else (None, [])
    bank = LIMITS.live_bands_per_rate if live else LIMITS.bands_per_rate
    searched = {} if without_strikes else {name: columns[name] for name in spectra}
    strikes, struck = find_strikes(model, y, rate_hz, searched, speed, bank)
    if speed is None and strikes:  # their comb is not that of the shaft
        remarks = [remark for remark in remarks if remark.code != SPEED_SUGGESTED]
    lines = record_lines(model, y, rate_hz, spectra, speed)
    if speed is not None:
        remarks = rate_remarks(lines, speed, model.speed_rpm, remarks)
    rms = {name: moments(y[:, columns[name]]).sd for name in {line.channel for line in lines}}
    shown, more = _shown(tones_of(without_strike_lines(lines, strikes, speed), speed, units, rms))
    left_out = lines_to_leave_out(lines, model.band, speed)
    return MachineSurvey(
        speed=speed,
        tones=shown,
        strikes=tuple(strikes),
        messages=(*missing, *remarks, *struck, *more),
        line_bands={name: tuple(line.band for line in left_out if line.channel == name) for name in spectra},
    )


def _shown(tones: list[Tone]) -> tuple[tuple[Tone, ...], list[Message]]:
    """The strongest tones, orders 1 and 2 among them, and the remark on the others."""
    first = [t for t in tones if t.kind == "order" and t.order in (1.0, 2.0)]
    others = [t for t in tones if t not in first][: max(0, LIMITS.max_tones_shown - len(first))]
    shown = tuple(t for t in tones if t in first or t in others)
    left = len(tones) - len(shown)
    more = [Message("more_tones", f"{left} weaker tones are not shown")] if left else []
    return shown, more
