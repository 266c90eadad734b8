"""Limits of the rolling estimate, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # anchor
    # of a resonance: the midpoint rule is then good to 1e-3 standard deviations of the parameters
    nodes_per_width: float = 6.0
    nodes_per_distance: float = 15.0  # from a resonance
    rounding_rel: float = 1e-9  # of a mean tangent: less is rounding
    frequency_cells: int = 12  # of the band, each with its own sensor noise

    # background
    record_s: float = 24.0  # of samples, in which a background is found
    background_parts: int = 4  # of them: each shows the background alone
    max_rows: int = 1 << 20  # of memory for them: 32 MB with four channels
    # of the stiffness: a mode of the wrong form moves it by 10 to 25 %, chance by 1 to 3 %
    max_parts_apart_rel: float = 0.07
    pause_rel: int = 2  # all samples so far times this, until the next search
    first_work_s: float = 0.1  # of a core, for the first search beside its samples
    max_work_s: float = 8.0  # of a core, at most for one search beside its samples
    samples_per_s: float = 5e6  # of all channels that a core filters and transforms, about: a processor of 2020
    fitted_samples_per_s: float = 1e6  # the same with a fit
    derivatives_per_s: float = 2e7  # of spectra, by parameters, that a core computes and multiplies
    slow_machine: float = 4.0  # times as long as that a search may take, before an estimate waits for it

    # piece, spectrum
    min_noise_gain_nats: float = 5.0  # of other sensor noise than that of the anchor, at any place
    min_noise_blocks: float = 12.0  # of the memory
    noise_grid_points: int = 61  # ratios of sensor noise that are tried
    # of the power of a cell, by chance: with 50 cells one false reason in a million estimates
    max_colour_p: float = 1e-8

    # estimator
    warm_up_s: float = 4.0  # of samples, at least, before the first fit
    piece_s: float = 0.5  # of samples, at most, between two estimates
    block_cycles: float = 16.0  # of the lower band edge in a block
    min_block_rows: int = 128  # of a block, whatever the band
    ringing_times: float = 5.0  # of 1 / (zeta w0) of structural modes, beside a piece of motion: the rest is 0.7 %
    jobs_per_block: int = 4  # at most, of those that no estimate waits for
    min_estimate_blocks: float = 6.0  # in the slow memory, for an estimate
    min_memory_share: float = 0.1  # of the time constant, or of the warm-up, that the slow memory has to hold
    pieces_per_watch: int = 6  # of the memory with the candidates
    pieces_per_look: int = 6  # for missing force
    max_still_rms_rel: float = 1e-6  # of the usual acceleration of a place, or of the other places: it does not move

    # follower
    fast_time_constant_rel: float = 0.25  # time constant of the fast memory over that of the slow one
    min_fast_blocks: float = 10.0  # time constant of the fast memory, least number of blocks
    min_watched_blocks: float = 36.0  # time constant of the memory with the candidates, least number of blocks
    max_steps: int = 30  # of Newton, to a maximum
    max_newton_sd: float = 1.0  # length of one step, standard deviations, that needs no second one
    min_change_sd: float = 5.0  # between the two memories, of a parameter that has changed
    solutions_per_check: int = 2  # estimates from one look for a change to the next
    max_anchor_sd: float = 5.0  # of an increment, beyond which the anchor is renewed
    # of a parameter that a force is not linear in, over the step that the prior information allows
    max_searched_step: float = 0.3
    min_level_ratio: float = 1.1  # of the power, beyond which the mean tangents of a law are another: 5 % in rms
    # of a variance from the scatter of pieces above that of the Hessian: chance gives 1 in 700
    min_excess_sd: float = 3.0
    min_pieces: float = 10.0  # for their scatter

    # piece
    min_level: float = 1e-12  # of a piece
    max_line_p: float = 1e-9  # of a bin of noise, to be taken for a line
    line_reach_share: float = 0.3  # of S: what leaks farther from a line is neglected
    line_surroundings_bins: int = 41  # whose median a line stands out of: fewer than a resonance is wide

    # report
    # of the power of the residual force in a cell of frequency, from which it matters to a number
    min_colour_rel: float = 0.05
    max_colour_ratio: float = 2.0  # of that power to the mean of all cells or its inverse, up to which they are shown

    # scope
    min_crack_stiffness_rel: float = 1e-3  # of the stiffness at a place: a weaker crack does not bias it

    # start
    start_blocks: int = 24  # at least, in the first fit
    min_correlation_times: float = 10.0  # that the first seconds have to hold
    max_known_lines_share: float = 0.5  # of the band, that the lines of the model's own periodic forces may take
    line_width_bins: float = 5.0  # that a line of known frequency takes

    # watch
    max_false_alarm_p: float = 1e-6  # per look and candidate
    min_watch_blocks: float = 4.0  # of the memory with the candidates
    min_eigenvalue_rel: float = 1e-5  # of the information: along smaller ones single precision says nothing

    # background
    max_core_share: float = 0.04  # of one core, that searches take in the long run


LIMITS = Thresholds()
