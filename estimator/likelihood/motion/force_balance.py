"""Which channels measure the motion and the force at each place, and what the shaft adds to the force balance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.errors import DataError
from estimator.model.rig import MOTION_UNITS, Model


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
