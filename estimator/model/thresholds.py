"""Limits of the linear algebra and the bearing theory, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # background
    min_change_rel: float = 1e-3  # of stiffness or damping, that needs another fit

    # bearing_theory
    preloads_m: tuple[float, ...] = (0.2e-6, 0.3e-6, 0.4e-6, 0.5e-6, 0.6e-6)  # of the curves, as in the paper

    # disc
    harmonic_count: int = 4  # of the shaft's turns to either side
    # The disc is damped by this share of critical at least, along the path: what happened before the record or in a gap
    # dies out, and the filters' remainder of its resonance makes no sidebands.
    min_damping_ratio: float = 0.003
    coarse_damping_ratio: float = 0.03  # of a coarse fit, which is linear in the damping
    # Range of the disc's resonance in which a breathing shaft is not judged: the caps hardly move there, and aliased
    # noise biases the likelihood.
    near_resonance_rel: tuple[float, float] = 0.6, 1.4

    # law_character
    n_states: int = 40  # random states that a law is evaluated at
    tolerance_rel: float = 1e-9  # of the largest force: a smaller difference is rounding

    # recorder
    pass_band_ripple_db: float = 0.5  # of a chebyshev1 filter, if the rig file says nothing: usual in data sheets
    stop_band_loss_db: float = 60.0  # of a chebyshev2 filter, if the rig file says nothing
    max_aliased_power_share: float = 0.01  # of the power at a frequency, from beyond half the rate: 10 % in amplitude
    trust_grid_points: int = 2000  # frequencies at which the aliased share is evaluated

    # rotor_matrices
    same_pole_rel: float = 1e-9  # of their size: poles that are one, such as those of the two directions
    min_term_rel: float = 1e-9  # of the largest part of a pole's term, the least that counts
    # modes of the shaft with its bearings and discs held are kept up to this multiple of the highest frequency of
    # interest: Craig and Bampton, AIAA J. 6(7), 1968, 1313-1319; 1.5 to 2 is the usual rule
    modes_up_to_rel: float = 3.0
    # square of the lowest held mode over that of the highest: a smaller one is a free motion
    min_mode_rel: float = 1e-8


LIMITS = Thresholds()
