"""The search for findings: every detector in turn, on a record and its working point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from estimator.arrays import Array
from estimator.likelihood.motion import harmonics
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.whitening.whitening import Spectrum
from estimator.model.rig import EffectUse, Model
from estimator.parallel import map_threads

from .finding import Finding, effect_use
from .residual.lines import find_lines
from .residual.measured_path import find_path_faults
from .structure.spectral_shape import find_spectral_shapes


class Detector(Protocol):
    """A search for effects of one kind. y : (n, channels) SI; found : what the detectors before it found."""

    def __call__(self, model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]: ...


def _lines(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Periodic forces."""
    return find_lines(model, point, y)


def _spectral_shapes(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Shaped or shared excitation and noisy sensors, beside the lines that were found."""
    return find_spectral_shapes(model, _without_lines(found, model, point))


def _path_faults(model: Model, point: WorkingPoint, y: Array, found: Sequence[Finding]) -> list[Finding]:
    """Faults of the paths from measured forces, beside the lines that were found."""
    if not point.data.measured_force:
        return []
    return find_path_faults(model, point, harmonics.known_lines(_with_findings(model, found)))


MAX_SAMPLES = 1.2e7  # of all places, from the first row: a line spectrum takes about 50 bytes a sample
RECORD_DETECTORS: tuple[Detector, ...] = (_lines, _spectral_shapes, _path_faults)


def search(model: Model, point: WorkingPoint, y: Array) -> list[Finding]:
    """All findings in a record, by gain.

    Parameters
    ----------
    model : Model
        The model of the working point.
    point : WorkingPoint
        The model fitted to the record.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``.

    Returns
    -------
    list of Finding
        Strongest first.
    """
    y = y[: int(MAX_SAMPLES / max(len(model.places), 1))]
    found: list[Finding] = []
    for detector in RECORD_DETECTORS:
        found += detector(model, point, y, found)
    return sorted(found, key=lambda f: -f.gain_nats)


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
