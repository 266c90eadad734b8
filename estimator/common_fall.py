"""Whether the spectra of all inferred forces fall alike, as behind a filter of the recorder: roll_off.py."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import force_colour
from .force_colour import Cells
from .roll_off import POWERS, suspected
from .working_point import WorkingPoint

Array = NDArray[np.float64]
LEVEL = 1e-6
LEAST = 0.002  # rms of ln(power) over the band, from where it matters to S
EXPLAINED = 0.5  # of the misfit beyond chance
CHANCE = 3.0  # standard deviations of a deviance
BEHIND = 20.0  # in deviance, that a cause of another kind may fit better by: it has more numbers


def find(point: WorkingPoint) -> tuple[float, ...]:
    """(5,) as roll_off.gain takes them; () where nothing falls, or something else fits better."""
    data = point.data
    free = [i for i in range(len(data.places)) if data.driven[i] == 0.0 and point.kL[i] > 0.0]
    if not free or len(free) < len(data.places):
        return ()
    cells = [force_colour.cells_of(point, i) for i in free]
    fits = [force_colour.plain(point, i, c) for i, c in zip(free, cells, strict=True)]
    before = -2 * sum(level for level, _, _ in fits)
    df = float(sum(c.n.size - 4 for c in cells))
    over = [c.power / force_colour.base_model(c, u) for c, (_, u, _) in zip(cells, fits, strict=True)]
    highest = max(force_colour.resonance_hz(point, i) for i in free)
    if not suspected(np.stack(over, axis=1), cells[0].w / (2 * np.pi), cells[0].n, highest):
        return ()
    after, found = _joint(cells, [u for _, u, _ in fits], [s for _, _, s in fits], data.band[1])
    shape = ((cells[0].w / (2 * np.pi * data.band[1]))[:, None] ** POWERS) @ found
    rms = float(np.sqrt(np.average((shape - np.average(shape, weights=cells[0].n)) ** 2, weights=cells[0].n)))
    if chdtrc(POWERS.size, before - after) > LEVEL or rms < LEAST:
        return ()
    if after - df > max((1 - EXPLAINED) * (before - df), CHANCE * np.sqrt(2 * df)):
        return ()
    other = sum(force_colour.otherwise(point, i, c, *fit) for i, c, fit in zip(free, cells, fits, strict=True))
    return tuple(found.tolist()) if after < other + BEHIND else ()


def _joint(cells: list[Cells], starts: list[Array], scales: list[Array], top_hz: float) -> tuple[float, Array]:
    """Deviance of all places with one roll-off, and that."""
    from scipy.optimize import least_squares

    count, places = POWERS.size, len(cells)
    bases = [(c.w / (2 * np.pi * top_hz))[:, None] ** POWERS for c in cells]
    roots = [np.sqrt(c.n) for c in cells]
    scale = np.concatenate([np.full(count, 0.05), *scales])
    first = np.concatenate([np.full(count, 0.01), *starts])
    low = np.concatenate([np.zeros(count), np.full(4 * places, -np.inf)])

    def residual(z: Array) -> Array:
        z = z * scale
        out = []
        for c, basis, root, u in zip(cells, bases, roots, z[count:].reshape(places, 4), strict=True):
            ratio = c.power / np.maximum(c.spectrum(u, c.tangent(u), np.exp(-basis @ z[:count])), 1e-300)
            out.append(force_colour.deviance(root, ratio))
        return np.concatenate(out)

    found = least_squares(residual, first / scale, bounds=(low / scale, np.inf), max_nfev=60)
    return 2 * float(found.cost), np.asarray(found.x[:count] * scale[:count])
