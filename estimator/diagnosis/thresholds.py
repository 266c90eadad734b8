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
    min_gain_nats: float = 5.0  # held out, fitted with the model: ln of the number of laws that a search tries
    max_left_rel: float = 0.2  # of what a candidate was to explain (rms of a force, power of a spectrum)
    max_left_of_likelier_rel: float = 0.5  # the same where no law that leaves less predicts as well
    max_frequency_over_rate: float = 0.5  # a mode or a tone above it is an image
    max_gap_over_motion: float = 1.0  # a gap wider than the largest motion is never closed

    # mistakes in the rig file
    coherence_max_p_value: float = 1e-6  # of caps that predict each other with the rig as given
    coherence_max_left_rel: float = 0.1  # power: 10 dB


THRESHOLDS = Thresholds()
