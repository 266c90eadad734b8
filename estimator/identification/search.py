"""The search for findings: every detector, one after another, on a record and its working point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from estimator.arrays import Array
from estimator.likelihood.motion import harmonics
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.whitening.whitening import Spectrum
from estimator.model.rig import Model
from estimator.parallel import map_threads

from .finding import Finding, effect_use
from .residual.lines import find_lines
from .residual.measured_path import find_path_faults
from .structure.spectral_shape import find_spectral_shapes

MAX_SAMPLES = 1.2e7  # of all places, from the first row: a line spectrum takes about 50 bytes a sample


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
    lines = find_lines(model, point, y)
    shapes = find_spectral_shapes(model, _without_lines(lines, model, point))
    faults: list[Finding] = []
    if point.data.measured_force:
        uses = tuple(effect_use(f.effect, f.settings) for f in (*lines, *shapes))
        faults = find_path_faults(model, point, harmonics.known_lines(replace(model, effects=(*model.effects, *uses))))
    return sorted([*lines, *shapes, *faults], key=lambda f: -f.gain_nats)


def _without_lines(found: Sequence[Finding], model: Model, point: WorkingPoint) -> WorkingPoint:
    """The point with the spectra of the residual force less the periodic forces that were found.

    A line in all of the spectrum of a block is no spectral shape, and at both bearings no shared force.
    """
    data, uses = point.data, tuple(effect_use(f.effect, f.settings) for f in found)
    waves = harmonics.periodic_forces(replace(model, effects=uses), data.places, data.rate_hz)
    if not waves:
        return point

    def spectrum(i: int) -> Spectrum:
        force = point.force[i].copy()
        for wave in waves:
            if i in wave.tables:
                force -= wave.at(i, data.t, data.phase)
        return point.whitening.spectrum(i, force)

    hit = sorted({i for wave in waves for i in wave.tables})
    return replace(point, spectra=point.spectra | dict(zip(hit, map_threads(spectrum, hit), strict=True)))
