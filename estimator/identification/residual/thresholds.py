"""Limits of what judges the residual force, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # black_box
    x_knot_step_rms: float = 0.35  # between knots of the displacement, over its rms
    v_knot_step_rms: float = 0.5  # between knots of the velocity, over its rms
    knot_span_rms: float = 3.7  # knots on either side reach this far, over the rms
    # of a regressor's power beside the model's own: with less it has no response of its own
    min_own_power_share: float = 1e-3
    # of the record, for second-order corrections: gains are within 0.04 nats of those of 33 s
    second_order_record_s: float = 5.0
    # of a hat of velocity, over the change of velocity by the force within tau of the band
    min_hat_width_kicks: float = 2.5

    # group_fit
    polynomial_degree: int = 9  # of the smooth curves
    ridge_share: float = 1e-3  # of a regressor's own information: holds hat functions without samples at zero

    # harmonic_fit
    max_steps: int = 8  # of the parameters at one working point
    min_band_gain: float = 0.9  # of the band filter, at a frequency that counts as in the band
    # residual amplitude over that by the mean tangent: with less the laws explain the line
    min_unexplained_rel: float = 0.25
    settled_step_sd: float = 0.1  # of the last step, in standard deviations

    # impact_train
    searched_harmonics: int = 12  # of each candidate frequency in the blind search
    max_line_power_ratio: float = 20.0  # power over noise that one harmonic may contribute
    noise_margin_rel: float = 1.3  # as the local noise is known to about 10 %
    false_train_chance: float = 1e-4  # of a false train in a record
    min_order: float = 0.3  # of the shaft, the limits of the effect's order
    max_order: float = 30.0  # of the shaft, likewise
    visible_power_ratio: float = 8.0  # power over noise of a visible harmonic
    unmissable_power_ratio: float = 25.0  # power over noise of a harmonic that cannot be overlooked
    ratio_tolerance_rel: float = 1e-3  # of the ratio of two fundamentals from a whole number
    grid_piece_size: int = 1 << 16  # frequencies that are looked at together: what is made for them stays small
    missing_power_rel: float = 0.25  # of the power of its neighbours, below which a harmonic is missing
    max_missing_share: float = 0.2  # of the harmonics of a train

    # lines
    false_line_chance: float = 1e-4  # of one false line in a record, in a blind search
    disc_notch_rel: float = 0.04  # half width of the excluded band at the disc resonance, over its frequency
    # of the disc resonance: shaft 30 % stiffer or disc 20 % lighter than the rig file says
    disc_uncertainty_rel: float = 0.25
    line_tolerance_rel: float = 0.02  # difference between equal lines of two channels or caps, over their mean
    false_order_chance: float = 1e-4  # of a false line at an order that is examined on purpose

    # measured_path
    max_cells: int = 900  # of the band
    single_bin_cells: int = 20  # of one bin, at the lower end of the band
    min_cells: int = 100  # of the band, to judge a path
    # numbers per bin of a block: Hann windows every half block, 1.944 (1 + 2 / 11.7)
    independent_per_bin: float = 0.439
    line_half_width_bins: float = 2.5  # left out on either side of a tone
    max_fault_p_value: float = 1e-2  # of a finding
    # of the coherent power, for a fault: it leaves at most a fifth of what it explains
    min_explained_share: float = 0.8
    min_bias_sd: float = 8.0  # of the coherent power, for a path that is biased by an unknown cause
    min_force_noise_ratio: float = 2e-3  # of powers, noise of a channel over force: less moves c by less than its sd
    min_gain_error_rel: float = 2e-3  # of a gain: less is within the accuracy of calibrations and cap masses
    min_gain_over_noise: float = 2.0  # of a gain error over the share of noise that the force channel may have
    delay_starts_samples: tuple[float, ...] = (0.0, -3.0, -1.0, 1.0, 3.0)  # from which searches start
    gain_starts_rel: tuple[float, float] = (0.0, -2.0)  # an inverted sensor has the error -2

    # missing_force
    max_group_p_value: float = 1e-3  # of a group at a location, after correction for the groups and locations tried
    survey_s: float = 24.0  # of a long record: enough to see a thousandth of the bearing force
    survey_rows: int = 600_000  # at least, of a record at a low rate
    negligible_force_share: float = 1.2e-3  # of the rms bearing force: errors of band limit and integrators are smaller
    # the same beside structural modes: stiffness there may be off by a tenth, and the least promised effect is 3 %
    negligible_force_share_beside_modes: float = 5e-3
    # of the rms excitation: no background is known so well as to tell less from it
    negligible_excitation_share: float = 0.02

    # stiffness_order
    floor_bins: int = 200  # of the padded spectrum on either side, whose median is the floor
    max_bins_at_once: int = 1 << 21  # of a padded spectrum, of which two are made at once
    min_padding: int = 4  # bins of the padded spectrum for one of the record

    # strong_law
    # rms, of the mean tangent of a place: six of seven false claims on 114 complete rigs lie above it. Of one bearing
    # kL is off by up to 1 % (5 sd) above 0.6, and by less than 2 sd below 0.5.
    max_tangent_sd_rel: float = 0.5


LIMITS = Thresholds()
