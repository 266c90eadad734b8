"""Everything that can be wrong with a record besides a force law on its states."""

from __future__ import annotations

from dataclasses import replace

from estimator.arrays import Array
from estimator.likelihood.motion import harmonics
from estimator.likelihood.motion.located_law import clipped as clipped_by
from estimator.likelihood.path.whitening import Spectrum
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import EffectUse, Model
from estimator.parallel import map_threads

from .finding import Suspect, as_use
from .machine import lines as line_forces
from .record import clipping
from .structure import coupled_caps, spectral_shape, transfer_faults


def suspects(model: Model, point: WorkingPoint, y: Array, everywhere: bool = False) -> list[Suspect]:
    """Lines, shaped or shared forces, sensor faults, strongest first; of a clipped channel nothing else, nor of a place
    that cannot be judged.

    A measured force has the shape and the company that it has: there, what bends the path to the motion is sought.
    everywhere : of clipped channels too, for a model that is known to have these effects there.
    """
    clipped = clipping.find(model, y)
    lines = line_forces.find(model, point, y, point.data.rate_hz)
    rest = lines + spectral_shape.find(model, _without(lines, model, point))
    if point.data.measured_force:
        rest += transfer_faults.find(model, point, harmonics.known_lines(_having(model, lines)))
    rest += coupled_caps.find(model, point)
    if not everywhere:
        bad = {p for s in clipped for p in s.at} | clipped_by(model) | point.data.lost
        rest = [kept for s in rest if (kept := _elsewhere(s, bad, point)) is not None]
    return clipped + sorted(rest, key=lambda s: -s.gain)


def _having(model: Model, found: list[Suspect]) -> Model:
    """The model with periodic forces that were found."""
    return replace(model, effects=(*model.effects, *_uses(found)))


def _uses(found: list[Suspect]) -> tuple[EffectUse, ...]:
    return tuple(as_use(s.effect, s.settings) for s in found)


def _without(found: list[Suspect], model: Model, point: WorkingPoint) -> WorkingPoint:
    """The point with the spectra of what is left of the force without periodic ones that were found: a line in all of
    the spectrum of a block is no colour, and at both bearings no common force."""
    data = point.data
    made = harmonics.whole_waves(replace(model, effects=_uses(found)), data.places, data.rate_hz)
    if not made:
        return point

    def left(i: int) -> Spectrum:
        force = point.force[i].copy()
        for wave in made:
            if (own := wave.at(i, data.t, data.phase)) is not None:
                force -= own
        return point.whitening.spectrum(i, force)

    hit = sorted({i for wave in made for i in wave.tables})
    return replace(point, spectra=point.spectra | dict(zip(hit, map_threads(left, hit), strict=True)))


def _elsewhere(s: Suspect, bad: set[str], point: WorkingPoint) -> Suspect | None:
    """A finding without its part at bad places; None if nothing is left. What has a part at each place stands there."""
    at = tuple(p for p in s.at if p not in bad)
    if len(at) == len(s.at):
        return s
    if not at or s.effect not in harmonics.PERIODIC:
        return None
    power = {i: P for i, P in s.power.items() if point.data.places[i] not in bad}
    return replace(s, at=at, power=power, settings={p: v for p, v in s.settings.items() if p not in bad})
