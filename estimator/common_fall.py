"""Whether the spectra of all inferred forces fall alike, or those of each bearing, as behind filters of one recorder or
of two: roll_off.py."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import force_colour
from .filter_search import Seen, likeliest
from .force_colour import Cells
from .roll_off import POWERS, Filter, RollOff, devices
from .side_by_side import answers
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Plain = tuple[float, Array, Array]  # likelihood, numbers and their scales: force_colour.plain
LEVEL = 1e-6
LEAST = 0.002  # rms of ln(power) over the band, from where it matters to S
EXPLAINED = 0.5  # of the misfit beyond chance
ALIKE = 0.8  # the same of two channels of a bearing: one that falls beside one that does not leaves half
CHANCE = 3.0  # standard deviations of a deviance
WAVES, LOOK = 12, 1e-4  # half waves along the band, and chance of them, of what is looked into
LINE, LINES = 6.0, 0.1  # standard deviations that a line raises a cell by; of the cells, those that lines may have
BEHIND = 12.0  # in deviance and a place, that causes of other kinds, two numbers each, may fit better by (Schwarz)


def find(point: WorkingPoint) -> RollOff | None:
    """None where nothing falls, or something else fits better. A place whose force has a colour in the model takes the
    filter that the others show: what falls there is within the colour."""
    data, whole = point.data, [*range(len(point.data.places))]
    if data.measured_force or point.kL.min() <= 0.0:
        return None
    places = [i for i in whole if np.ptp(data.colour[i]) == 0.0] or whole
    cells, fits = _without_lines(point, [force_colour.cells_of(point, i) for i in places])
    together, found = _fall(point, places, cells, fits, EXPLAINED)
    if found is not None and together - (df := sum(c.n.size - 4 for c in cells)) < CHANCE * np.sqrt(2.0 * df):
        return dict.fromkeys(data.places, found)
    names = tuple(data.places[i] for i in places)
    nodes = [(own, *_fall(point, [places[k] for k in own], [cells[k] for k in own], [fits[k] for k in own], ALIKE))
             for own in devices(names)]  # fmt: skip
    deviance, most = _all_but_one(point, places, cells, fits) if len(places) > 1 else (np.inf, None)
    if most is not None and deviance < (sum(after for _, after, _ in nodes) if nodes else together):
        return dict.fromkeys(data.places, most)
    apart = {names[k]: off for own, _, off in nodes if off is not None for k in own}
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
    if not _in_common(cells, fits):
        return before, None
    seen = [Seen(c, _through(point, i, hz), point.data.kinds[i]) for i, c in zip(places, cells, strict=True)]
    after, found = likeliest(seen, Filter(point.data.rate_hz, point.data.band[1]))
    fall = -np.log(found.passed(hz))
    rms = float(np.sqrt(np.average((fall - np.average(fall, weights=count)) ** 2, weights=count)))
    if chdtrc(POWERS.size, before - after) > LEVEL or rms < LEAST:
        return before, None
    if after - df > max((1 - explained) * (before - df), CHANCE * np.sqrt(2 * df)):
        return before, None
    asked = zip(places, cells, fits, strict=True)
    other = sum(answers([partial(force_colour.otherwise, point, i, c, *fit) for i, c, fit in asked]))
    return (after, found) if after < other + BEHIND * len(places) else (before, None)


def _all_but_one(
    point: WorkingPoint, places: list[int], cells: list[Cells], fits: list[Plain]
) -> tuple[float, Filter | None]:
    """Deviance of all places, and what all but some one fall by, if what that one has of its own, as a sensor's
    resonance or noise, is likelier behind the same filter."""
    best, found = np.inf, None
    for one, (i, c, fit) in enumerate(zip(places, cells, fits, strict=True)):
        rest = [k for k in range(len(places)) if k != one]
        after, off = _fall(point, [places[k] for k in rest], [cells[k] for k in rest], [fits[k] for k in rest], ALIKE)
        if off is None:
            continue
        hz = c.w / (2 * np.pi)
        back = off.folded(hz, point.data.kinds[i]) * _through(point, i, hz)
        behind = replace(c, colour=c.colour * off.passed(hz), back=c.back + back)
        own = force_colour.otherwise(point, i, behind, *force_colour.plain(point, i, behind))
        if after + own < best and own < force_colour.otherwise(point, i, c, *fit):
            best, found = after + own, off
    return best, found


def _in_common(cells: list[Cells], fits: list[Plain]) -> bool:
    """Whether the spectra have anything smooth in common beside the model: a cheap look before a search. 3 % of ripple
    in all of four is 36 powers of ten from chance, where the deviance of their 900 cells is 3.4 standard deviations."""
    off = sum((_ratio(c, fit) - 1.0) * np.sqrt(c.n) for c, fit in zip(cells, fits, strict=True)) / np.sqrt(len(cells))
    x, n = np.pi * cells[0].w / cells[0].w[-1], np.sqrt(cells[0].n)
    Q, _ = np.linalg.qr(n[:, None] * np.cos(np.multiply.outer(x, np.arange(1, WAVES + 1))))
    return bool(chdtrc(WAVES, float(np.sum((Q.T @ off) ** 2))) < LOOK)


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


def _through(point: WorkingPoint, i: int, hz: Array) -> Array:
    """(cells,) PSD over S of the inferred force at a place, of white noise at all that a free mass has from its S."""
    data = point.data
    share = np.abs(point.A[:, i]) ** 2 @ (point.S / point.S[i] / data.mass**2)
    return np.asarray(np.interp(hz, data.f_hz, share))
