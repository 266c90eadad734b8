"""Whether the spectra of all inferred forces fall alike, or those of each bearing, as behind filters of one recorder or
of two: roll_off.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import force_colour
from .filter_designs import designs
from .force_colour import Cells
from .roll_off import POWERS, Filter, RollOff, devices, suspected
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
SCALE = 0.05  # of a filter's numbers
CUTOFF, WIDE = 0.45, 2.0  # of the rate, that a search for a filter begins with; as far as it goes in ln
Number = tuple[float, float, float]  # of a filter: begun with, least, most
LINE, LINES = 6.0, 0.1  # standard deviations that a line raises a cell by; of the cells, those that lines may have
BEHIND = 20.0  # in deviance, that a cause of another kind may fit better by: it has more numbers


def find(point: WorkingPoint) -> RollOff | None:
    """None where nothing falls, or something else fits better."""
    data, places = point.data, [*range(len(point.data.places))]
    if data.measured_force or point.kL.min() <= 0.0:
        return None
    cells, fits = _without_lines(point, [force_colour.cells_of(point, i) for i in places])
    together, found = _fall(point, places, cells, fits, EXPLAINED)
    if found is not None and together - (df := sum(c.n.size - 4 for c in cells)) < CHANCE * np.sqrt(2.0 * df):
        return dict.fromkeys(data.places, found)
    nodes = [(own, *_fall(point, own, [cells[i] for i in own], [fits[i] for i in own], ALIKE))
             for own in devices(data.places)]  # fmt: skip
    apart = {data.places[i]: off for own, _, off in nodes if off is not None for i in own}
    less = together - sum(after for _, after, _ in nodes)
    if apart and (found is None or chdtrc(POWERS.size * (len(nodes) - 1), less) < LEVEL):
        return apart
    return None if found is None else dict.fromkeys(data.places, found)


def _fall(
    point: WorkingPoint, places: list[int], cells: list[Cells], fits: list[Plain], explained: float
) -> tuple[float, Filter | None]:
    """Deviance of some places behind what they fall alike by, and that; without it where nothing falls, or something
    else fits better. explained : of the misfit beyond chance, at least."""
    hz, count = cells[0].w / (2 * np.pi), cells[0].n
    before, df = -2 * sum(level for level, _, _ in fits), float(sum(c.n.size - 4 for c in cells))
    highest = max(force_colour.resonance_hz(point, i) for i in places)
    falls = suspected(np.stack([_ratio(*z) for z in zip(cells, fits, strict=True)], axis=1), hz, count, highest)
    if not falls and before - df < MISFIT * np.sqrt(2 * df):
        return before, None
    after, found = _likeliest(point, places, cells, fits)
    fall = -np.log(found.passed(hz))
    rms = float(np.sqrt(np.average((fall - np.average(fall, weights=count)) ** 2, weights=count)))
    if chdtrc(POWERS.size, before - after) > LEVEL or rms < LEAST:
        return before, None
    if after - df > max((1 - explained) * (before - df), CHANCE * np.sqrt(2 * df)):
        return before, None
    other = sum(force_colour.otherwise(point, i, c, *fit) for i, c, fit in zip(places, cells, fits, strict=True))
    return (after, found) if after < other + BEHIND else (before, None)


def _likeliest(
    point: WorkingPoint, places: list[int], cells: list[Cells], fits: list[Plain]
) -> tuple[float, Filter]:  # fmt: skip
    """Akaike's information (deviance and twice the number of numbers) of all places behind the filter that explains
    them best, and that filter: means over a sample, the poles of a design, both, with what they fold back, or a fall of
    any form that folds nothing back."""
    blank = Filter(point.data.rate_hz, point.data.band[1])

    def tried(made: Callable[[list[float]], Filter], *numbers: Number) -> tuple[float, Filter]:
        deviance, found = _joint(point, places, cells, fits, made, numbers)
        return deviance + 2 * len(numbers), found

    def poles(name: str, own: tuple[float, ...], z: list[float]) -> Filter:
        cutoff = CUTOFF * blank.rate_hz * float(np.exp(z[0]))
        return replace(blank, poles=own, cutoff_hz=cutoff, name=name, means=sum(z[1:]))

    ways = [tried(lambda z: replace(blank, means=z[0]), (1.0, 0.0, MOST_MEANS))]
    ways += [tried(partial(poles, *design), (0.0, -WIDE, WIDE)) for design in designs().items()]
    ways.append(tried(lambda z: replace(blank, nepers=tuple(z)), *[(0.01, 0.0, np.inf)] * POWERS.size))
    best = min(ways, key=lambda way: way[0])
    if not (own := best[1]).poles:
        return best
    cutoff = float(np.log(own.cutoff_hz / CUTOFF / blank.rate_hz))
    both = tried(partial(poles, own.name, own.poles), (cutoff, -WIDE, WIDE), (0.5, 0.0, MOST_MEANS))
    return min(best, both, key=lambda way: way[0])


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
    point: WorkingPoint,
    places: list[int],
    cells: list[Cells],
    fits: list[Plain],
    made: Callable[[list[float]], Filter],
    numbers: Sequence[Number],
) -> tuple[float, Filter]:
    """Deviance of all places behind one filter, and that. made : the filter of its numbers."""
    from scipy.optimize import least_squares

    data, hz = point.data, cells[0].w / (2 * np.pi)
    count, number = len(numbers), len(places)
    first, least, most = np.array(numbers).T
    roots = [np.sqrt(c.n) for c in cells]
    scales = np.concatenate([np.full(count, SCALE), *(s for _, _, s in fits)])
    start = np.concatenate([first, *(u for _, u, _ in fits)]) / scales
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[:count], high[:count] = least / SCALE, most / SCALE
    through = [_through(point, i, hz) for i in places]

    def residual(z: Array) -> Array:
        z = z * scales
        off, own = made(z[:count].tolist()), z[count:].reshape(number, 4)
        passed, out = off.passed(hz), []
        for i, c, root, u, white in zip(places, cells, roots, own, through, strict=True):
            behind = replace(c, back=off.folded(hz, data.kinds[i]) * white)
            spectrum = behind.spectrum(u, c.tangent(u), passed)
            out.append(force_colour.deviance(root, c.power / np.maximum(spectrum, 1e-300)))
        return np.concatenate(out)

    found = least_squares(residual, start, bounds=(low, high), max_nfev=60)
    return 2 * float(found.cost), made((found.x[:count] * SCALE).tolist())


def _through(point: WorkingPoint, i: int, hz: Array) -> Array:
    """(cells,) PSD over S of the inferred force at a place, of white noise at all that a free mass has from its S."""
    data = point.data
    share = np.abs(point.A[:, i]) ** 2 @ (point.S / point.S[i] / data.mass**2)
    return np.asarray(np.interp(hz, data.f_hz, share))
