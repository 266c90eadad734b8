"""Whether the spectra of all inferred forces fall alike, as behind a filter of the recorder: roll_off.py."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import force_colour
from .force_colour import Cells
from .roll_off import POWERS, suspected
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Plain = tuple[float, Array, Array]  # likelihood, numbers and their scales: force_colour.plain
LEVEL = 1e-6
LEAST = 0.002  # rms of ln(power) over the band, from where it matters to S
EXPLAINED = 0.5  # of the misfit beyond chance
CHANCE = 3.0  # standard deviations of a deviance
LINE, LINES = 6.0, 0.1  # standard deviations that a line raises a cell by; of the cells, those that lines may have
BEHIND = 20.0  # in deviance, that a cause of another kind may fit better by: it has more numbers


def find(point: WorkingPoint) -> tuple[float, ...]:
    """(5,) as roll_off.gain takes them; () where nothing falls, or something else fits better."""
    data, places = point.data, range(len(point.data.places))
    if data.measured_force or point.kL.min() <= 0.0:
        return ()
    cells, fits = _without_lines(point, [force_colour.cells_of(point, i) for i in places])
    hz, count = cells[0].w / (2 * np.pi), cells[0].n
    highest = max(force_colour.resonance_hz(point, i) for i in places)
    if not suspected(np.stack([_ratio(*z) for z in zip(cells, fits, strict=True)], axis=1), hz, count, highest):
        return ()
    before, df = -2 * sum(level for level, _, _ in fits), float(sum(c.n.size - 4 for c in cells))
    basis = (hz / data.band[1])[:, None] ** POWERS
    after, found = _joint(cells, basis, [u for _, u, _ in fits], [s for _, _, s in fits])
    fall = basis @ found
    rms = float(np.sqrt(np.average((fall - np.average(fall, weights=count)) ** 2, weights=count)))
    if chdtrc(POWERS.size, before - after) > LEVEL or rms < LEAST:
        return ()
    if after - df > max((1 - EXPLAINED) * (before - df), CHANCE * np.sqrt(2 * df)):
        return ()
    other = sum(force_colour.otherwise(point, i, c, *fit) for i, c, fit in zip(places, cells, fits, strict=True))
    return tuple(found.tolist()) if after < other + BEHIND else ()


def _without_lines(point: WorkingPoint, cells: list[Cells]) -> tuple[list[Cells], list[Plain]]:
    """The cells that no line raises at any place, if they are few, and the model of each place fitted to them."""
    whole = cells[0].n.size
    while True:
        fits = [force_colour.plain(point, i, c) for i, c in enumerate(cells)]
        over = [force_colour.deviance(np.sqrt(c.n), _ratio(c, fit)) for c, fit in zip(cells, fits, strict=True)]
        keep = np.max(over, axis=0) < LINE
        if keep.all() or keep.sum() < (1 - LINES) * whole:
            return cells, fits
        cells = [Cells(*(getattr(c, f.name)[keep] for f in fields(c))) for c in cells]


def _ratio(c: Cells, fit: Plain) -> Array:
    """(cells,) measured power over the model's."""
    return c.power / force_colour.base_model(c, fit[1])


def _joint(cells: list[Cells], basis: Array, starts: list[Array], scales: list[Array]) -> tuple[float, Array]:
    """Deviance of all places with one roll-off, and that. basis : (cells, 5) of ln(power) at one of each."""
    from scipy.optimize import least_squares

    count, places = POWERS.size, len(cells)
    roots = [np.sqrt(c.n) for c in cells]
    scale = np.concatenate([np.full(count, 0.05), *scales])
    first = np.concatenate([np.full(count, 0.01), *starts])
    low = np.concatenate([np.zeros(count), np.full(4 * places, -np.inf)])

    def residual(z: Array) -> Array:
        z = z * scale
        fall, out = np.exp(-basis @ z[:count]), []
        for c, root, u in zip(cells, roots, z[count:].reshape(places, 4), strict=True):
            ratio = c.power / np.maximum(c.spectrum(u, c.tangent(u), fall), 1e-300)
            out.append(force_colour.deviance(root, ratio))
        return np.concatenate(out)

    found = least_squares(residual, first / scale, bounds=(low / scale, np.inf), max_nfev=60)
    return 2 * float(found.cost), np.asarray(found.x[:count] * scale[:count])
