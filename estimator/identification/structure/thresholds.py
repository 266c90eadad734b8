"""Limits of the structure layer, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # background_search
    max_modes_per_cap: int = 6
    # distances of the knots of the spectrum of the force, tried in turn
    tried_knot_octaves: tuple[float, float] = (2.0, 1.0)
    # of the frequency in ln S, towards the upper edge: an unknown filter, a mounting resonance
    fall_powers: tuple[int, int, int] = (8, 16, 32)
    # of the upper edge over a resonance, for a fall in the spectrum that is not the bearing's
    min_edge_ratio: float = 2.0
    min_knot_widths: float = 4.0  # least distance of the knots, half-power widths of the resonance: no bend within
    scanned_per_octave: int = 40
    scanned_damping: tuple[float, float, float] = (0.006, 0.02, 0.06)
    proposal_count: int = 4  # fitted at each step
    best_scores: int = 60  # of a form at a cap, among which the proposals are
    same_frequency_ln: float = 0.1  # proposals nearer than this are one
    sure_mass_sd: float = 0.1  # of ln(mass): a mode as certain gains some 50 nats
    tried_steps: int = 12
    tried_tolerance_nats: float = 1.0
    max_idle_modes: int = 2  # that a mode makes idle by its other form
    min_damping_rel: float = 0.1  # of the damping of a bearing before, where a mode changes its form
    shape_knots: int = 64  # of the spectrum of the force in the result

    # cross_spectra
    matrix_cell_width_rel: float = 0.004  # of its frequency: a third of the half-power width of a mode of 0.6 % damping
    min_matrix_pieces: int = 12  # that the spectra are averaged over, at least
    score_overhead_derivatives: float = 2e4  # that take as long as what a score of any size costs

    # excitation
    cell_width_rel: float = 0.003  # of its frequency: the half-power width of a mode of 0.3 % damping is twice that
    pieces_per_record: int = 8  # into which a record is cut, so that the spectrum is an average
    short_pieces: int = 4  # into which a short record is cut
    short_s: float = 10.0  # length below which a record is short
    min_piece_s: float = 0.05  # of a piece: the side lobes of a shorter one are wider than modes
    max_piece_s: float = 20.0  # of a piece: a longer one resolves more than modes need
    min_piece_periods: float = 4.0  # of the lower edge of the band in a piece: its cell is free of the mean
    max_blocks: int = 16  # that are kept apart
    min_line_reach_bins: int = 3  # a line reaches as far as its side lobes, which fall with the distance^4
    sidelobe_bins: float = 1.5  # a line reaches as far as its side lobes, which fall with the distance^4
    tooth_reach_bins: int = 2  # of a line of a strike train: of the tapers, and of slip
    tooth_blur_rel: float = 1e-3  # of a line of a strike train: of the tapers, and of slip

    # joint_spectrum
    # of structures of metal with joints (Beards, Structural Vibration, 1996, ch. 3)
    damping_ratio_limits: tuple[float, float] = (1e-3, 0.12)
    band_margins_rel: tuple[float, float] = (0.8, 1.05)  # of a mode's frequency: lower and upper edge of the band
    spline_prior_sd: float = 2.0  # of ln S about its mean: the force varies by 9 dB along the band
    # of ln c about its start: a mode as wide as the bearing's resonance takes its damping away
    damping_prior_sd: float = 1.0
    max_step: float = 1.0  # of any parameter, in logarithms
    coherence_cells: int = 40  # of about equal width in log frequency
    first_coherence_cell: int = 8  # narrow cells in the first wide one
    spline_degree: int = 3

    # modes
    knot_octaves: float = 1.0  # least distance of the knots of P
    # least distance of the knots in half-power widths of the strongest mode: P may not bend within it
    knot_widths: float = 4.0
    broad_starts: int = 5  # of a mode that friction damps so much that P passes for it
    broad_damping: float = 0.3  # of a mode that friction damps so much that P passes for it
    max_modes: int = 8
    mode_p_value: float = 1e-4  # of a mode, over all frequencies and widths searched
    # half-widths of the humps that are searched for
    widths_rel: tuple[float, ...] = (0.006, 0.012, 0.024, 0.05, 0.1, 0.2)
    min_prominence: float = 1.0  # power of a mode at its resonance over that of all else there: half of the whole, 3 dB
    damping_limits: tuple[float, float] = (5e-4, 0.7)  # beyond 0.707 an oscillator has no resonance
    min_width_bins: float = 3.0  # half-power width of a mode; narrower is a line
    max_steps: int = 25  # of scoring
    max_damping_sd_rel: float = 0.5  # of a mode, as of any parameter that is called identifiable
    max_refused: int = 4  # humps that are no sound mode, before the search ends
    edge_rel: float = 0.04  # of its frequency, that a mode stays away from the ends of the band

    # rig_spectra
    explained_misfit: float = 0.05  # rms of ln(measured / model) of a cap: 0.2 dB
    plain_octaves: float = 2.0  # between the knots of the spectrum of a force before modes are sought
    min_kept_stiffness_rel: float = 0.1  # of a bearing beside a shaft that is thought to be stiffer
    scanned_each: int = 4  # cells: one of so many is scanned

    # spectral_models: cells
    min_noise_share: float = 1e-3  # of the power of the noisiest sensor's noise, that every sensor is given
    max_cells: int = 260  # over the band
    min_kept_share: float = 0.01  # of a bin, beside what lines leak into it

    # spectral_models
    max_dimming_share: float = 0.985  # of S, that a spectral shape may take away at low frequencies
    # of a damping: excess of one resonance fitted to the two of rotor and pedestal
    broadened_damping_share: float = 0.75
    derivative_step_rel: float = 1e-8  # of a number over its scale

    # spectral_problem
    min_stiffness_rel: float = 1e-6  # of one that resonates at the top of the band: a softer fit is no start
    start_damping_ratio: float = 0.02  # of a bearing that the fit did not find: middle of 0.3 to 15 %
    min_start_damping_ratio: float = 1e-3
    # of the edges of the band: beside a stiff shaft a bearing is softer; a flank at the upper edge is a spectrum
    scanned_band_rel: tuple[float, float] = (0.5, 0.8)
    scanned_per_e_fold: float = 9.0  # frequencies of a bearing: 11 %, the half-power width of a damping of 5 %
    start_noise_rel: float = 1e-4  # of the least PSD

    # spectral_shape
    max_screened_p_value: float = 0.05  # of a spectrum whose cells as a whole do not show a cause that one shape does
    max_shape_p_value: float = 1e-3
    band_parts: int = 6  # of the band, in which a shared force is tested alone: as many as there are folds in time
    min_depth_rms: float = 0.015  # of ln(power / model): errors of filters and integrators are smaller
    explained_share: float = 0.95  # of the misfit beyond chance, for a cause that leaves nothing to be explained
    min_explained_share: float = 0.5  # of the misfit beyond chance, for a cause
    shape_tolerance_rel: float = 1e-6  # of a spectral shape of the model from flat
    negative_margin_sd: float = 3.0  # below zero, of a stiffness or damping that no bearing has
    min_noise_ratio_to_others: float = 6.0  # power of a faulty sensor's noise over that of its neighbours
    min_peak_quality: float = 1.0  # of a sensor resonance above the band: below it a low-pass filter looks alike
    min_mounting_resonance_hz: float = 500.0  # of a hand-held probe, the loosest mounting (ISO 5348)
    min_unknown_depth_rms: float = 0.1  # of a shape without a cause: laws that a model lacks shape spectra by less

    # survey
    excitation_points: int = 48  # of the spectrum of the excitation, log-spaced
    similar_energy: float = 0.1  # of the strongest mode's: a mode with less is 10 dB below it
    min_energy_share: float = 0.5  # of the kinetic energy in the band, that the rig's own modes hold
    max_misfit_db: float = 1.0  # rms of the spectrum from that of the oscillators: instruments have +-10 % (ISO 2954)
    # of frequencies: the two directions of a cap differ by less, so do parts of a nonlinear one
    same_mode_ratio: float = 2.0**0.5
    stable_frequency_rel: float = 0.01  # from one number of modes to the next
    stable_damping_rel: float = 0.2  # from one number of modes to the next

    # background_search
    # of a mode or of more knots: 3 parameters at 1 of some 1e3 distinct frequencies, p = 1e-6
    min_gain_nats: float = 20.0

    # excitation
    taper_count: int = 2  # sine tapers of a piece (Riedel and Sidorenko, IEEE Trans. Signal Process. 43, 1995, 188)
    taper_efficiency: float = 0.8  # degrees of freedom of the average, per bin over 2: 2 k / (2 k + 1) of k tapers

    # rig_spectra
    max_work_derivatives: float = 1e9  # of all rigs on trial together: about 25 s of a core of 2020

    # spectral_shape
    max_background_depth_rms: float = 0.23  # of what a background leaves, 1 dB: instruments have +-10 % (ISO 2954)


LIMITS = Thresholds()
