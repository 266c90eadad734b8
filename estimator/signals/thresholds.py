"""Limits of filters, line spectra and shaft angle, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # band_limit
    max_sample_si: float = 1e15  # no sensor reads more: a larger sample counts as missing, as its powers would overflow
    # share of the lower band edge below which a displacement sensor shows offset and drift
    drift_over_low_edge: float = 0.05
    # share of the lower band edge below which a force sensor shows offset and drift
    force_drift_over_low_edge: float = 0.02
    resonant_filter_lengths: int = 2  # length of filters beside one that holds a resonance, over their usual length
    edge_search_points: int = 2001  # frequencies about the lower edge at which a resonance is searched
    resonance_grid_hz: float = 0.05  # resolves a resonance that rings for some seconds

    # line_spectrum
    noise_reach_bins: int = 240  # neighbours on either side for the local noise
    noise_stride_bins: int = 4  # step between these neighbours
    min_noise_reach_bins: int = 30  # neighbours on either side near 0 Hz, all used
    line_reach_bins: int = 20  # neighbours on either side among which a line has to dominate
    min_force_hz: float = 2.0  # no residual force below
    bins_per_chunk: int = 1 << 16  # processed at a time
    min_force_power_rel: float = 1e-12  # of the largest, of a measured force: below it rounding of sums is all there is
    outlier_power_ratio: float = 6.0  # power over the local noise above which a bin counts less in the local noise
    min_line_power_share: float = 0.45  # of the power above the noise that has the shape of a line

    # shaft_angle
    min_pulses: int = 4  # of a tacho, for an angle
    # a pulse counts once the signal was this share of the pulse height below its middle
    hysteresis_over_height: float = 0.1
    # a longer distance between pulses holds several turns (missing samples, a weak pulse)
    long_over_period: float = 1.5
    short_over_period: float = 0.5  # a shorter distance between pulses is no turn (ringing, interference)


LIMITS = Thresholds()
