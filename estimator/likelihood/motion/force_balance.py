"""Which channels measure the motion and the force at each place, and what the shaft adds to the force balance."""

from __future__ import annotations

from estimator.errors import DataError
from estimator.model.rig import MOTION_UNITS, Model
from estimator.model.rotor import rotor_of
from estimator.model.rotor_matrices import Term


def motion_channels(model: Model) -> list[int]:
    """Index of the channel that measures the motion of each place (the first one, where there are several)."""
    moving = [(i, c.place) for i, c in enumerate(model.channels) if c.kind in MOTION_UNITS]
    return [next(i for i, place in moving if place == p) for p in model.places]


def force_channels(model: Model) -> dict[int, int]:
    """Place's row -> index of the channel with its measured force."""
    rows = {p: i for i, p in enumerate(model.places)}
    return {rows[c.place]: i for i, c in enumerate(model.channels) if c.kind == "force" and c.place in rows}


def shaft_notches(model: Model) -> tuple[tuple[float, float], ...]:
    """Hz: where the shaft with its discs, the caps held, resonates too sharply for a filter: bins left out of a fit."""
    rotor, width = rotor_of(model), model.band[0] / 6.0  # four times the resolution of the filters
    return () if rotor is None else tuple((hz - width, hz + width) for hz in rotor.resonances_hz)


def shaft_terms(model: Model) -> tuple[Term, ...]:
    """Forces on the caps by their displacements through shaft and discs, as the extra outputs of a `BandLimit`.

    Exact: what a filter cannot hold of a sharp resonance is the filter's affair (band_limit.py). Raises DataError.
    """
    if model.shaft in ("chain", "beam") and model.shaft_stiffness > 0.0 and model.mass.get("disc", 0.0) <= 0.0:
        raise DataError(f'shaft "{model.shaft}" needs [rig.mass] disc: give it, or set shaft = "none"')
    rotor = rotor_of(model)
    return () if rotor is None else rotor.terms()
