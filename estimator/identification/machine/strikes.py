"""Strike trains of a rolling bearing: combs of lines in the squared envelope at the bearing's kinematic orders.

A defect of the outer ring strikes at BPFO, one of the inner ring at BPFI with sidebands at the shaft speed, as it turns
through the load, one of a ball at its spin or twice its spin with sidebands at the speed of the cage. All names are on
trial with what each predicts; the likelier one is named. Slip moves each of these orders by up to 2 %.

References
----------
Randall and Antoni, Rolling element bearing diagnostics - a tutorial, Mech. Syst. Signal Process. 25(2), 2011, 485-520.
McFadden and Smith, Model for the vibration produced by a single point defect, J. Sound Vib. 96(1), 1984, 69-82.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array
from estimator.model.bearing_theory import kinematics
from estimator.model.rig import Model
from estimator.parallel import map_threads
from estimator.results import Message

from .combs import (
    Comb,
    LineTable,
    best_comb,
    clear_harmonics,
    clear_peaks,
    clearest,
    line_tables,
    refined_fundamental,
)
from .envelope import envelope_spectra
from .machine_survey import ShaftSpeed, StrikeName, StrikeTrain
from .pieces import Pieces
from .speed import tacho_angle
from .thresholds import LIMITS

MODULATION_AT_ORDER = "modulation_at_bearing_order"
STRIKES_AMBIGUOUS = "strikes_ambiguous"
NO_SPEED_NO_STRIKES = "no_speed_no_strikes"


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinematic:
    """One way in which a defect shows itself. order : strikes per turn. sideband : distance of sidebands, orders."""

    name: StrikeName
    order: float
    sideband: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A kinematic hypothesis and its clearest comb."""

    kind: Kinematic
    comb: Comb


@dataclass(slots=True, kw_only=True)
class _ChannelSearch:
    """The clearest combs of one channel.

    tables : number of tables. named : the clearest comb of each kinematic hypothesis. free : that at any order.
    """

    named: list[Comb | None]
    free: Comb | None = None
    tables: int = 0


def kinematics_of(model: Model) -> list[Kinematic]:
    """Kinematic hypotheses of the defects of the rig's bearing; empty without geometry or a given ball-pass order."""
    if model.bearing is None:
        return [Kinematic(name="BPFO", order=model.ball_pass_order)] if model.ball_pass_order else []
    own = kinematics(model.bearing)
    return [
        Kinematic(name="BPFO", order=own["BPFO"]),
        Kinematic(name="BPFI", order=own["BPFI"]),
        Kinematic(name="BPFI", order=own["BPFI"], sideband=1.0),
        Kinematic(name="BSF", order=2 * own["BSF"]),
        Kinematic(name="BSF", order=2 * own["BSF"], sideband=own["FTF"]),
        Kinematic(name="BSF", order=own["BSF"]),
        Kinematic(name="BSF", order=own["BSF"], sideband=own["FTF"]),
        Kinematic(name="FTF", order=own["FTF"]),
    ]


def find_strikes(
    model: Model,
    y: Array,
    rate_hz: float,
    columns: Mapping[str, int],
    speed: ShaftSpeed | None,
    bank: tuple[int, ...] = LIMITS.bands_per_rate,
) -> tuple[list[StrikeTrain], list[Message]]:
    """Strike trains in some channels, clearest first, and remarks.

    y : (n, channels) SI, NaN where missing. columns : channel -> its column. bank : of the envelope spectra.
    Without a speed a train has no order and no name.
    """
    angle = tacho_angle(model, y, rate_hz)
    if angle is not None and speed is not None:
        speed = replace(speed, wander_rel=0.0)
    kinds = [] if speed is None else kinematics_of(model)

    def searched(name: str) -> _ChannelSearch:
        return _channel_search(
            name, Pieces(y[:, columns[name]], rate_hz, LIMITS.max_envelope_piece_s), speed, kinds, bank, angle
        )

    found = map_threads(searched, columns)
    log_tables = float(np.log(max(sum(own.tables for own in found), 1)))
    limit = float(np.log(LIMITS.max_false_train_chance))
    trials = _named(found, kinds)
    log_paid = log_tables + float(np.log(max(len(kinds), 1)))
    if speed is not None:
        certain = [v for v in trials if v.comb.log_p + log_paid < limit and _is_whole(v, speed)]
        if certain:
            return _reported(_ranked(certain, speed), speed, log_paid)
    free = clearest([own.free for own in found])
    if free is not None and free.log_p + log_tables < limit and _is_free_train(free):
        return _reported([(Verdict(kind=Kinematic(name="other", order=0.0), comb=free), 1.0)], speed, log_tables)
    if speed is None:
        text = "no defect of a bearing is named: the speed of the shaft is unknown (speed_rpm or a tacho channel)"
        return [], [Message(NO_SPEED_NO_STRIKES, text)]
    return [], []


def _avoided(speed: ShaftSpeed | None) -> tuple[Array, Array]:
    """Frequencies (Hz) at which an envelope has lines without a defect, and their standard deviations."""
    mains = np.unique(np.outer(LIMITS.mains_hz, np.arange(1, LIMITS.max_envelope_mains_multiple + 1)))
    if speed is None:
        return mains, LIMITS.mains_tolerance_rel * mains
    k = np.arange(1, int(LIMITS.highest_order) + 3)
    sd_hz = float(np.hypot(speed.sd_hz, LIMITS.wander_reach_sds * speed.wander_rel * speed.hz))
    hz = np.concatenate([k * speed.hz, mains])
    return hz, np.concatenate([k * sd_hz, LIMITS.mains_tolerance_rel * mains])


def _channel_search(
    channel: str,
    pieces: Pieces,
    speed: ShaftSpeed | None,
    kinds: Sequence[Kinematic],
    bank: tuple[int, ...],
    angle: Array | None,
) -> _ChannelSearch:
    """The search in the envelope spectra of one channel; of their tables only those of the clearest combs are kept."""
    out = _ChannelSearch(named=[None] * len(kinds))
    turn_hz = LIMITS.unknown_shaft_hz if speed is None else speed.hz
    spectra = envelope_spectra(pieces, LIMITS.highest_order * turn_hz, LIMITS.level_turns / turn_hz, bank, angle)
    avoided = _avoided(speed)
    for table in (table for spectrum in spectra for table in line_tables(channel, spectrum, avoided)):
        out.tables += 1
        if table is None:
            continue
        if speed is not None:
            combs = (_comb_of_kind(table, kind, speed) for kind in kinds)
            out.named = [clearest([best, comb]) for best, comb in zip(out.named, combs, strict=True)]
        out.free = clearest([out.free, _free_comb(table, speed)])
    return out


def _comb_of_kind(table: LineTable, kind: Kinematic, speed: ShaftSpeed) -> Comb | None:
    """The clearest comb of a kinematic hypothesis in one table."""
    centre = kind.order * speed.hz
    step = table.width / (LIMITS.grid_per_bin * LIMITS.harmonic_counts[-1] * table.spectrum.seconds)
    half = max(1, int(np.ceil(_slip_reach(speed) * centre / step)))
    grid: Array = np.asarray(centre + step * np.arange(-half, half + 1), dtype=np.float64)
    return best_comb(table, grid, kind.sideband * speed.hz)


def _named(found: Iterable[_ChannelSearch], kinds: Sequence[Kinematic]) -> list[Verdict]:
    """The clearest comb of every kinematic hypothesis that has one, clearest first."""
    best = [clearest(combs) for combs in zip(*(own.named for own in found), strict=True)]
    out = [Verdict(kind=kind, comb=comb) for kind, comb in zip(kinds, best, strict=bool(best)) if comb is not None]
    return sorted(out, key=lambda v: v.comb.log_p - 1e-4 * v.comb.nats)


def _is_whole(v: Verdict, speed: ShaftSpeed) -> bool:
    """Whether a comb has its first harmonic, and its fundamental lies within the slip.

    Where another cause has a line at the first harmonic, an odd one shows that the fundamental is not twice as high.
    """
    numbers, _ = clear_harmonics(v.comb)
    first = int(v.comb.table.bins_at(np.array([v.comb.hz]))[0])
    has_first = numbers[:1] == 1 if v.comb.table.usable[first] else numbers % 2 == 1
    slip = refined_fundamental(v.comb) / (speed.hz * v.kind.order) - 1.0
    return bool(np.any(has_first)) and abs(slip) <= _slip_reach(speed)


def _is_free_train(comb: Comb) -> bool:
    """Whether a comb without a kinematic name has its first harmonic and enough others."""
    numbers, _ = clear_harmonics(comb)
    return numbers.size >= LIMITS.min_free_harmonics and bool(numbers[0] == 1)


def _slip_reach(speed: ShaftSpeed) -> float:
    """Relative deviation from a kinematic order that slip and the uncertain speed allow."""
    return LIMITS.max_slip_rel + 2.0 * speed.sd_rpm / speed.value_rpm


def _ranked(certain: Sequence[Verdict], speed: ShaftSpeed) -> list[tuple[Verdict, float]]:
    """Hypotheses with the share of the envelope's periodic power that their harmonics explain, the largest first.

    A train has lines of others at some of its own, and sidebands of one are harmonics of another: the name is right
    whose harmonics are the strong lines. Of names that the record does not resolve, the one that needs less slip.
    A comb at the speed of the cage as strong as the train speaks for a ball: a defect of a ring does not turn with it.
    """
    tables = {id(v.comb.table): v.comb.table for v in certain}
    power = np.array([[_explained(v.comb, table) for table in tables.values()] for v in certain])
    share = (power / np.maximum(power.max(axis=0), 1e-30)).sum(axis=1) / len(tables)
    slip = [abs(refined_fundamental(v.comb) / speed.hz / v.kind.order - 1.0) for v in certain]
    rows = sorted(range(len(certain)), key=lambda i: (-round(float(share[i]), 2), slip[i]))
    best: dict[str, tuple[Verdict, float]] = {}
    for i in rows:
        best.setdefault(certain[i].kind.name, (certain[i], float(share[i])))
    out = list(best.values())
    alike = {v.kind.name for v, own in out if own > LIMITS.separation_share * out[0][1]}
    if {"BSF", "FTF"} <= alike:
        out.sort(key=lambda entry: entry[0].kind.name != "BSF")
    return out


def _explained(comb: Comb, table: LineTable) -> float:
    """Sum of the squared depths of modulation of the clear harmonics of a fundamental, in one table."""
    _, depths = clear_harmonics(replace(comb, table=table))
    return float(np.sum(depths**2))


def _free_comb(table: LineTable, speed: ShaftSpeed | None) -> Comb | None:
    """The clearest comb of one table at any order; without a speed at any frequency."""
    turn_hz = LIMITS.unknown_shaft_hz if speed is None else speed.hz
    low, high = LIMITS.min_free_order * turn_hz, LIMITS.max_free_order * turn_hz
    peaks = clear_peaks(table, low, len(LIMITS.free_divisors) * high, LIMITS.free_peaks)
    starts = np.unique(np.concatenate([peaks / q for q in LIMITS.free_divisors]))
    starts = starts[(starts >= low) & (starts <= high)]
    if speed is not None:
        whole = np.maximum(np.rint(starts / turn_hz), 1.0) * turn_hz
        near = np.abs(starts - whole) < LIMITS.min_free_distance_rel * whole + 1.0 / table.spectrum.seconds
        starts = starts[~near]
    searched = LIMITS.grid_per_bin * LIMITS.harmonic_counts[-1] * (high - low) * table.spectrum.seconds / table.width
    return best_comb(table, starts, searched=searched)


def _reported(
    ranked: Sequence[tuple[Verdict, float]], speed: ShaftSpeed | None, log_paid: float
) -> tuple[list[StrikeTrain], list[Message]]:
    """The train of the likeliest hypothesis, and a remark on its rivals. ranked : hypotheses with their shares."""
    first, share = ranked[0]
    hz = refined_fundamental(first.comb)
    numbers, depths = clear_harmonics(first.comb)
    order, name, table = None if speed is None else hz / speed.hz, first.kind.name, first.comb.table
    where = f"{hz:.2f} Hz" if order is None else f"{order:.3f} x shaft speed"
    if numbers[0] == 1 and depths[1:].max(initial=0.0) < LIMITS.min_strike_harmonic_rel * depths[0]:
        text = f"the vibration is modulated at {where} ({name}), too smoothly for strikes"
        return [], [Message(MODULATION_AT_ORDER, text)]
    train = StrikeTrain(
        name=name,
        order=order,
        frequency_hz=hz,
        slip_percent=100 * (order / first.kind.order - 1) if order is not None and first.kind.order else None,
        channel=table.channel,
        band_hz=table.spectrum.band_hz,
        p_value=float(np.exp(np.clip(first.comb.log_p + log_paid, -690.0, 0.0))),
        severity=float(np.sqrt(0.5 * np.sum(depths**2))),
        harmonics=int(numbers.size),
    )
    if speed is None:
        text = f"impacts repeat at {where} in {table.channel}: speed_rpm tells a bearing from the shaft or a gear"
        return [train], [Message("strikes_without_speed", text)]
    rivals = [
        f"{v.kind.name} ({v.comb.hz / speed.hz:.3f} x shaft speed)"
        for v, own in ranked[1:]
        if own > LIMITS.separation_share * share and v.kind.name != "FTF"
    ]
    if not rivals:
        return [train], []
    text = f"strikes at {where}: {name} or {' or '.join(rivals)}; the record does not tell them apart"
    return [train], [Message(STRIKES_AMBIGUOUS, text)]
