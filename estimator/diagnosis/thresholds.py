"""Thresholds of the verdict: what an effect has to show before it is named."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Thresholds:
    """Every threshold by quantity and unit. rel : share of an rms force. Origin: docs/diagnosis-measured.md."""

    # ranking
    max_p_value: float = 1e-3  # after counting all trials, for an effect to be claimed; no false alarm in 200 rotors
    further_bearing_max_p_value: float = 1e-2  # after counting all trials, for a second bearing to be named too
    parameter_cost_nats: float = 1.5  # what an idle parameter gains held in and loses held out
    same_force_min_rel: float = 0.5  # of the largest force that any candidate explains, to be ranked by nats
    rival_nats: float = 10.0  # behind the first, within which the record does not tell two candidates apart
    min_ahead_nats: float = 3.0  # of a law that is added: 20 to 1, strong evidence (Kass and Raftery 1995)

    # gates
    max_lost_folds: int = 1  # held-out time folds in which a candidate may lose: of six weak gains one is by chance
    amplitude_max_p_value: float = 1e-3  # of the loss that chance makes on the largest amplitudes
    amplitude_margin_nats: float = 3.0  # added to the loss that chance makes
    min_tone_percent: float = 2.0  # of the bearing force, of a tone beside those of shaft and mains: a weak effect
    min_hidden_law_percent: float = 1.0  # of the bearing force, that no regressor shows: errors of modes made 0.6 %
    min_gain_nats: float = 5.0  # held out, fitted with the model: ln of the number of laws that a search tries
    max_left_rel: float = 0.2  # of what a candidate was to explain (rms of a force, power of a spectrum)
    max_left_of_likelier_rel: float = 0.5  # the same where no law that leaves less predicts as well
    max_frequency_over_rate: float = 0.5  # a mode or a tone above it is an image
    max_gap_over_motion: float = 1.0  # a gap wider than the largest motion is never closed

    # mistakes in the rig file
    coherence_max_p_value: float = 1e-6  # of caps that predict each other with the rig as given
    coherence_max_left_rel: float = 0.1  # power: 10 dB

    # gate_amplitude
    upper_share: float = 0.2  # of the samples: the upper windows
    window_samples: int = 1024  # blocks are a multiple of it
    judged_seconds: float = 24.0  # of the record

    # rig_changes
    # of a mass or a spring: slips of a unit, a factor of two, of a half
    trial_factors: tuple[float, ...] = (0.1, 0.5, 2.0, 10.0)
    max_factor_sd_log: float = 0.2  # beyond which a factor is said to be rough
    inverted_error: float = -2.0  # relative error of the gain of an inverted channel

    # rig_file
    trial_rows: int = 2**19  # of the record, for the spectra: 20 s at 25.6 kHz
    refining_steps: int = 8  # of the factor that explains most
    factor_step_log: float = 0.1  # to either side of a factor, for its standard deviation
    min_factor_log: float = 0.1  # of a factor from one: instruments have +-10 % (ISO 2954)
    min_fall_nats: float = 1e-4  # of a likelihood that does not depend on the factor
    min_factor_sd: float = 3.0  # of its logarithm, of a factor from one
    followed_step_log: float = 0.35  # of a factor, a half: the modes of one fit are near those of the next
    max_log_factor: float = 2.6  # that is followed: a slip of a digit with its standard deviation
    min_screened_nats: float = 5.0  # gained before the modes of a hypothesis are sought: half of what it has to gain
    rival_costs: float = 10.0  # costs of a mode behind one that explains the spectra, before its own modes are sought
    max_searched: int = 3  # hypotheses, the likeliest with the modes of the given rig, whose own modes are sought
    unsound_nats: float = -1e12  # in place of the likelihood of a rig that explains nothing

    # screen
    search_seconds: float = 6.0  # of the record, for searched parameters
    max_refined_trials: int = 12
    refined_min_gain_rel: float = 0.3  # of the best gain at a bearing: an effect that reaches it is refined everywhere
    borrowed_min_gain_rel: float = 0.2  # of the best effect's gain: below it no searched parameters are borrowed

    # trial
    max_steps: int = 3  # of Gauss-Newton in searched parameters
    max_step_rel: float = 0.4  # of the value of a searched parameter
    step_min_gain_nats: float = 0.5
    borrowed_max_p_value: float = 1e-3  # of the trial whose searched parameters are tried at the other locations
    contender_min_gain_rel: float = 0.5  # of the best effect's gain: below it the rest of the record is not used
    contender_max_behind_nats: float = 25.0  # behind the best effect: beyond it the rest of the record is not used
    contender_max_p_value: float = 0.45  # on two fifths of a record; above it the rest makes 0.6 % significant

    # bearing
    max_fitted: int = 5  # candidates that are fitted together with the model
    max_paired: int = 3  # candidates of which two are tried together

    # diagnose
    max_messages: int = 10  # more are not read

    # joint_fit
    law_fit_rounds: int = 6
    normal_95: float = 1.645  # standard deviations, one side

    # signal_findings
    min_p_value: float = 1e-300  # below it the logarithm has no meaning


THRESHOLDS = Thresholds()
