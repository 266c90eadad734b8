"""Limits of the fit of a record, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # disturbance_numbers
    max_settled_change_sd: float = 0.5  # a parameter that changes by less from one round to the next has settled

    # full_fit
    # of kL, rms of the tangent of laws beside hysteresis: below it the second order is 1e-2
    max_tangent_sd_rel: float = 0.1
    min_reported_swing_db: float = 1.0  # of the spectrum of the force along the band: instruments have +-10 %
    max_speed_change_rel: float = 0.02  # along a record: an imbalance changes by twice that
    speed_pieces: int = 16  # of a record, for the speed along it
    resolving_rounds: int = 2  # fits of the laws and the disturbances in turn: each depends a little on the other

    # grid_start
    grid_s: float = 6.0  # of the record, on which a grid is tried
    pedestal_start_s: float = 20.0  # of the record, for the spectrum of the residual force
    # of the damping without a pedestal: an intermediate fit may fall that far below zero
    max_negative_damping_rel: float = 0.1

    # line_motion
    min_line_power_share: float = 0.01  # of the lines in a mean square displacement: less biases a law by 3 %
    min_line_nats: float = 10.0  # that laws predict more without the lines: 20,000 to 1

    # long_record
    min_further_share: float = 0.25  # of the part that was fitted, from which the rest is fitted too
    max_chance_p: float = 1e-3  # of the scatter of the parts, from which it counts

    # shaft_scale
    # of the disc: start values of unknown cap masses
    start_masses_rel: tuple[float, ...] = (0.02, 0.1, 0.5, 2.0, 10.0, 50.0)
    searched_starts: int = 2  # likeliest starts whose background is sought
    min_start_stiffness_rel: float = 0.1  # of the stiffness of a cap, for its bearing beside a stiff shaft
    unknown_sd: float = 10.0  # of the logarithm of a mass that the spectra do not give

    # spectral
    max_last_step_sd: float = 1.0  # last step of a fit, standard deviations: a larger one has not converged
    min_colour_sd: float = 5.0  # of the residual force in a band of cells: one false message in 1e5 records
    min_colour_rel: float = 0.05  # of S, from which it matters to a parameter
    min_colour_bins: int = 60  # of the lowest cell of frequency
    max_colour_cells: int = 24  # of frequency over the band
    max_lines_named: int = 6  # in a message

    # unknown_mass
    # last step of a fit, standard deviations: with a larger one the fit has gone astray
    max_astray_step_sd: float = 1.0
    max_departure_sd: float = 4.0  # of a fitted mass from that of the spectra

    # unmeasured_end
    # of the stiffness at a place: a weaker coupling through the shaft does not matter
    min_shaft_stiffness_rel: float = 0.01
    max_rotor_stiffness_rel: float = 0.1  # of it, beyond which a rotor of many modes is not judged by some bearings

    # upper_edge
    # frequency over the highest resonance from where laws and damping shape the force no more
    above_resonance_rel: float = 2.0
    min_fall_sd: float = 4.0  # of the slope of a fall, at every place: one false message in 1e4 records of one place
    min_fall_db: float = 0.3  # at the upper band edge, from which it matters to S (7 % of power)
    trusted_fall_db: float = 0.1  # at the frequency up to which a record is trusted: 2 % of power
    min_cells: int = 3  # above the resonances, to see a fall in


LIMITS = Thresholds()
