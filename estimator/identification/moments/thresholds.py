"""Limits of the paper's own methods, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # fokker_planck
    bootstrap_blocks: int = 64  # of the record, drawn with replacement
    min_counts: int = 30  # of a cell that is used
    grid_half_width_rms: float = 4.5  # of the displacement

    # plane_moments
    # of kL: what the band limit leaves out of E[x F], over k E[x^2], on rigs with 8 kHz of band
    edge_sd_rel: float = 3e-3

    # planes
    max_shaft_mass_sd_rel: float = 0.25  # of a mass that the shaft gives: four standard deviations

    # score_matching
    min_rows: int = 4096  # of a fit
    resonance_check_s: float = 0.5  # of motion, to look for a resonance
    fit_blocks: int = 64  # of a record: the standard deviations have an error of 9 %

    # stationary
    diagnostic_blocks: int = 64  # of a record, for the sampling error


LIMITS = Thresholds()
