"""Ranking of candidate effects from trials at single locations and from findings that are no law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import CATALOGUE, LINE_NAMES, NAMED
from estimator.effects.places import at
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.identification.finding import UNKNOWN_EFFECT, Finding
from estimator.identification.machine import is_mains_multiple
from estimator.identification.residual import stiffness_order
from estimator.identification.residual.group_fit import extra_power
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.effect import Effect
from estimator.model.rig import Model
from estimator.results import Message, Parameter

from .trial import Trial

Settings = dict[str, dict[str, Parameter]]  # by canonical place, by name


LARGE_AMPLITUDES = "large amplitudes"  # name of the gate


@dataclass(frozen=True, slots=True, kw_only=True)
class GateResult:
    """Answer of a gate on a candidate.

    Parameters
    ----------
    gate : str
        Name of the gate.
    passed : bool
        Whether the candidate may be named, as far as this gate goes.
    measured, limit : float or None
        The number that was compared, and with what; None where the gate does not concern the candidate.
    text : str
        What the number is, with its unit, for the user.
    """

    gate: str
    passed: bool
    measured: float | None = None
    limit: float | None = None
    text: str = ""

    def __str__(self) -> str:
        if self.measured is None:
            return f"{self.gate}: does not apply"
        said = "passed" if self.passed else "refused"
        return f"{self.gate}: {self.text} {self.measured:.3g}, limit {self.limit:.3g}: {said}"


@dataclass(frozen=True, slots=True)
class Entry:
    """A candidate effect with its evidence.

    effect : name. at : nodes, such as "bearing1". gain : nats on the record. heldout_gain : nats on held-out folds.
    p_value : after counting all effects and places. before_percent, after_percent : missing force at the places of the
    effect without and with it, per cent of the rms bearing force. parameters : by full name, SI. score : nats, by which
    the ranking is sorted. explained_percent : rms of the effect's own force over the bearing force. placed : laws of a
    force effect. detectable : smallest amplitude that would be claimed in this record, and its unit; None if unknown.
    settings : parameters of an effect that is no force law, by its name in a model. notes : for the user.
    by_node : gain and heldout_gain of a law at each node, nats. folds : nats gained on each held-out time fold, or part
    of the band; empty where they are not known. gates : those that were asked, in order; only the last one may have
    refused.
    """

    effect: str
    at: tuple[str, ...]
    gain: float
    heldout_gain: float
    _: KW_ONLY
    p_value: float
    before_percent: float = 0.0
    after_percent: float = 0.0
    parameters: dict[str, Parameter]
    score: float
    explained_percent: float = 100.0
    placed: tuple[LocatedLaw, ...] = ()
    detectable: tuple[float, str] | None = None
    settings: dict[str, Settings] = field(default_factory=dict)
    notes: tuple[Message, ...] = ()
    by_node: dict[str, tuple[float, float]] = field(default_factory=dict)
    folds: tuple[float, ...] = ()
    gates: tuple[GateResult, ...] = ()

    @property
    def heldout_gain_sd(self) -> float | None:
        """Standard error of the held-out gain, nats, by the scatter of the folds; None where they are not known."""
        return float(np.std(self.folds, ddof=1) * np.sqrt(len(self.folds))) if len(self.folds) > 1 else None

    @property
    def amplitude_gain(self) -> float | None:
        """Nats on the largest amplitudes by parameters fitted to the smaller ones; None if not judged."""
        return next((g.measured for g in self.gates if g.gate == LARGE_AMPLITUDES), None)

    @property
    def passed(self) -> bool:
        """Whether every gate was asked and passed."""
        return bool(self.gates) and self.gates[-1].passed

    @property
    def force_explained_percent(self) -> float:
        """Rms of the missing force that the effect explains at its places, per cent of the bearing force."""
        return float(np.sqrt(max(self.before_percent**2 - self.after_percent**2, 0.0)))

    @property
    def explained_limits_percent(self) -> tuple[float, float]:
        """95 % limits of the rms of the effect's own force, per cent of the bearing force, by its gain in nats."""
        sd = self.explained_percent / np.sqrt(2.0 * max(self.gain, 1e-6))
        return float(self.explained_percent - 1.96 * sd), float(self.explained_percent + 1.96 * sd)

    @property
    def law(self) -> Effect | None:
        """The effect of the candidate where that is a force law, else None."""
        return self.placed[0].effect if self.placed else None

    @property
    def places(self) -> set[int]:
        """Indices of the places at which the law acts."""
        return {i for law in self.placed for i in law.at}

    def to_json(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "effect": self.effect,
            "at": list(self.at),
            "heldout_gain": self.heldout_gain,
            "p_value": self.p_value,
            "missing_force_before_percent": self.before_percent,
            "missing_force_after_percent": self.after_percent,
            "parameters": {k: p.to_json() for k, p in self.parameters.items()},
        }
        if self.detectable is not None:
            out["detectable_from"] = {"value": self.detectable[0], "unit": self.detectable[1]}
        if self.amplitude_gain is not None:
            out["heldout_amplitude_gain"] = self.amplitude_gain
        if (sd := self.heldout_gain_sd) is not None:
            out["heldout_gain_sd"] = sd
            out["folds_gained"] = sum(gain > 0.0 for gain in self.folds)
        if self.gates:
            out["gates"] = [str(gate) for gate in self.gates]
        return out | ({"notes": [note.text for note in self.notes]} if self.notes else {})


def ranked_entries(
    model: Model, point: WorkingPoint, trials: Sequence[Trial], before: MissingForce, others: Sequence[Finding] = ()
) -> list[Entry]:
    """The ranking: one entry per effect, best first."""
    tried = max(len(trials), 1)
    by_effect: dict[str, list[Trial]] = {}
    for t in trials:
        by_effect.setdefault(t.effect.name, []).append(t)
    out = [_entry(point, own, tried, before) for own in by_effect.values()]
    if model.order_found:  # by the same data
        more = stiffness_order.order_trials(point)
        out = [replace(e, p_value=min(1.0, e.p_value * more)) if e.effect == BALL_PASS.name else e for e in out]
    others = [s for s in others if s.effect != UNKNOWN_EFFECT and not _is_known_line(model, s)]
    for name in dict.fromkeys(s.effect for s in others):
        out.append(_finding_entry(model, point, [s for s in others if s.effect == name], before))
    return in_order(out)


def is_sure_law(entry: Entry) -> bool:
    """Whether a law is significant and gains as many held-out nats as separate two candidates."""
    significant = entry.p_value <= THRESHOLDS.max_p_value and entry.heldout_gain >= THRESHOLDS.rival_nats
    return bool(entry.placed) and significant


def _is_known_line(model: Model, finding: Finding) -> bool:
    """Whether a finding is a line that the machine layer explains, or beside the band.

    Hum of the mains may be too weak for the machine layer.
    """
    if finding.effect not in LINE_NAMES:
        return False
    hz = next(iter(finding.settings.values()))["frequency"].value or 0.0
    low, high = model.band
    return (
        is_mains_multiple(hz)
        or not low < hz < high
        or any(band.has_cause and band.holds(hz) for band in model.record_lines or ())
    )


def in_order(found: Sequence[Entry]) -> list[Entry]:
    """Candidates in order: first those that explain about the most missing force, then the others, both by nats."""
    significant = [e.force_explained_percent for e in found if e.p_value <= THRESHOLDS.max_p_value]
    least = THRESHOLDS.same_force_min_rel * max(significant, default=0.0)
    return sorted(found, key=lambda e: (e.force_explained_percent < least, -e.score))


def _entry(point: WorkingPoint, own: list[Trial], tried: int, before: MissingForce) -> Entry:
    nodes: dict[str, list[Trial]] = {}
    for t in own:
        nodes.setdefault(t.location.split(".")[0], []).append(t)
    odds = {n: _node_p_value(ts) for n, ts in nodes.items()}
    best = min(odds, key=lambda n: (odds[n], -sum(t.gain for t in nodes[n])))
    at = tuple(n for n in nodes if n == best or odds[n] * tried < THRESHOLDS.further_bearing_max_p_value)
    used = [t for n in at for t in nodes[n]]
    gain = _gain(used)
    df = sum(t.df for t in used)
    folds = np.sum([t.heldout for t in used], axis=0)
    heldout = float(folds.sum())
    p = min(1.0, min(odds[n] for n in at) * tried)
    places = tuple(sorted({i for t in used for i in t.placed.at}))
    scale = float(np.sum(before.bearing_force_N[list(places)] ** 2))
    power = sum(max(extra_power(point, t.problem, t.fit)[0], 0.0) for t in used)
    was = before.interval(places)[0]
    explained = 100 * float(np.sqrt(power / scale))
    if not was and p <= THRESHOLDS.max_p_value:  # no regressor on the states shows it
        was = explained
    left = max(was**2 - explained**2, 0.0) ** 0.5
    return Entry(
        effect=used[0].effect.name,
        at=at,
        gain=gain,
        heldout_gain=heldout,
        p_value=p,
        before_percent=was,
        after_percent=left,
        parameters={k: v for t in used for k, v in _parameters(point, t).items()},
        score=gain - THRESHOLDS.parameter_cost_nats * df if heldout > -3.0 else -np.inf,
        explained_percent=explained,
        placed=tuple(t.placed for t in used),
        detectable=_detectable(used),
        notes=_part_note(point, used),
        by_node={n: (_gain(nodes[n]), float(sum(t.heldout.sum() for t in nodes[n]))) for n in at},
        folds=tuple(folds.tolist()),
    )


def without_nodes(entry: Entry, nodes: Sequence[str]) -> Entry:
    """The entry of a law without some of its nodes."""
    by_node = {n: nats for n, nats in entry.by_node.items() if n not in nodes}
    placed = tuple(p for p in entry.placed if p.key.split(".")[0] not in nodes)
    return replace(
        entry,
        at=tuple(n for n in entry.at if n not in nodes),
        gain=sum(gain for gain, _ in by_node.values()),
        heldout_gain=sum(heldout for _, heldout in by_node.values()),
        parameters={k: v for k, v in entry.parameters.items() if k.split(".")[0] not in nodes},
        placed=placed,
        by_node=by_node,
    )


def _gain(trials: Sequence[Trial]) -> float:
    return sum(max(t.gain, 0.0) for t in trials)


def _part_note(point: WorkingPoint, used: Sequence[Trial]) -> tuple[Message, ...]:
    """The remark on the part of the record that an effect was judged on; none where that is all of the record."""
    seconds = max(t.problem.blocks.sum() for t in used) * point.data.block / point.data.rate_hz
    if seconds > 0.99 * point.data.seconds:
        return ()
    text = f"gain and p-value come from {seconds:.0f} s of the record: the rest could not change the verdict"
    return (Message("judged_on_part", text),)


def _finding_entry(model: Model, point: WorkingPoint, own: list[Finding], before: MissingForce) -> Entry:
    """Entry of an effect that is not a force law."""
    gain, df = sum(s.gain_nats for s in own), sum(s.dof for s in own)
    regions = dict.fromkeys(s.region for s in own)
    places = tuple(sorted({i for s in own for i in s.power_N2}))
    was = before.interval(places)[0]
    scale = float(np.sum(before.bearing_force_N[list(places)] ** 2))
    part_percent2 = 1e4 * sum(p for s in own for p in s.power_N2.values()) / scale
    if own[0].effect in PERIODIC_EFFECTS:  # its lines are left out of the missing force
        before_percent, after_percent = (was**2 + part_percent2) ** 0.5, was
    else:
        before_percent, after_percent = was, max(was**2 - part_percent2, 0.0) ** 0.5
    settings = _layers(model, own)
    return Entry(
        effect=own[0].effect,
        at=tuple(dict.fromkeys(p.split(".")[0] for s in own for p in s.at)),
        gain=gain,
        heldout_gain=gain - df,
        p_value=min(s.p_value for s in own),
        before_percent=min(before_percent, 100.0),
        after_percent=after_percent,
        explained_percent=part_percent2**0.5,
        parameters=named_parameters(settings),
        score=gain - THRESHOLDS.parameter_cost_nats * df,
        detectable=own[0].detectable,
        settings=settings,
        folds=tuple(np.sum([s.folds for s in own], axis=0).tolist()) if all(s.folds for s in own) else (),
        notes=tuple(
            Message("found_where" if k < len(regions) else "found_advice", text)
            for k, text in enumerate(dict.fromkeys([*regions, *(s.note for s in own if s.note)]))
        ),
    )


def _layers(model: Model, own: list[Finding]) -> dict[str, Settings]:
    """Settings by the name that they would have in the model: of several lines at a place each has its own."""
    layers: list[Settings] = []
    for s in own:
        for place, values in s.settings.items():
            free = next((layer for layer in layers if place not in layer), None)
            if free is None:
                layers.append(free := {})
            free[place] = values
    if own[0].effect not in LINE_NAMES:
        return {own[0].effect: layers[0]} if layers else {}
    taken = {u.name: set(at(NAMED[u.name], u, model)) for u in model.effects if u.name in LINE_NAMES}
    out: dict[str, Settings] = {}
    for layer in layers:
        name = next((n for n in LINE_NAMES if not taken.get(n, set()).intersection(layer) and n not in out), None)
        if name is not None:
            out[name] = layer
    return out


def named_parameters(settings: dict[str, Settings]) -> dict[str, Parameter]:
    """Parameters by full name. settings : by effect, place and name."""
    return {
        f"{place}.{effect}.{name}": p
        for effect, own in settings.items()
        for place, values in own.items()
        for name, p in values.items()
    }


def with_settings(entry: Entry, settings: dict[str, Settings]) -> Entry:
    """The entry of an effect that is no force law, with other settings."""
    return replace(entry, settings=settings, parameters=named_parameters(settings))


def _node_p_value(trials: list[Trial]) -> float:
    """p-value of the gains of one bearing together."""
    gain, df = sum(max(t.gain, 0.0) for t in trials), sum(t.df for t in trials)
    together = float(chdtrc(df, 2 * gain))
    return min(1.0, 2 * min(together, *(len(trials) * t.p_value for t in trials)))


def _parameters(point: WorkingPoint, t: Trial) -> dict[str, Parameter]:
    out = {}
    for k, q in enumerate(t.effect.parameters):
        name = f"{t.placed.key}.{q.name}"
        if q.linear:
            value, sd = t.values.get(q.name, (0.0, 0.0))
            if q.name not in t.values:
                out[name] = Parameter(value=None, sd=None, unit=q.unit, identifiable=False, reason="not needed")
                continue
            out[name] = Parameter.from_estimate(value, sd, q.unit)
        elif not t.placed.free[k]:
            out[name] = Parameter(value=float(t.placed.p[k]), sd=0.0, unit=q.unit, identifiable=True, reason="given")
        else:
            # found by search: the width over which the gain falls by 1/2, from the strength of the evidence
            value = float(t.placed.p[k])
            sd = abs(value) / max(np.sqrt(2 * max(t.gain, 0.0)), 1e-6) * 0.5
            out[name] = Parameter.from_estimate(value, sd, q.unit)
    return out


def _detectable(trials: list[Trial]) -> tuple[float, str] | None:
    """Amplitude that would be claimed in this record: about 5 standard deviations (p = 1e-3 after counting)."""
    best = max(trials, key=lambda t: t.gain)
    if not best.spread:
        return None
    name, sd = next(iter(best.spread.items()))
    unit = next(q.unit for q in best.effect.parameters if q.name == name)
    return float(5.0 * sd), unit


def separation_text(ranking: Sequence[Entry]) -> str:
    """The evidence that separates the first candidate from the others, in words; "A or B or C" where there is none."""
    if len(ranking) < 2:
        return ""
    first, second = ranking[0], ranking[1]
    rivals = [e for e in ranking[1:] if e.passed and first.gain - e.gain < THRESHOLDS.rival_nats]
    effect = CATALOGUE.get(first.effect)
    apart = f"; {effect.distinguish}" if effect is not None and second.effect in effect.confused_with else ""
    ahead = first.gain - (rivals or [second])[-1].gain
    if rivals:
        names = " or ".join(dict.fromkeys(e.effect for e in (first, *rivals)))
        return f"{names}: the record hardly separates these ({ahead:.0f} nats){apart}"
    if ahead < 0.0:
        return f"{second.effect} is {-ahead:.0f} nats ahead of {first.effect} but does not pass{apart}"
    return f"{first.effect} is {ahead:.0f} nats ahead of {second.effect}{apart}"
