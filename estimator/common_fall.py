"""Whether the spectra of all inferred forces fall alike, or those of each bearing, as behind filters of one recorder or
of two: roll_off.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import force_colour
from .force_colour import Cells
from .roll_off import POWERS, RollOff, averaged, devices, folded, suspected
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Plain = tuple[float, Array, Array]  # likelihood, numbers and their scales: force_colour.plain
LEVEL = 1e-6
LEAST = 0.002  # rms of ln(power) over the band, from where it matters to S
EXPLAINED = 0.5  # of the misfit beyond chance
ALIKE = 0.8  # the same of two channels of a bearing: one that falls beside one that does not leaves half
CHANCE = 3.0  # standard deviations of a deviance
MISFIT = 6.0  # standard deviations of a deviance that is looked into, where nothing falls at the end of the band
MOST_MEANS = 8.0
LINE, LINES = 6.0, 0.1  # standard deviations that a line raises a cell by; of the cells, those that lines may have
BEHIND = 20.0  # in deviance, that a cause of another kind may fit better by: it has more numbers


def find(point: WorkingPoint) -> RollOff | None:
    """None where nothing falls, or something else fits better."""
    data, places = point.data, [*range(len(point.data.places))]
    if data.measured_force or point.kL.min() <= 0.0:
        return None
    cells, fits = _without_lines(point, [force_colour.cells_of(point, i) for i in places])
    together, found = _fall(point, places, cells, fits, EXPLAINED)
    nodes = [(own, *_fall(point, own, [cells[i] for i in own], [fits[i] for i in own], ALIKE))
             for own in devices(data.places)]  # fmt: skip
    apart = {data.places[i]: off for own, _, off in nodes if off is not None for i in own}
    less = together - sum(after for _, after, _ in nodes)
    if apart and (found is None or chdtrc(POWERS.size * (len(nodes) - 1), less) < LEVEL):
        return RollOff(apart=apart)
    return found


def _fall(
    point: WorkingPoint, places: list[int], cells: list[Cells], fits: list[Plain], explained: float
) -> tuple[float, RollOff | None]:
    """Deviance of some places behind what they fall alike by, and that; without it where nothing falls, or something
    else fits better. explained : of the misfit beyond chance, at least."""
    hz, count = cells[0].w / (2 * np.pi), cells[0].n
    before, df = -2 * sum(level for level, _, _ in fits), float(sum(c.n.size - 4 for c in cells))
    highest = max(force_colour.resonance_hz(point, i) for i in places)
    falls = suspected(np.stack([_ratio(*z) for z in zip(cells, fits, strict=True)], axis=1), hz, count, highest)
    if not falls and before - df < MISFIT * np.sqrt(2 * df):
        return before, None
    after, found = min(_steep(point, cells, fits), _slow(point, places, cells, fits), key=lambda t: t[0])
    fall = -np.log(found.passed(hz, point.data.band[1]))
    rms = float(np.sqrt(np.average((fall - np.average(fall, weights=count)) ** 2, weights=count)))
    if chdtrc(POWERS.size, before - after) > LEVEL or rms < LEAST:
        return before, None
    if after - df > max((1 - explained) * (before - df), CHANCE * np.sqrt(2 * df)):
        return before, None
    other = sum(force_colour.otherwise(point, i, c, *fit) for i, c, fit in zip(places, cells, fits, strict=True))
    return (after, found) if after < other + BEHIND else (before, None)


def _steep(point: WorkingPoint, cells: list[Cells], fits: list[Plain]) -> tuple[float, RollOff]:
    """Deviance of all places behind a filter that lets nothing through above half the rate, and that filter."""
    x = cells[0].w / (2 * np.pi * point.data.band[1])
    basis = x[:, None] ** POWERS

    def spectra(i: int, c: Cells, u: Array, z: Array) -> Array:
        return c.spectrum(u, c.tangent(u), np.exp(-basis @ z))

    after, z = _joint(cells, fits, spectra, np.full(POWERS.size, 0.01), 0.05, np.inf)
    return after, RollOff(tuple(z.tolist()))


def _slow(
    point: WorkingPoint, places: list[int], cells: list[Cells], fits: list[Plain]
) -> tuple[float, RollOff]:  # fmt: skip
    """The same behind means over a sample, with what they fold back."""
    data, hz = point.data, cells[0].w / (2 * np.pi)
    mass = data.mass[places]

    def spectra(i: int, c: Cells, u: Array, z: Array) -> Array:
        means = float(z[0])
        back = folded(hz, means, data.rate_hz, data.kinds[places[i]]) / mass[i] ** 2
        A = c.tangent(u)
        return c.spectrum(u, A, averaged(hz, means, data.rate_hz) + back * np.abs(A) ** 2)

    after, z = _joint(cells, fits, spectra, np.ones(1), 0.1, MOST_MEANS)
    free = zip(places, (point.kL[places] / mass).tolist(), (point.c[places] / mass).tolist(), strict=True)
    return after, RollOff(means=float(z[0]), rate_hz=data.rate_hz, free={data.places[i]: (k, c) for i, k, c in free})


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


def _joint(
    cells: list[Cells],
    fits: list[Plain],
    spectra: Callable[[int, Cells, Array, Array], Array],
    first: Array,
    scale: float,
    most: float,
) -> tuple[float, Array]:
    """Deviance of all places behind one filter, and its numbers. spectra : (cells,) of a place, its own numbers and
    those of the filter, which are between 0 and `most`."""
    from scipy.optimize import least_squares

    count, places = first.size, len(cells)
    roots = [np.sqrt(c.n) for c in cells]
    scales = np.concatenate([np.full(count, scale), *(s for _, _, s in fits)])
    start = np.concatenate([first, *(u for _, u, _ in fits)]) / scales
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[:count], high[:count] = 0.0, most / scale

    def residual(z: Array) -> Array:
        z = z * scales
        own = z[count:].reshape(places, 4)
        out = []
        for i, (c, root) in enumerate(zip(cells, roots, strict=True)):
            out.append(force_colour.deviance(root, c.power / np.maximum(spectra(i, c, own[i], z[:count]), 1e-300)))
        return np.concatenate(out)

    found = least_squares(residual, start, bounds=(low, high), max_nfev=60)
    return 2 * float(found.cost), np.asarray(found.x[:count] * scale)
