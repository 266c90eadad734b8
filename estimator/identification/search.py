"""The search for findings: every detector in turn, on a record and its working point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from estimator.arrays import Array
from estimator.likelihood.motion import harmonics
from estimator.likelihood.motion.located_law import clipped_places as clipped_by
from estimator.likelihood.path.whitening import Spectrum
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import EffectUse, Model
from estimator.parallel import map_threads

from .finding import Finding, effect_use
from .machine.lines import find_lines
from .record.clipping import find_clipping
from .structure.coupled_caps import find_coupled_sensor_faults
from .structure.spectral_shape import find_spectral_shapes
from .structure.transfer_faults import find_transfer_faults


class Detector(Protocol):
    """A search for effects of one kind. y : (n, channels) SI; found : what the detectors before it found."""

    def __call__(self, model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]: ...


def _lines(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Periodic forces."""
    return find_lines(model, point, y)


def _spectral_shapes(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Shaped or shared excitation and noisy sensors, beside the lines that were found."""
    return find_spectral_shapes(model, _without_lines(found, model, point))


def _transfer_faults(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Faults of transfer functions from measured forces: these forces have the shape and the company that they have."""
    if not point.data.measured_force:
        return []
    return find_transfer_faults(model, point, harmonics.known_lines(_with_findings(model, found)))


def _coupled_sensor_faults(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Sensor gains and delays that two caps on one shaft reveal."""
    return find_coupled_sensor_faults(model, point)


DETECTORS: tuple[Detector, ...] = (_lines, _spectral_shapes, _transfer_faults, _coupled_sensor_faults)


def search(model: Model, point: WorkingPoint, y: Array, everywhere: bool = False) -> list[Finding]:
    """All findings in a record, clipped channels first, then the others by gain.

    Parameters
    ----------
    model : Model
        The model of the working point.
    point : WorkingPoint
        The model fitted to the record.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.
    everywhere : bool
        Whether clipped channels and locations that cannot be judged are searched too, for a model that is known to
        have these effects there. Otherwise a clipped channel has no other finding.

    Returns
    -------
    list of Finding
        Strongest first behind the clipped channels.
    """
    clipped = find_clipping(model, y)
    found: list[Finding] = []
    for detector in DETECTORS:
        found += detector(model, point, y, found)
    if not everywhere:
        bad = {location for f in clipped for location in f.at} | clipped_by(model) | point.data.lost
        found = [kept for f in found if (kept := _outside(f, bad, point)) is not None]
    return clipped + sorted(found, key=lambda f: -f.gain_nats)


def _with_findings(model: Model, found: Sequence[Finding]) -> Model:
    """The model with the effects that were found."""
    return replace(model, effects=(*model.effects, *_uses(found)))


def _uses(found: Sequence[Finding]) -> tuple[EffectUse, ...]:
    """Findings as a model holds effects."""
    return tuple(effect_use(f.effect, f.settings) for f in found)


def _without_lines(found: Sequence[Finding], model: Model, point: WorkingPoint) -> WorkingPoint:
    """The point with the spectra of the residual force less the periodic forces that were found.

    A line in all of the spectrum of a block is no spectral shape, and at both bearings no shared force.
    """
    data = point.data
    waves = harmonics.periodic_forces(replace(model, effects=_uses(found)), data.places, data.rate_hz)
    if not waves:
        return point

    def spectrum(i: int) -> Spectrum:
        force = point.force[i].copy()
        for wave in waves:
            if (own := wave.at(i, data.t, data.phase)) is not None:
                force -= own
        return point.whitening.spectrum(i, force)

    hit = sorted({i for wave in waves for i in wave.tables})
    return replace(point, spectra=point.spectra | dict(zip(hit, map_threads(spectrum, hit), strict=True)))


def _outside(found: Finding, bad: set[str], point: WorkingPoint) -> Finding | None:
    """A finding without its part at bad locations; None if nothing remains. Only a periodic force has such parts."""
    at = tuple(location for location in found.at if location not in bad)
    if len(at) == len(found.at):
        return found
    if not at or found.effect not in harmonics.PERIODIC_EFFECTS:
        return None
    power_N2 = {i: P for i, P in found.power_N2.items() if point.data.places[i] not in bad}
    settings = {location: own for location, own in found.settings.items() if location not in bad}
    return replace(found, at=at, power_N2=power_N2, settings=settings)
