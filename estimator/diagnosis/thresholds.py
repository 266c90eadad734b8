"""Thresholds of the verdict: what an effect has to show before it is named."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Every threshold by quantity and unit. rel : share of an rms force. Origin: docs/diagnosis-measured.md."""

    # ranking
    max_p_value: float = 1e-3  # after counting all trials, for an effect to be claimed; no false alarm in 200 rotors
    further_bearing_max_p_value: float = 1e-2  # after counting all trials, for a second bearing to be named too
    parameter_cost_nats: float = 1.5  # what an idle parameter gains held in and loses held out
    rival_nats: float = 10.0  # behind the first of the ranking, within which the shape of the misfit decides
    min_gain_nats: float = 5.0  # held out, where no force is missing: ln of the number of laws that a search tries

    # largest amplitudes
    amplitude_max_p_value: float = 1e-3  # of the loss that chance makes
    amplitude_margin_nats: float = 3.0  # added to the loss that chance makes

    # shape of the misfit of a law in its own state
    misfit_max_p_value: float = 1e-3  # above it the misfit counts as zero
    misfit_max_rel: float = 0.1  # left by the right law
    friction_misfit_max_rel: float = 0.35  # a film, micro-slip or a simulation rounds the step and leaves 0.1 to 0.2
    other_terms_misfit_min_rel: float = 0.5  # of terms not the law's own: less may be another law's
    stateless_misfit_max_rel: float = 0.2  # of a law of no single state: more means another law
    one_direction_misfit_max_rel: float = 0.12  # of a law of two directions with one measured: Hertz leaves 0 to 0.14
    stateless_nothing_rel: float = 0.9  # misfit of a law of no single state that is not the first of two
    stateless_growth_max: float = 1.5  # times the missing force: a law that leaves more explains nothing
    part_misfit_ratio: float = 2.0  # times the largest allowed misfit, from where part of the record decides

    # spectra and shaft
    memory_law_min_rel: float = 0.5  # of an unexplained part of the spectrum: a smaller memory law mimics it
    spectrum_misfit_max_rel: float = 1 / 3  # left of a spectrum by a shape of the catalogue
    shaft_min_gain_nats: float = 30.0  # for a shaft that differs from the rig file to be reported


THRESHOLDS = Thresholds()
