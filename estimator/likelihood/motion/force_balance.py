"""The force balance of a model as columns times coefficients: F = B Z.

Z holds the columns: band-limited a, v, x of every place, the reaction of shaft and disc, measured forces, and the
force of every effect. B = B0 + sum(beta_l L_l) is linear in the free parameters beta. A searched parameter (a gap, a
frequency) enters by the derivative of its law at the current value; its beta is the step to be made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.effects.engine.custom import effect_of
from estimator.effects.places import at, kinematic, written
from estimator.errors import DataError
from estimator.model.disc import Disc, disc_of
from estimator.model.effect import Effect
from estimator.model.rig import LINEAR_UNITS, MOTION_UNITS, Model, Setting

UNKNOWN_SETTING = Setting()


@dataclass(frozen=True, slots=True, kw_only=True)
class Law:
    """One effect acting on one place. p : (k,) current values; linear, searched : indices of its parameters."""

    effect: Effect
    key: str  # canonical place of its parameters: "bearing1.x", or "bearing1" for both directions of a node
    row: int
    p: Array
    linear: tuple[int, ...]
    searched: tuple[int, ...]
    steps: Array  # (k,) for the derivative by central differences

    def name(self, j: int) -> str:
        return f"{self.key}.{self.effect.name}.{self.effect.parameters[j].name}"


@dataclass(frozen=True, slots=True)
class Column:
    """One column of Z: kind a | v | x | u (shaft reaction) | f (measured force) of `row`'s motion, or a law's.

    For kind "law", `part` is the index of the parameter that the force is the derivative by; -1: the whole force.
    """

    kind: str
    row: int
    law: int = -1
    part: int = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Free:
    """A free parameter: its entries (row, column, coefficient) in B. searched : beta is a step from `start`."""

    name: str
    unit: str
    start: float
    entries: tuple[tuple[int, int, float], ...]
    low: float = -np.inf
    high: float = np.inf
    searched: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Balance:
    """places : rows of B; fixed : (rows, columns) B0; common : response of the shaft's reaction to displacement; disc :
    None without one on a shaft."""

    places: tuple[str, ...]
    kinds: tuple[str, ...]  # of the motion channel at each place
    columns: tuple[Column, ...]
    laws: tuple[Law, ...]
    free: tuple[Free, ...]
    fixed: Array
    common: Callable[[Array | Complexes], Complexes] | None
    disc: Disc | None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f.name for f in self.free)

    def by_itself(self, D: Array) -> Array:
        """(places, places, 2) N/m and N s/m, D less what holds the caps of a chain while its disc stands still."""
        return D if self.disc is None else D - np.multiply.outer(np.eye(len(D)), self.disc.held)

    def other(self, row: int) -> int:
        """Row of the other direction at the same node, -1 if it is not measured."""
        node, direction = self.places[row].split(".")
        name = f"{node}.{'y' if direction == 'x' else 'x'}"
        return self.places.index(name) if name in self.places else -1

    def coefficients(self, beta: Array) -> Array:
        """(rows, columns) B."""
        B = self.fixed.copy()
        for value, parameter in zip(beta, self.free, strict=True):
            for i, k, coefficient in parameter.entries:
                B[i, k] += coefficient * value
        return B


def motion_channels(model: Model) -> list[int]:
    """Index of the channel that measures the motion of each place (the first one, where there are several)."""
    moving = [(i, c.place) for i, c in enumerate(model.channels) if c.kind in MOTION_UNITS]
    return [next(i for i, place in moving if place == p) for p in model.places]


def force_channels(model: Model) -> dict[int, int]:
    """Place's row -> index of the channel with its measured force."""
    rows = {p: i for i, p in enumerate(model.places)}
    return {rows[c.place]: i for i, c in enumerate(model.channels) if c.kind == "force" and c.place in rows}


def shaft_notch(model: Model) -> tuple[float, float] | None:
    """Hz: where the disc, held by the shaft alone, resonates too sharply for a filter: bins that a fit leaves out."""
    if model.shaft == "none" or model.shaft_stiffness == 0.0 or "disc" not in model.mass:
        return None
    springs = 2.0 if model.shaft == "chain" else 4.0
    resonance = float(np.sqrt(springs * model.shaft_stiffness / model.mass["disc"]) / (2 * np.pi))
    width = model.band[0] / 6.0  # four times the resolution of the filters (bandlimit.half_length)
    return resonance - width, resonance + width


def shaft_reaction(model: Model) -> Callable[[Array | Complexes], Complexes] | None:
    """Force on a cap per displacement of the cap at the other end, N/m at Hz, complex of motion that grows or decays,
    disc eliminated; None without a shaft.

    Exact: what a filter cannot hold of a sharp resonance is the filter's affair (band_limit.py). Raises DataError.
    """
    if model.shaft == "none" or model.shaft_stiffness == 0.0:
        return None
    if model.mass.get("disc", 0.0) <= 0.0:
        raise DataError(f'shaft "{model.shaft}" needs [rig.mass] disc: give it, or set shaft = "none"')
    from estimator.model.rotor import between_caps

    ks, cs, disc, shaft = model.shaft_stiffness, model.shaft_damping, model.mass["disc"], model.shaft
    return lambda f_hz: between_caps(shaft, ks, cs, disc, 2 * np.pi * f_hz)


def _split(effect: Effect) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Indices of the parameters that the law is jointly linear in, and of the others that may be searched."""
    from estimator.effects.engine.law_loop import force_array

    linear = [j for j, p in enumerate(effect.parameters) if p.linear]
    if effect.force is not None and len(linear) > 1:
        rng = np.random.default_rng(0)
        x, v, xo, vo, t, phase = rng.normal(size=(6, 32))
        p = np.array([q.default for q in effect.parameters])
        p[linear] = rng.normal(size=len(linear))
        parts = np.zeros(32)
        for j in linear:
            only = p.copy()
            only[[k for k in linear if k != j]] = 0.0
            parts = parts + force_array(effect, only, x, v, xo, vo, t, phase)
        if not np.allclose(parts, force_array(effect, p, x, v, xo, vo, t, phase)):
            linear = linear[:1]  # a product: one amplitude, the rest is searched
    rest = [j for j, p in enumerate(effect.parameters) if j not in linear and not p.given]
    return tuple(linear), tuple(rest)


class _Entries:
    """Entries of B while a balance is built: fixed ones, and those of free parameters by name."""

    def __init__(self) -> None:
        self.of: dict[str, list[tuple[int, int, float]]] = {}
        self.about: dict[str, tuple[str, Setting, float, bool]] = {}  # unit, limits, start, whether searched
        self.fixed: list[tuple[int, int, float]] = []

    def add(self, name: str, unit: str, setting: Setting, start: float, entry: tuple[int, int, float]) -> None:
        """An entry (row, column, coefficient) of a parameter, fixed or free as its setting says."""
        if setting.fixed and setting.value is not None:
            self.fixed.append((entry[0], entry[1], entry[2] * setting.value))
            return
        self.of.setdefault(name, []).append(entry)
        self.about[name] = (unit, setting, start, False)

    def B0(self, rows: int, columns: int) -> Array:  # noqa: N802
        """(rows, columns) the part of B without free parameters."""
        out = np.zeros((rows, columns))
        for i, k, coefficient in self.fixed:
            out[i, k] += coefficient
        return out

    def free(self) -> tuple[Free, ...]:
        """The free parameters."""
        out = []
        for name, where in self.of.items():
            unit, setting, start, searched = self.about[name]
            low = -np.inf if setting.low is None else setting.low
            high = np.inf if setting.high is None else setting.high
            out.append(
                Free(
                    name=name, unit=unit, start=float(start), entries=tuple(where), low=low, high=high,
                    searched=searched,
                )
            )  # fmt: skip
        return tuple(out)


def build_balance(
    model: Model,
    sizes: Mapping[str, Mapping[str, float]] | None = None,
    values: Mapping[str, float] | None = None,
    search: bool = True,
) -> Balance:
    """The balance of a model.

    sizes : place -> natural sizes ("x", "v", "a" rms, "m" kg, "hz_peak" Hz ...), what searched parameters scale with.
    values : current values of parameters by full name, before those of the model.
    search : whether searched parameters are free (their laws need an amplitude then), or held at their values.
    """
    places, values = model.places, values or {}
    common, entries = shaft_reaction(model), _Entries()
    columns = [Column(kind, i) for kind in "avx" for i in range(len(places))]
    _add_caps(model, values, entries)
    if common is not None:
        _add_shaft(model, columns, entries)
    for i in force_channels(model):
        entries.fixed.append((i, len(columns), -1.0))
        columns.append(Column("f", i))
    laws: list[Law] = []
    for use in model.effects:
        effect = effect_of(use)
        if effect.kind not in ("force", "memory"):
            continue
        for key in at(effect, use, model):
            own = written(effect, use, model, key)
            both = effect.scope == "node"
            for row, place in enumerate(places):
                if place == key or (both and place.split(".")[0] == key):
                    size = (sizes or {}).get(place, {})
                    laws.append(_law(model, effect, key, row, own, size, values, search))
                    _add_law(laws, own, size, values, columns, entries)
    return Balance(
        places=places, kinds=tuple(model.channels[c].kind for c in motion_channels(model)), columns=tuple(columns),
        laws=tuple(laws), free=entries.free(), fixed=entries.B0(len(places), len(columns)), common=common,
        disc=disc_of(model),
    )  # fmt: skip


def _add_caps(model: Model, values: Mapping[str, float], entries: _Entries) -> None:
    """Mass, damping and stiffness of every bearing cap."""
    places = model.places
    for i, place in enumerate(places):
        linear = model.linear.get(place, {})
        mass = model.cap_mass(place)
        setting, start = Setting(mass, fixed=mass is not None), values.get(f"{place}.m", 0.0)
        entries.add(f"{place}.m", LINEAR_UNITS["m"], setting, start, (i, i, 1.0))
        for key, k in (("c", len(places) + i), ("kL", 2 * len(places) + i)):
            setting = linear.get(key, UNKNOWN_SETTING)
            start = values.get(f"{place}.{key}", setting.value or 0.0)
            entries.add(f"{place}.{key}", LINEAR_UNITS[key], setting, start, (i, k, 1.0))


def _add_shaft(model: Model, columns: list[Column], entries: _Entries) -> None:
    """The reaction of shaft and disc."""
    places = model.places
    rows = range(len(places))
    for i in rows:
        if model.shaft == "chain":
            entries.fixed.append((i, len(places) + i, model.shaft_damping))
            entries.fixed.append((i, 2 * len(places) + i, model.shaft_stiffness))
        for j in rows:
            if places[i].split(".")[1] == places[j].split(".")[1]:
                entries.fixed.append((i, len(columns) + j, 1.0))
    columns += [Column("u", i) for i in rows]


def _law(
    model: Model, effect: Effect, key: str, row: int, own: Mapping[str, Setting], size: Mapping[str, float],
    values: Mapping[str, float], search: bool,
) -> Law:  # fmt: skip
    """The law of an effect at a row, with current values of its parameters."""
    linear, rest = _split(effect)
    p, steps = np.zeros(len(effect.parameters)), np.zeros(len(effect.parameters))
    searched = []
    for j, q in enumerate(effect.parameters):
        setting, name = own.get(q.name, UNKNOWN_SETTING), f"{key}.{effect.name}.{q.name}"
        scale = size.get(q.scale, 1.0)
        known = values.get(name, setting.value)
        if known is None:
            known = kinematic(q.scale, model)
        p[j] = q.default * scale if known is None else known
        least = scale if j in rest and (q.scale != "1" or p[j] == 0.0) else 0.0
        steps[j] = 1e-3 * max(abs(p[j]), least)
        if search and j in rest and not setting.fixed and kinematic(q.scale, model) is None:
            searched.append(j)
    return Law(effect=effect, key=key, row=row, p=p, linear=linear, searched=tuple(searched), steps=steps)


def _add_law(
    laws: list[Law], own: Mapping[str, Setting], size: Mapping[str, float], values: Mapping[str, float],
    columns: list[Column], entries: _Entries,
) -> None:  # fmt: skip
    """The columns of the last law and the entries of its parameters."""
    law, number = laws[-1], len(laws) - 1
    if not law.linear:
        entries.fixed.append((law.row, len(columns), 1.0))
        columns.append(Column("law", law.row, number))
    for j in (*law.linear, *law.searched):
        q, name = law.effect.parameters[j], law.name(j)
        setting = own.get(q.name, UNKNOWN_SETTING)
        start = law.p[j] if j in law.searched else values.get(name, setting.value or 0.0)
        entries.add(name, q.unit, setting, start, (law.row, len(columns), 1.0))
        if name in entries.about:
            scale = size.get(q.scale, 1.0) if j in law.searched else 1.0
            low = q.low * scale if setting.low is None else setting.low
            high = q.high * scale if setting.high is None else setting.high
            entries.about[name] = (q.unit, Setting(setting.value, False, low, high), start, j in law.searched)
        columns.append(Column("law", law.row, number, j))


def restrict(balance: Balance, laws: set[int]) -> tuple[Balance, list[int]]:
    """The balance that has only these laws, and the indices of the columns that are left."""
    order = sorted(laws)
    keep = [k for k, c in enumerate(balance.columns) if c.kind != "law" or c.law in laws]
    new = {k: i for i, k in enumerate(keep)}
    columns = tuple(
        replace(balance.columns[k], law=order.index(balance.columns[k].law))
        if balance.columns[k].kind == "law"
        else balance.columns[k]
        for k in keep
    )
    free = []
    for f in balance.free:
        left = tuple((i, new[k], x) for i, k, x in f.entries if k in new)
        if left:
            free.append(replace(f, entries=left))
    return (
        replace(
            balance,
            columns=columns,
            laws=tuple(balance.laws[i] for i in order),
            free=tuple(free),
            fixed=balance.fixed[:, keep],
        ),
        keep,
    )
