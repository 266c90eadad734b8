"""The anti-alias roll-off that the residual forces have in common: of all channels, or of each bearing's recorder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtrc

from estimator.arrays import Array
from estimator.effects.excitation.coloured_excitation import COLOURED_EXCITATION
from estimator.effects.sensor.sensor_resonance import SENSOR_RESONANCE
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.recorder import POWERS, Filter, RollOff, devices, images
from estimator.model.rig import Model
from estimator.parallel import map_processes
from estimator.signals.channel_response import fitted_shape

from . import spectral_models
from .filter_search import Seen, Standing, likeliest, mean_or_none
from .spectral_cells import SpectralCells, cells_of

BaseFit = tuple[float, Array, Array]  # likelihood, numbers and their scales: force_shapes.plain
NumberPair = tuple[float, float] | None
ShapeNumbers = tuple[
    NumberPair, NumberPair, Standing | None
]  # the numbers of the sensor's resonance, of the colour and of the pedestal
MeasuredPlace = tuple[int, SpectralCells, BaseFit]  # its index, its cells and the model fitted to them
MAX_FALL_P_VALUE = 1e-6
MIN_FALL_RMS = 0.002  # of ln(power) over the band, from which a roll-off matters to S
MIN_EXPLAINED_SHARE = 0.5  # of the misfit beyond chance
MIN_EXPLAINED_SHARE_PAIR = 0.8  # of the misfit of two channels of one bearing: if one has no roll-off, half remains
NO_SHAPES: Mapping[int, ShapeNumbers] = {}
DEVIANCE_MARGIN_SD = 3.0  # standard deviations of a deviance
HALF_WAVES = 12  # along the band, of the common misfit that is examined
LOOK_P_VALUE = 1e-4  # of the common misfit that is examined
MAX_CELL_SD = 6.0  # of a cell above the model: more is a line
MAX_LINE_CELLS_SHARE = 0.1  # of the cells
RIVAL_MARGIN_DEVIANCE = 12.0  # per place, that causes of other kinds with two numbers each may fit better by (Schwarz)


def find_roll_off(model: Model, point: WorkingPoint) -> RollOff | None:
    """The roll-off by location; None where there is none, or where something else fits better.

    A location with a shaped excitation, a pedestal or an undone sensor resonance takes the filter that the others show,
    as its own shape contains it. If no other location shows one, the filter is fitted together with these shapes.
    Locations that cannot be judged, as behind a clipped channel, take it too.
    """
    data, whole = point.data, _judged_places(point)
    if not whole:
        return None
    shapes = [_shape_numbers(model, point, i) for i in range(len(data.places))]
    shaped = {i: shapes[i] for i in whole if any(shapes[i])}
    plain = [i for i in whole if i not in shaped]
    found = _roll_off_of(point, measured_cells(point, plain)) if plain else None
    if found is not None or not shaped:
        return found
    own = measured_cells(point, whole)
    stands_out = any(chdtrc(c.n.size - 4.0, -2 * fit[0]) < LOOK_P_VALUE for i, c, fit in own if i in shaped)
    off = common_fall(point, own, MIN_EXPLAINED_SHARE, shaped)[1] if stands_out or _have_common_misfit(own) else None
    if off is not None:
        return dict.fromkeys(data.places, off)
    standing = [i for i in whole if not any(shapes[i][:2])]  # what is too little to be told from pedestals, beside them
    if len(standing) == len(plain):
        return None
    return _roll_off_of(point, own if standing == whole else measured_cells(point, standing))


def level_doubt(model: Model, point: WorkingPoint) -> float:
    """Relative standard deviation of S where no filter is found, as an averaging filter would be as likely."""
    whole = _judged_places(point)
    if not whole:
        return 0.0
    seen = _seen_places(point, measured_cells(point, whole), {i: _shape_numbers(model, point, i) for i in whole})
    return mean_or_none(seen, _blank_filter(point))[1]


def _judged_places(point: WorkingPoint) -> list[int]:
    """Indices of locations from which a filter is identified."""
    whole = [*range(len(point.data.places))]
    return [] if point.data.measured_force or not whole or point.kL[whole].min() <= 0.0 else whole


def _blank_filter(point: WorkingPoint) -> Filter:
    """A filter of the record's rate and band without roll-off."""
    return Filter(point.data.rate_hz, point.data.band[1])


def _seen_places(point: WorkingPoint, own: list[MeasuredPlace], shaped: Mapping[int, ShapeNumbers]) -> list[Seen]:
    return [Seen(c, point.data.kinds[i], *shaped.get(i, ())) for i, c, _ in own]


def _shape_numbers(model: Model, point: WorkingPoint, i: int) -> ShapeNumbers:
    """Numbers of sensor resonance, excitation shape and pedestal of the model at location i; None where missing."""
    resonance, colour = (
        fitted_shape(model, point.data.places[i], name) for name in (SENSOR_RESONANCE.name, COLOURED_EXCITATION.name)
    )
    for use in point.placed:
        if use.effect.adds_resonance and i in use.at:
            mass, frequency, damping = use.p.tolist()
            return resonance, colour, Standing(point.kL[i], point.c[i], (mass, frequency, damping))
    return resonance, colour, None


def _roll_off_of(point: WorkingPoint, own: list[MeasuredPlace]) -> RollOff | None:
    """The roll-off that some locations show; None without one."""
    data = point.data
    together, found = common_fall(point, own, MIN_EXPLAINED_SHARE)
    if found is not None and together - (df := sum(c.n.size - 4 for _, c, _ in own)) < DEVIANCE_MARGIN_SD * np.sqrt(
        2.0 * df
    ):
        return dict.fromkeys(data.places, found)
    names = tuple(data.places[i] for i, _, _ in own)
    nodes = [(at, *common_fall(point, [own[k] for k in at], MIN_EXPLAINED_SHARE_PAIR)) for at in devices(names)]
    each_its_own = sum(after for _, after, _ in nodes) if nodes else together
    deviance, most = _fall_of_all_but_one(point, own) if len(own) > 1 else (np.inf, None)
    if most is not None and deviance < each_its_own:
        return dict.fromkeys(data.places, most)
    apart = {names[k]: off for at, _, off in nodes if off is not None for k in at}
    if apart:  # of the other bearing too, if it shows none of its own: one recorder, not two
        off, bare = next(iter(apart.values())), [(at, after) for at, after, none in nodes if none is None]
        apart |= {
            names[k]: off for at, after in bare if explains_half(point, off, [own[k] for k in at], after) for k in at
        }
    if apart and (found is None or chdtrc(POWERS.size * (len(nodes) - 1), together - each_its_own) < MAX_FALL_P_VALUE):
        return apart
    return None if found is None else dict.fromkeys(data.places, found)


def measured_cells(point: WorkingPoint, places: list[int]) -> list[MeasuredPlace]:
    """Index, cells without lines and fitted base model of each location."""
    cells, fits = _without_lines(point, [cells_of(point, i) for i in places])
    return list(zip(places, cells, fits, strict=True))


def common_fall(
    point: WorkingPoint, own: list[MeasuredPlace], explained: float, shaped: Mapping[int, ShapeNumbers] = NO_SHAPES
) -> tuple[float, Filter | None]:
    """Deviance of some locations behind their common filter, and that filter; without a filter where there is none.

    explained : least share of the misfit beyond chance that the filter explains. A filter is refused if other causes
    fit better.
    """
    hz, count = own[0][1].w / (2 * np.pi), own[0][1].n
    before, df = -2 * sum(fit[0] for _, _, fit in own), float(sum(c.n.size - 4 for _, c, _ in own))
    seen, blank = _seen_places(point, own, shaped), _blank_filter(point)
    if (
        not shaped
        and not _have_common_misfit(own)
        and chdtrc(1.0, max(mean_or_none(seen, blank)[0], 0.0)) > MAX_FALL_P_VALUE
    ):
        return before, None
    after, found = likeliest(seen, blank)
    fall = -np.log(found.passed(hz))
    rms = float(np.sqrt(np.average((fall - np.average(fall, weights=count)) ** 2, weights=count)))
    free = sum(one.shapes for one in seen)
    if chdtrc(POWERS.size + free, before - after) > MAX_FALL_P_VALUE or rms < MIN_FALL_RMS:
        return before, None
    if after - df > max((1 - explained) * (before - df), DEVIANCE_MARGIN_SD * np.sqrt(2 * df)):
        return before, None
    other = sum(map_processes([partial(spectral_models.best_other_deviance, point, i, c, *fit) for i, c, fit in own]))
    return (after, found) if after < other + RIVAL_MARGIN_DEVIANCE * len(own) else (before, None)


def _fall_of_all_but_one(point: WorkingPoint, own: list[MeasuredPlace]) -> tuple[float, Filter | None]:
    """Deviance of all locations, and the filter of all but one.

    The remaining location's own cause must be likelier behind the same filter than without it.
    """
    best, found = np.inf, None
    for k, (i, c, fit) in enumerate(own):
        after, off = common_fall(point, own[:k] + own[k + 1 :], MIN_EXPLAINED_SHARE_PAIR)
        if off is None:
            continue
        behind = _cells_behind(point, i, c, off)
        alone = spectral_models.best_other_deviance(point, i, behind, *spectral_models.fit_base_model(point, i, behind))
        if after + alone < best and alone < spectral_models.best_other_deviance(point, i, c, *fit):
            best, found = after + alone, off
    return best, found


def explains_half(point: WorkingPoint, off: Filter, own: list[MeasuredPlace], before: float) -> bool:
    """Whether a filter explains half of some locations' misfit beyond chance. before : their deviance without it."""
    behind = [(i, _cells_behind(point, i, c, off)) for i, c, _ in own]
    after = -2 * sum(spectral_models.fit_base_model(point, i, c)[0] for i, c in behind)
    return after - (df := sum(c.n.size - 4 for _, c, _ in own)) < (1 - MIN_EXPLAINED_SHARE) * (before - df)


def _cells_behind(point: WorkingPoint, i: int, c: SpectralCells, off: Filter) -> SpectralCells:
    """The cells of location i behind a filter."""
    hz = c.w / (2 * np.pi)
    here, others = c.white
    echoes = here * off.echoes(hz, point.data.kinds[i])
    back = c.aliased_gain + echoes.sum(axis=0) + others * off.folded(hz, point.data.kinds[i])
    beyond = images(off.rate_hz, hz)[: len(echoes)]
    return replace(c, force_shape=c.force_shape * off.passed(hz), aliased_gain=back, echoes=echoes, images=beyond)


def _have_common_misfit(own: list[MeasuredPlace]) -> bool:
    """Whether the spectra have anything smooth in common beside the model: a cheap look before a search. 3 % of ripple
    in all of four is 36 powers of ten from chance, where the deviance of their 900 cells is 3.4 standard deviations."""
    off = sum((_power_ratio(c, fit) - 1.0) * np.sqrt(c.n) for _, c, fit in own) / np.sqrt(len(own))
    first = own[0][1]
    x, n = np.pi * first.w / first.w[-1], np.sqrt(first.n)
    Q, _ = np.linalg.qr(n[:, None] * np.cos(np.multiply.outer(x, np.arange(1, HALF_WAVES + 1))))
    return bool(chdtrc(HALF_WAVES, float(np.sum((Q.T @ off) ** 2))) < LOOK_P_VALUE)


def _without_lines(point: WorkingPoint, cells: list[SpectralCells]) -> tuple[list[SpectralCells], list[BaseFit]]:
    """The cells that no line raises at any location, and the base model of each location fitted to them.

    All cells are kept if lines raise too many.
    """
    whole = cells[0].n.size
    while True:
        fits = [spectral_models.fit_base_model(point, i, c) for i, c in enumerate(cells)]
        over = [
            spectral_models.deviance_residuals(np.sqrt(c.n), _power_ratio(c, fit))
            for c, fit in zip(cells, fits, strict=True)
        ]
        keep = np.max(over, axis=0) < MAX_CELL_SD
        if keep.all() or keep.sum() < (1 - MAX_LINE_CELLS_SHARE) * whole:
            return cells, fits
        cells = [c.at(keep) for c in cells]


def _power_ratio(c: SpectralCells, fit: BaseFit) -> Array:
    """(cells,) measured power over the model's."""
    return c.power / spectral_models.base_model(c, fit[1])
