"""Limits of the machine layer, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # combs
    line_widths_bins: tuple[int, int, int] = (1, 4, 16)  # strikes that slip have wide lines
    harmonic_counts: tuple[int, ...] = (2, 3, 5, 8)  # of the combs that are tried
    max_line_nats: float = 20.0  # that one line may contribute
    clear_line_nats: float = 8.0  # of a line of an envelope that is clear
    min_clear_harmonics: int = 2  # of a comb, one of the first two among them
    lowest_bins: int = 3  # next to 0 Hz, where the window spreads the mean

    # envelope
    max_envelope_piece_s: float = 20.0  # the phase of strikes that slip is lost within some seconds
    # bands that share the range up to half the rate, halved from one to the next as in a kurtogram
    bands_per_rate: tuple[int, ...] = (1, 2, 4, 8, 16)
    min_band_over_highest: float = 0.25  # width of a band over the highest frequency asked for
    top_of_nyquist: float = 0.94  # part of the range below half the rate that a recorder passes
    floor_block_hz: float = 20.0  # of the floor that whitens: wider than a line, narrower than a mode
    floor_block_bins: int = 8  # of that floor, at least
    angle_points: int = 4096  # of a piece at which the angle of the shaft is followed
    tone_noise_hz: float = 10.0  # a tone counts no more than the noise in so many hertz
    least_power: float = 1e-30  # added to powers that may be 0; in single precision
    min_tone_ratio: float = 9.0  # power over the floor that is never bounded: noise does not reach it

    # pieces
    bridged_gap_rows: int = 8  # missing rows that a straight line bridges: shorter than what a spectrum resolves
    max_bridged_share: float = 0.02  # of a channel's rows; a channel with more short gaps is cut at each of them
    min_piece_rows: int = 256  # of a gap-free piece
    # bounds memory; a resolution of 1/60 Hz is finer than the speed of any machine is constant
    max_piece_s: float = 60.0

    # spectra
    coarser_by: int = 4  # from one resolution to the next
    min_level_s: float = 0.1  # of a piece at the coarsest resolution, at least
    min_level_rows: int = 256  # of that piece, at least
    near_bins: int = 3  # from a bin, where the mean of the nearest noise begins
    near_reach_bins: int = 8  # from a bin, where that mean ends
    far_reach_bins: int = 16  # on either side of a bin, for the median of the noise about it
    hann_bin_correlation: float = 1.5  # equivalent noise bandwidth of a Hann window, bins
    noise_bins: float = 8.0  # independent bins that the noise about a bin rests on, after that correlation
    least_ratio: float = 2.5  # power over noise below which a p-value is not computed

    # speed
    # of the angle between the first and the last pulse: width of an edge, spline beyond it
    tacho_sd_turns: float = 0.02
    nameplate_reach_rel: float = 0.05  # about the given speed: slip of an induction motor between no load and overload
    nameplate_sd_rel: float = 0.01  # of a given speed that the record does not confirm: usual slip
    min_rate_error_rel: float = 0.005  # deviation of shaft and mains from which a wrong rate is said
    contradiction_rel: float = 0.02  # between the record and the rig file, from which it is said: beyond the usual slip
    max_harmonic_nats: float = 20.0  # that one harmonic may contribute: one line is no comb
    max_false_speed_chance: float = 1e-4  # of one false speed in a record
    min_free_hz: float = 5.0  # of a shaft that nothing is known of: 300 rpm
    max_free_hz: float = 500.0  # of that shaft: 30 000 rpm
    min_free_harmonics: int = 3  # clear ones, the first among them
    clear_harmonic_nats: float = 10.0  # of a harmonic of the shaft that is clear
    line_sd_bins: float = 0.2  # of the frequency of a line
    # between a line and a harmonic; the supply of a motor is near an order and no order
    line_tolerance_bins: float = 0.25
    wander_reach_rel: float = 0.03  # about the mean speed within which the speed wanders
    wander_power_ratio: float = 8.0  # over the noise of a bin that belongs to the line of an order
    hann_line_variance_bins: float = 1.0 / 3.0  # of a steady line under a Hann window, bins^2
    grid_step_bins: float = 0.2  # of the highest harmonic from one trial speed to the next

    # of the mean, by which a followed speed changes: twice the half width of a harmonic at a steady speed
    min_sweep_rel: float = 0.02

    # strikes
    max_slip_rel: float = 0.02  # of a kinematic order: slip of balls and the contact angle under load
    grid_per_bin: float = 2.0  # trial positions of the highest harmonic in a bin
    min_free_order: float = 0.3  # of a train that has no kinematic name
    max_free_order: float = 12.0  # of that train
    unknown_shaft_hz: float = 30.0  # in place of a speed that is not known: motors of two pairs of poles turn near it
    free_peaks: int = 30  # lines that a free search starts from
    free_divisors: tuple[int, int, int] = (1, 2, 3)  # which harmonic each of these lines may be
    highest_order: float = 45.0  # of the shaft, up to which envelopes are analysed
    level_turns: float = 10.0  # of the shaft over which the level is made equal: some turns of the cage
    max_false_train_chance: float = 1e-3  # of one false train in a record
    max_envelope_mains_multiple: int = 4  # at which an envelope has lines of the mains
    wander_reach_sds: float = 2.5  # standard deviations of a wandering speed to which the lines of its orders reach
    min_free_distance_rel: float = 0.03  # of a free train from a whole shaft order: a speed that wanders spreads these
    # of the strongest higher harmonic over the first: ringing strikes have over a half
    min_strike_harmonic_rel: float = 0.25
    separation_share: float = 0.6  # of the power that the likeliest name explains, above which another is a rival

    # survey
    max_tones_shown: int = 10  # on the screen, orders 1 and 2 among them
    live_bands_per_rate: tuple[int, int] = (1, 4)  # a third of the cost of the bank for a record

    # tones
    max_false_tone_chance: float = 1e-3  # of one false line in a record
    min_damping_ratio: float = 1e-3  # of a structure; a peak narrower than its resonance is a line
    hann_half_power_bins: float = 1.44  # width of a line under a Hann window
    lobe_bins: int = 2  # on either side of the bin of a line that hold its power
    reach_half_widths: float = 3.0  # of a band about a line, over the resolution that holds most of it
    edge_bins: int = 3  # at 0 Hz and at half the rate in which no line is looked for
    max_lines_per_level: int = 400  # of one resolution
    mains_hz: tuple[float, float] = (50.0, 60.0)  # of the grids of the world
    max_mains_multiple: int = 12  # that is named
    mains_tolerance_rel: float = 2e-3  # of a grid from its nominal frequency, and of the clock of a recorder
    max_mains_tolerance_rel: float = 0.006  # of the mains frequency; a record that places a line worse does not name it
    # of the shaft's frequency; what places a line worse calls one in twenty an order by chance
    max_order_tolerance: float = 0.03
    max_strong_order_tolerance: float = 0.05  # for the orders that every shaft has
    max_wander_rel: float = 0.01  # of a harmonic of the shaft at a steady speed, half its width
    strike_sidebands: int = 2  # at the shaft speed, to either side
    strike_tolerance_rel: float = 2e-3  # slip from strike to strike
    resolution_bins: float = 1.0  # between a line and the frequency that it is said to have


LIMITS = Thresholds()
