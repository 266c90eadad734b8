"""The layers before any fit of a model, and the part of a record that they leave for the judgement of bearings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeVar

from estimator.arrays import Array, return_freed_memory
from estimator.errors import DataError, NoResonanceError
from estimator.model.rig import MOTION_UNITS, Model

from .batch.unknown_mass import places_scaled_by_shaft
from .machine import MachineSurvey, joined_bands, survey_machine
from .record import RecordFinding, RecordSurvey, UsableRecord, survey_record, usable_record, without_spikes
from .structure import Mode, StructureSurvey, bearing_mode, survey_structure

T = TypeVar("T")
NO_PLACES: Mapping[str, str] = MappingProxyType({})
NO_BEARING_MODE = "no_bearing_mode"  # code: no mode of a place can be the bearing's


@dataclass(frozen=True, slots=True, kw_only=True)
class Layers:
    """The layers of a record that need no fit of the bearings.

    Parameters
    ----------
    record : RecordSurvey
        Channels and their faults.
    machine : MachineSurvey
        Speed, tones, strike trains.
    structure : StructureSurvey
        Modes, and what excites them.
    """

    record: RecordSurvey
    machine: MachineSurvey
    structure: StructureSurvey


def survey_layers(model: Model, y: Array, rate_hz: float, *, without_strikes: bool = False) -> Layers:
    """The layers of a record, or all but its strike trains. y : (n, channels), SI. Nothing is raised."""
    record = survey_record(model, y, rate_hz)
    y = without_spikes(model, y, record)
    machine = survey_machine(model, y, rate_hz, record, without_strikes=without_strikes)
    return_freed_memory(y)
    structure = survey_structure(model, y, rate_hz, record, machine)
    return_freed_memory(y)
    return Layers(record=record, machine=machine, structure=structure)


def judging_layers(model: Model, y: Array, rate_hz: float) -> Layers:
    """The layers of a record as far as the judgement of its bearings needs them. y : (n, channels), SI.

    Strike trains are half of the work. They matter to a spectrum whose modes their lines hide.
    """
    layers = survey_layers(model, y, rate_hz, without_strikes=True)
    clear = all(isinstance(_mode(model, layers, place), Mode) for place in layers.structure.places)
    return layers if clear else survey_layers(model, y, rate_hz)


def on_judgeable_record(
    model: Model, y: Array, layers: Layers, use: Callable[[UsableRecord], T], refused: Mapping[str, str] = NO_PLACES
) -> T:
    """The answer of a function of the judgeable record; a place where its fit finds no resonance is left out.

    y : (n, channels), SI. refused : places that are not judged, and why. Raises DataError as `judgeable_record` does.
    """
    refused = dict(refused)
    while True:
        try:
            return use(judgeable_record(model, y, layers, refused))
        except NoResonanceError as problem:
            if problem.place in refused:
                raise
            refused[problem.place] = str(problem)


def judgeable_record(model: Model, y: Array, layers: Layers, refused: Mapping[str, str] = NO_PLACES) -> UsableRecord:
    """The record without condemned channels, and without places where no mode can be the bearing's, with its lines.

    y : (n, channels), SI. refused : further places that are not judged, and why. Raises DataError, one line, where no
    place is left: a faulty channel first, and why the first sound place is not judged.
    """
    moving = [c for c in model.channels if c.kind in MOTION_UNITS]
    channels_of = {p: tuple(c.name for c in moving if c.place == p) for p in model.places}
    sound = {p: names for p, names in channels_of.items() if not layers.record.unjudged.issuperset(names)}
    found = []
    for place, channels in sound.items():
        reason = refused.get(place) or _mode(model, layers, place)
        if isinstance(reason, str):
            own = RecordFinding(
                code=NO_BEARING_MODE, channels=channels, text=reason, places=(place,), condemned=channels
            )
            found.append(own)
    if found and len(found) == len(sound):
        faults = [f.text for f in sorted(layers.record.findings, key=lambda finding: not finding.condemned)]
        raise DataError("; ".join([*faults[:1], found[0].text]))
    usable = usable_record(model, y, replace(layers.record, findings=(*layers.record.findings, *found)))
    names = [c.name for c in usable.model.channels if c.kind in MOTION_UNITS]
    lines = joined_bands(band for name in names for band in layers.machine.line_bands.get(name, ()))
    unexplained = tuple(place for finding in found for place in finding.places)
    return replace(usable, model=replace(usable.model, record_lines=tuple(lines), unexplained_places=unexplained))


def _mode(model: Model, layers: Layers, place: str) -> Mode | str:
    """The mode of a place that can be the bearing's, or why there is none."""
    rigged = model.cap_mass(place) is not None or place in places_scaled_by_shaft(model)
    return bearing_mode(layers.structure, place, of_rig=rigged)
