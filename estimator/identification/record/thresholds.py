"""Limits of the checks of a record, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass

PIECE_ROWS = 1 << 18  # that are looked at together: nothing of the size of a record is made


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Limits of the checks of a record.

    Parameters
    ----------
    max_value_si : float
        Largest value of a sample, SI; beyond it is a number read wrongly, and its powers overflow.
    max_clipped_share_bearing : float
        Share of samples at the rails beyond which no bearing is judged from a channel. The error is white, and the
        excitation is read where the motion is small: 2e-4 of the samples make S 10 % too large, 3e-3 move kL by ten
        standard deviations.
    max_clipped_share : float
        Share of samples at the rails beyond which a channel is unusable for tones and modes too. Of Gaussian vibration
        cut at this share the error has 0.4 % of the power.
    max_frozen_share : float
        Share of samples in frozen stretches beyond which a channel is unusable; it changes the rms by half of this.
    min_frozen_periods : float
        Shortest frozen stretch in mean periods of the channel. The crest of a coarsely quantised sine stands still for
        a part of one period.
    min_frozen_samples : int
        Shortest frozen stretch in samples.
    max_step_per_sd_usable, max_step_per_sd : float
        Quantisation step in standard deviations of the channel: beyond the second the rounding noise, step^2 / 12, has
        over 8 % of the power; beyond the first it is not independent of the signal (Widrow and Kollar, Quantization
        Noise, 2008, ch. 4) and the channel is unusable.
    min_spike_sd : float
        Size of a spike in robust standard deviations.
    min_spike_ratio : float
        Size of a spike over the largest of its neighbours. An anti-alias filter spreads any true shock over several
        samples: of a cut at 0.4 of the rate the next sample has at least a fifth.
    max_offset_m_s2 : float
        Mean of an acceleration channel, m/s^2; gravity has 9.81.
    max_offset_per_sd : float
        Mean over the standard deviation. Beyond it most of the range of a converter is spent on the mean.
    max_missing_share : float
        Share of missing samples of one channel in rows that others have.
    max_missing_rows_share : float
        Share of missing rows between the stretches of a record.
    min_level_step_db : float
        Change of level of one channel against the others. A loose cable loses 20 dB and more; a change of load moves
        all channels.
    max_copy_residual_share : float
        Share of the power of one channel that is not proportional to another one, of a copy. Two sensors differ by
        their noise, which is seldom below 60 dB over the whole spectrum.
    min_copy_coherence : float
        Median coherence over all frequencies of a copy. The noise floors of two sensors are not coherent.
    min_same_dof_coherence : float
        Coherence of two sensors of one degree of freedom beyond which their gain is judged.
    max_gain_error : float
        Relative distance of the gain of two sensors from a known factor. Accelerometers are calibrated to 5 %.
    min_acceleration_rms, max_acceleration_rms : float
        m/s^2. The noise of a piezoelectric accelerometer is about 1e-3; 1e5 is 10 000 g.
    max_velocity_rms : float
        m/s, 10 to 1000 Hz. ISO 20816-3 calls 0.011 m/s damaging; 5 m/s is no running machine.
    min_velocity_rms_any, min_displacement_rms : float
        m/s and m. Below the noise of laser vibrometers and eddy current probes.
    max_displacement_m : float
        m, peak; a machine that moves so far has left its room.
    max_displacement_acceleration : float
        m/s^2, rms of the acceleration that follows from a displacement channel.
    gravity_error_rel : float
        Relative distance of the mean from gravity in another unit.
    empty_spectrum_share : float
        Share of the rate; a spectrum that is empty from there on is of resampled or smoothed data. Filters of
        delta-sigma converters cut between 0.4 and 0.5.
    converter_bits : int
        Bits of the best converter in effect: a spectrum below its rounding noise is empty.
    min_repeated_share : float
        Share of samples equal to the one before them, where quantisation does not explain it.
    """

    max_value_si: float = 1e15
    max_clipped_share_bearing: float = 2e-4
    max_clipped_share: float = 0.02
    max_frozen_share: float = 0.01
    min_frozen_periods: float = 5.0
    min_frozen_samples: int = 20
    max_step_per_sd_usable: float = 2.0
    max_step_per_sd: float = 1.0
    min_spike_sd: float = 20.0
    min_spike_ratio: float = 10.0
    max_offset_m_s2: float = 20.0
    max_offset_per_sd: float = 1000.0
    max_missing_share: float = 0.01
    max_missing_rows_share: float = 0.2
    min_level_step_db: float = 20.0
    max_copy_residual_share: float = 1e-4
    min_copy_coherence: float = 0.999
    min_same_dof_coherence: float = 0.8
    max_gain_error: float = 0.1
    min_acceleration_rms: float = 1e-5
    max_acceleration_rms: float = 1e5
    max_velocity_rms: float = 5.0
    min_velocity_rms_any: float = 1e-9
    min_displacement_rms: float = 1e-12
    max_displacement_m: float = 10.0
    max_displacement_acceleration: float = 1e6
    gravity_error_rel: float = 0.01
    empty_spectrum_share: float = 0.3
    converter_bits: int = 22
    min_repeated_share: float = 0.05

    # channel_faults
    levels_samples: int = 1 << 17  # samples that the levels of a converter are counted in

    # channel_pairs
    segment_samples: int = 1024  # of the spectra of two channels
    max_pair_segments: int = 4096  # spread over the record
    min_segments: int = 16  # a coherence of 0.8 from noise has p = 0.2^15
    level_pieces: int = 40  # of the record, for the level against time

    # channel_summary
    iso_band_hz: tuple[float, float] = (10.0, 1000.0)  # of the velocity, ISO 20816-1
    # of a recorder whose filter is not known: the habit of analysers since the first ones
    rate_per_passed_hz: float = 2.56
    min_passed_amplitude: float = 0.8  # of the filter at an edge of a band: tolerance of ISO 2954 at 10 and 1000 Hz
    min_stretch_s: float = 1.0  # ten periods of the lower edge
    segment_s: float = 2.0  # of the spectrum that is integrated to velocity
    # of an averaged spectrum, spread over the record: its random error is 6 %, of a band far less
    max_summary_segments: int = 256

    # clipping
    # of the range of a channel from its extreme: so close to it are few samples of a vibration
    extreme_range_rel: float = 0.3
    rounding_rel: float = 1e-9  # of the extreme value: values of a computed tone that differ by less are one
    # different values near the extreme of a clean tone with a whole number of samples a period
    max_repeated_values: int = 64
    min_pile_samples: int = 20  # of one extreme value, besides three times as many as have the next value

    # severity
    # shaft orders; ISO; defects; resonances of sensors
    band_edges_hz: tuple[float, ...] = (10.0, 100.0, 1000.0, 5000.0, 10000.0, 20000.0)
    min_iso_speed_rpm: float = 600.0  # ISO 20816-3, ISO 10816-7: below it the lower edge is 2 Hz
    max_small_pump_kw: float = 200.0  # ISO 10816-7: above it the zones are those of large pumps

    # spikes
    gaussian_mad: float = 0.6745  # median absolute deviation over the standard deviation of a Gaussian
    min_samples: int = 16  # for the robust standard deviation
    max_median_samples: int = 1 << 17  # that a median is taken of: its error is 0.4 % of the standard deviation
    few_samples: int = 250  # whose robust standard deviation is right to some per cent
    max_spike_share: float = 0.01  # of the samples: more are no single samples
    neighbour_rows: tuple[int, ...] = (-4, -3, -2, 2, 3, 4)  # distances; a spike may have two samples

    # usable
    level_sd_rel: float = 1e-3  # of the level of a limiter: noise behind it blurs it


RECORD_LIMITS = Thresholds()  # of a channel that is judged by its samples alone
