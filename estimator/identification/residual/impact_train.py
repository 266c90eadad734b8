"""Impact trains in the spectrum of the motion: all harmonics of one frequency, each of which may be weak.

A train at an order of the bearing's geometry, or at the spacing of lines that stand out, is examined directly. Any
other train is searched by the sum of |Y|^2 over its noise at the first harmonics of every frequency; under noise alone
this is a sum of exponential variables. One line contributes little to it. Tones that happen to be multiples of one
frequency, as mains hum, lack some orders; short equal impacts have all orders, each of nearly the strength of its
neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from estimator.arrays import Array
from estimator.effects.places import kinematic
from estimator.effects.rotating.local_defect import LOCAL_DEFECT
from estimator.identification.finding import Finding
from estimator.likelihood.path.working_point import WorkingPoint, tangent_at
from estimator.model.bearing_theory import kinematics
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.line_spectrum import LineSpectrum, hann_peak_offset_bins

from . import harmonic_fit
from .thresholds import LIMITS

NEIGHBOUR_BINS = np.arange(4, 16)  # on either side of a line, for its noise


def find_impact_train(
    model: Model, point: WorkingPoint, s: LineSpectrum, lines: list[float], rotation: float, known: Sequence[float] = ()
) -> tuple[Finding | None, float]:
    """The clearest train of harmonics at a bearing order, and its fundamental in Hz; None and 0 without one.

    lines : Hz of lines that stand out. rotation : Hz of the shaft. known : Hz of lines that the model has.
    """
    Zs: Array = np.empty(s.Y.shape)
    for own, Y, noise in zip(Zs, s.Y, s.noise, strict=True):
        own[:] = np.abs(Y) ** 2 / noise
    for hz in known:
        Zs[:, np.abs(s.f_hz - hz) <= s.width(hz)] = 0.0
    best: Finding | None = None
    fundamental = won = 0.0
    for order in dict.fromkeys(round(o, 4) for o in _candidate_orders(model, s, Zs, lines, rotation)):
        hz = order * rotation
        if abs(order - round(order)) < 0.02 and order < 2.5:
            continue
        harmonics = np.arange(1, min(400, int(min(0.45 * s.rate_hz, model.band[1]) / hz)) + 1)
        bins = np.clip(np.round(harmonics * hz * s.seconds).astype(int), 1, s.f_hz.size - 2)
        Z: Array = np.asarray(np.max([Zs[:, bins + d] for d in (-1, 0, 1)], axis=0))
        # a Hann line fills three bins; the largest of three is about 1.8 by chance
        gains = np.maximum(Z - 3.0, 0.0).sum(axis=1) - 0.15 * harmonics.size
        bounded = np.clip(Z - 3.0, 0.0, LIMITS.max_line_power_ratio).sum(axis=1) - 0.15 * harmonics.size
        clear = float(bounded.sum())
        enough = 40 + 5 * np.sqrt(harmonics.size)
        i = int(np.argmax(bounded))  # one harmonic alone may be a tone, or on a resonance
        visible = int((Z[i] > LIMITS.visible_power_ratio).sum())
        if visible < 4 or bounded[i] <= enough or (best is not None and clear <= won * _clarity_ratio(hz, fundamental)):
            continue
        F, unit = forces_of_lines(point, s, bins + np.argmax([Zs[i, bins + d] for d in (-1, 0, 1)], axis=0) - 1, i)
        if not _has_all_harmonics(F, unit) or _made_by_laws(point, order, hz, F, unit, i):
            continue
        places = [point.data.places[j] for j in range(len(gains)) if bounded[j] > enough]
        best, fundamental, won = _defect_finding(point, s, order, rotation, places, float(np.sum(gains))), hz, clear
    return best, fundamental


def _clarity_ratio(hz: float, other: float) -> float:
    """Ratio of clarity that a train at hz needs over one at another fundamental, Hz, to be preferred.

    If the fundamentals differ by a factor q, the train at the lower one has all harmonics of the other and q - 1 times
    as many between them. If it is real, these are as clear as the others.
    """
    q = max(hz / other, other / hz)
    if abs(q - round(q)) > LIMITS.ratio_tolerance_rel * q:
        return 1.0
    share = 0.5 * (1.0 + round(q))  # half of what they would win
    return share if hz < other else 1.0 / share


def _candidate_orders(model: Model, s: LineSpectrum, Zs: Array, lines: list[float], rotation: float) -> list[float]:
    """Orders of the shaft at which a train is examined. Zs : (channels, bins) power over noise; lines : Hz."""
    out = []
    bpfo = kinematic("bpfo", model)
    if bpfo is not None:
        out.append(float(bpfo))
    if model.bearing is not None:
        out += [v for k, v in kinematics(model.bearing).items() if k != "FTF"]
    steady = [hz for hz in lines if s.steady(hz)]  # in a short record a resonance stands out of its surroundings too
    if len(steady) >= 4:  # the spacing that most of the lines share
        spacing = np.diff(np.sort(steady))
        out += [float(d / rotation) for d in np.unique(np.round(spacing, 2)) if d > LIMITS.min_order * rotation][:20]
    return out + [hz / rotation for hz in _comb_fundamentals(s, Zs, rotation, model.band[1])]


def _comb_fundamentals(s: LineSpectrum, Zs: Array, rotation: float, high: float) -> list[float]:
    """Hz of the frequency whose first harmonics together are clearest in any channel, with its multiples 1/3 to 3."""
    low, top = LIMITS.min_order * rotation, min(LIMITS.max_order * rotation, high / 4)
    grid = np.arange(
        np.ceil(low * LIMITS.searched_harmonics * s.seconds), np.floor(top * LIMITS.searched_harmonics * s.seconds)
    ) / (LIMITS.searched_harmonics * s.seconds)
    totals, count = np.zeros((len(Zs), grid.size), np.float32), np.zeros(grid.size)
    bounded = np.minimum(Zs, LIMITS.max_line_power_ratio, dtype=np.float32)
    for k in range(1, LIMITS.searched_harmonics + 1):
        inside = int(np.searchsorted(grid, high / k))
        for first in range(0, inside, LIMITS.grid_piece_size):
            piece = slice(first, min(first + LIMITS.grid_piece_size, inside))
            at = np.rint(k * grid[piece] * s.seconds).astype(np.intp)
            for total, Z in zip(totals, bounded, strict=True):
                total[piece] += Z[at]
        count[:inside] += 1
    best, found = 0.0, 0.0
    for total in totals if grid.size else ():
        clear = total / LIMITS.noise_margin_rel - count
        top = int(np.argmax(clear))
        if (
            clear[top] > best
            and gammaincc(count[top], total[top] / LIMITS.noise_margin_rel) * grid.size * len(Zs)
            < LIMITS.false_train_chance
        ):
            best, found = float(clear[top]), float(grid[top])
    return [_refined_fundamental(s, Zs, found * q, high) for q in (1.0, 1 / 2, 1 / 3, 2.0, 3.0)] if found else []


def _refined_fundamental(s: LineSpectrum, Zs: Array, hz: float, high: float) -> float:
    """Fundamental (Hz) refined by the peaks of its visible harmonics, up to high (Hz)."""
    Z = Zs.max(axis=0)
    for k in range(1, int(high / hz) + 1):
        at = int(round(k * hz * s.seconds))
        near = Z[max(at - 1, 0) : at + 2]
        if near.size == 3 and near[1] > LIMITS.visible_power_ratio and near[1] >= near.max():
            hz += ((at + hann_peak_offset_bins(np.sqrt(near))) / s.seconds - k * hz) / k * 0.5
    return hz


def forces_of_lines(point: WorkingPoint, s: LineSpectrum, bins: NDArray[np.intp], i: int) -> tuple[Array, Array]:
    """(lines,) N at location i of lines at some bins by the mean tangent, and (lines,) N of the noise near them."""
    near = np.clip(bins[:, None] + np.concatenate([[0], -NEIGHBOUR_BINS, NEIGHBOUR_BINS]), 1, s.f_hz.size - 1)
    bins = near.ravel()
    if set(s.kinds) == {"force"}:
        F = np.abs(s.Y[i, bins])
    else:
        F = np.abs(np.einsum("fj,jf->f", tangent_at(point, s.model, s.f_hz[bins])[:, i], s.accelerations(bins)))
    F = F.reshape(near.shape)
    return np.asarray(F[:, 0]), np.sqrt(np.median(F[:, 1:] ** 2, axis=1) / np.log(2.0))


def _has_all_harmonics(F: Array, unit: Array) -> bool:
    """Whether a train has all harmonics that would be visible beside their neighbours.

    F, unit : (harmonics,) N of its force, and of the noise near each harmonic.
    """
    expected = 0.5 * (F[:-2] + F[2:])
    plain = (expected / unit[1:-1]) ** 2 > LIMITS.unmissable_power_ratio
    left_out = plain & (F[1:-1] ** 2 < LIMITS.missing_power_rel * expected**2)
    return bool(left_out.sum() <= LIMITS.max_missing_share * plain.sum())


def _made_by_laws(point: WorkingPoint, order: float, hz: float, F: Array, unit: Array, i: int) -> bool:
    """Whether the laws of the model make the visible harmonics out of other lines.

    F, unit : (harmonics,) N of the force by the mean tangent at location i, and of the noise near each harmonic.
    """
    over = F / unit
    visible = (over**2 > LIMITS.visible_power_ratio) & harmonic_fit.residual_shows_lines(
        point, hz * np.arange(1.0, over.size + 1)
    )
    if point.data.measured_force or not visible.any():
        return False
    residual = harmonic_fit.residual_harmonics(point, i, order * point.data.phase, over.size)[visible]
    over_noise = np.abs(residual / unit[visible]) ** 2  # one beside a resonance is many times the others
    return bool(np.sum(over_noise) < LIMITS.min_unexplained_rel**2 * np.sum(over[visible] ** 2))


def _defect_finding(
    point: WorkingPoint, s: LineSpectrum, order: float, rotation: float, places: list[str], gained: float
) -> Finding:
    """The finding of an impact train, with strike, angle and width from the residual force folded over its period."""
    settings, power = {}, {}
    hz = order * rotation
    for place in places:
        i = point.data.places.index(place)
        turn = (order * point.data.phase / (2 * np.pi)) % 1.0
        bins = 256
        index = np.minimum((turn * bins).astype(int), bins - 1)
        folded = np.bincount(index, point.force[i], bins) / np.maximum(np.bincount(index, minlength=bins), 1)
        folded -= np.median(folded)
        sd = float(point.force[i].std() / np.sqrt(point.force.shape[1] / bins))
        peak = int(np.argmax(np.abs(folded)))
        tail = np.roll(folded, -peak)[: bins // 4] / folded[peak]
        width = 2 * np.pi / bins * float(np.clip(np.sum(np.clip(tail, 0, None)), 1.0, 40.0))
        settings[place] = {
            "strike": Parameter(float(folded[peak]), sd, "N"),
            "order": Parameter(order, order / s.seconds / hz / 10, "1"),
            "angle": Parameter(2 * np.pi * peak / bins, 2 * np.pi / bins, "rad"),
            "width": Parameter(width, 2 * np.pi / bins, "rad"),
        }
        power[i] = max(float(np.mean(folded**2)) - sd**2, 0.0)
    effect = LOCAL_DEFECT
    return Finding(
        effect=LOCAL_DEFECT.name,
        at=tuple(places),
        gain_nats=gained,
        dof=4 * len(places),
        p_value=float(np.exp(-min(gained, 700.0) / 2)),
        power_N2=power,
        against="shaft_angle",
        region=f"impacts at {order:.3f} x shaft speed ({hz:.2f} Hz)",
        settings=settings,
        note=effect.signature,
    )
