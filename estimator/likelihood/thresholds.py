"""Limits of the likelihood and of its fits, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # fitting/gauss_newton
    first_part_s: float = 8.0  # part of a long record that the first rounds fit
    part_growth: float = 3.0  # length of a part over that of the part before
    max_rounds: int = 6  # of steps on the first part
    max_last_rounds: int = 3  # of steps on the whole record after it
    noise_tolerance_rel: float = 0.3  # of the sensor noise between steps: neighbours on the grid of its search
    min_stiffness_share: float = 0.3  # of a stiffness after a step over that before it, where the force is measured
    max_mass_factor: float = 2.0  # of a fitted mass in one step
    # last step of a fit, standard deviations; the remaining error is a tenth of it or less
    max_last_step_sd: float = 0.3
    max_part_step_sd: float = 0.5  # last step on a part of a record, standard deviations
    start_blocks: int = 40  # number of blocks for the start values
    # of critical, least and largest that are tried at the start, and how many
    start_damping_ratios: tuple[float, float, int] = 0.001, 1.0, 40
    spectrum_blocks: int = 80  # number of blocks for the spectrum of the motion
    left_out_tolerance_rel: float = 0.05  # of the motion outside the band, between steps
    max_still_step_sd: float = 1.0  # step below which the below-band displacement is kept, standard deviations

    # fitting/noise_level
    # of the spectrum over its maximum: rounding of what falls steeply towards the edge of the band
    min_shape_rel: float = 1e-12

    # motion/denoise
    max_noise_power_share: float = 5e-4  # of the displacement; noise below it biases a cubic by at most twice as much
    smoothing_bins: int = 7  # over which the spectrum of the motion is smooth

    # motion/harmonics
    points_per_turn: int = 1 << 14
    min_band_gain: float = 1e-4  # gain of the band filter below which a harmonic is neglected
    max_harmonics: int = 399  # of an angle, that known lines are made of

    # motion/known_spectra
    line_lobe_bins: float = 2.0  # half width of the main lobe of a block without a window, and one bin more

    # motion/law_smoothing
    min_smoothing_sd: float = 0.02  # least half-width over the state's sd: a jump needs some width to have a tangent
    law_grid_factor: int = 4  # rate of the fine grid over the sampling rate
    max_harmonic: int = 9  # highest harmonic of a smooth law that is checked for aliasing
    min_harmonic_rel: float = 0.02  # of the fundamental, from which a harmonic of a law counts
    # amplitudes over the state's rms at which a law is tried
    orbit_sizes_sd: tuple[float, float, float] = (1.3, 2.6, 4.1)
    frequency_spread: float = 1.1  # highest strong frequency of a motion over its mean frequency

    # motion/linear_memory
    min_rad_s: float = 1e-3  # a state that only integrates has no response at rest
    max_mode_condition: float = 1e6  # condition of the modal matrix up to which the response is summed mode by mode
    derivative_step_rel: float = 1e-3  # of a stiffness or damping, for derivatives of the response

    # motion/located_law
    law_rows_per_piece: int = 1 << 15  # rows evaluated at a time: they stay in the cache
    max_force_n: float = 1e12  # more is divergence, and has no square in single precision
    characters_held: int = 1024  # answers of `_character`, at most

    # motion/memory_law
    memory_grid_factor: int = 2  # rate of the grid for the states over the sampling rate
    memory_rows_per_piece: int = 1 << 13  # rows linearised at a time: they stay in the cache
    max_piece_stride: int = 3  # steps are launched in every so manyth piece at the rarest
    min_pieces: int = 40  # in which steps are launched
    memory_cycles: float = 8.0  # of the motion, after which the response to a step has settled
    steps_per_cycle: float = 2.6  # launched, at changing phases of the motion
    # every second step is followed for half of memory_cycles, every fourth for a quarter, ...
    followed_halvings: int = 5

    # motion/prepare
    min_samples: int = 2**16  # 2.6 s at 25.6 kHz: with fewer even strong effects may be missed
    min_peak_si: float = 1e-15  # of a channel; a smaller one is a wrong unit
    max_peak_si: float = 1e15  # of a channel; a larger one is a wrong unit, and its powers overflow
    min_line_gain: float = 0.1  # of the band limit, for a line beside the band: it leaks into the band by its sidelobes
    min_fitted_share: float = 0.3  # of the band: with less a resonance may lie in what is left out

    # motion/shaft_law
    max_step_rad: float = 0.3  # of the disc's resonance in one step of integration
    min_law_rel: float = 1e-3  # of the shaft's stiffness, below which a law is only on trial
    angles_per_turn: int = 64  # from which mean and first harmonic of the law are computed

    # path/excitation_level
    min_rms_ratio: float = 1.15  # largest over lowest rms of sixths of a record, from which a force counts as uneven
    min_ratio_sds: float = 8.0  # standard deviations of that ratio above 1
    average_s: float = 1.0  # length that a level is the mean of
    level_tolerance_log: float = 0.03  # of the logarithm of a level, between two fits
    min_independent_values: int = 2000  # in a mean level: its scatter goes into the weights

    # path/path_fit
    # Share of the information of single regressors, for a sum of them. Mean tangents are known to about 1 %. Where
    # regressors of a law cancel to 1e-4 of their power, the tangent of the sum is mostly error, and so the determinant.
    min_information_share: float = 1e-5

    # path/uncertainty
    min_blocks: int = 30  # of a record, for the scatter of its blocks
    # of a variance from the scatter of blocks above that of the Hessian: chance gives 1 in 700
    min_excess_sd: float = 3.0
    max_chance_p: float = 1e-3  # of a scatter of the time folds: chance gives 1 in 1000

    # path/working_point
    searched_step_sd: float = 0.3  # prior standard deviation of a step of a searched parameter, over its natural scale

    # response/below_band
    min_even_part_rel: float = 1e-3  # of a law's size; a smaller even part is rounding
    tried_states: int = 40  # random states at which a law is tried
    measured_force_rounds: int = 3  # of the iteration for the tangents of laws under a measured force

    # response/fluctuation
    samples_per_cycle: float = 40.0  # of the motion: the covariance of a jump falls within few samples

    # response/modal_response
    # variance under white force over that of the largest mode; weaker modes are not waited for
    min_mode_power_rel: float = 0.01
    # decays of the slowest mode over decays of the mean over modes that a record has to hold
    slowest_mode_share: float = 0.1
    min_residue_rel: float = 1e-6  # of the largest residue; smaller ones are modes of other caps

    # response/regressor_set
    # of a searched parameter of a law with memory; less meets few kinks of its response
    min_searched_step_rel: float = 0.1
    shaft_step_rel: float = 1e-4  # step of a law of the shaft over the shaft's stiffness
    min_single_rms: float = 1e-30  # rms per unit that single precision holds (x^5 of a quiet bearing is below)
    # every so manyth sample gives the weights of the projection, which is then subtracted exactly
    projection_stride: int = 4
    min_independent_rms_rel: float = 1e-4  # of a regressor's rms, left by the others: less is rounding

    # response/self_energy
    min_covariance_s: float = 8.0  # of record for the covariances, at least
    covariance_decays: float = 1000.0  # mean decay times of record for the covariances, at least
    response_rounds: int = 10  # iterations of the self-consistent response
    max_stiffness_sd_rel: float = 1.0  # rms of the tangent stiffness over its mean, above which no correction is made
    # rms of the tangent stiffness over the least dynamic stiffness (c w0 of one cap)
    max_stiffness_sd_over_width: float = 19.0
    max_power_after_lags: float = 0.02  # share of the power of free motion after the last lag

    # whitening/line_leakage
    max_lines: int = 8  # projected out; every line costs two products with each series
    min_leakage_bins: float = 0.3  # power that leaks out of the bins left out, over the noise in one bin
    # of noise from an edge of the band, over the PSD there: S is off by a quarter of it or less
    max_noise_leakage_rel: float = 0.02
    # of the cotangent at f0 and at -f0; beyond them a wander of 0.1 % is lost in noise
    line_powers: tuple[int, int] = 3, 2
    disc_powers: tuple[int, int] = 2, 1  # of a disc, which only decays

    # whitening/sensor_noise
    min_correlation: float = 1e-4  # of two residual forces, anywhere in the band; a smaller one is neglected

    # whitening/whitening
    blocks_per_fft: int = 32  # transformed at a time; more do not stay in the cache

    # law_gain
    optional_cost_nats: float = 1.5  # what an idle parameter gains held in and loses held out
    # by searched parameters of one location alone; about the price of a parameter
    min_own_values_gain_nats: float = 2.0

    # subproblem
    impossible_nats: float = 1e6  # lost on a fold that a fit calls impossible, as where a mode is unstable


LIMITS = Thresholds()
