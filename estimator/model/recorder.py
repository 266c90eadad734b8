"""The recorder's anti-alias filter as the rig file gives it: its response, and how far up it can be undone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from estimator.arrays import Array, Complexes

from .thresholds import LIMITS

AntiAliasKind = Literal["butterworth", "bessel", "chebyshev1", "chebyshev2", "fir"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AntiAlias:
    """The anti-alias filter of a recorder, one for all channels, by its design.

    Parameters
    ----------
    kind : {"butterworth", "bessel", "chebyshev1", "chebyshev2", "fir"}
        Form of the filter. All but "fir" are analogue. "fir" is a windowed linear-phase filter at the sampling rate.
    order : int
        Number of poles; of "fir" the number of taps less one.
    cutoff_hz : float
        Hz. 3 dB down; end of the ripples of "chebyshev1"; start of the stop band of "chebyshev2"; 6 dB down of "fir".
    ripple_db : float or None
        dB, ripple of the pass band of "chebyshev1", or loss in the stop band of "chebyshev2". None: 0.5 and 60 dB.
    """

    kind: AntiAliasKind
    order: int
    cutoff_hz: float
    ripple_db: float | None = None

    def response(self, f_hz: Array, rate_hz: float) -> Complexes:
        """(f,) measured over true at f_hz (f,), 1 at 0 Hz, without the delay that the filter has at 0 Hz."""
        if self.kind == "fir":
            taps = _taps(self, rate_hz)
            lag = np.arange(taps.size) - 0.5 * (taps.size - 1)
            return np.asarray(np.cos(2 * np.pi * np.multiply.outer(f_hz / rate_hz, lag)) @ taps / taps.sum(), complex)
        zeros, poles = _zeros_and_poles(self)
        s = 2j * np.pi * f_hz[..., None]
        delay_s = float(np.sum(1 / zeros).real - np.sum(1 / poles).real)
        return np.asarray(np.prod(1 - s / zeros, axis=-1) / np.prod(1 - s / poles, axis=-1)
                          * np.exp(s[..., 0] * delay_s))  # fmt: skip

    def trusted_to_hz(self, rate_hz: float) -> float:
        """Frequency, Hz, up to which aliased components behind this filter are a negligible share of the acceleration.

        The acceleration is taken as white there, as above all resonances under a white force.
        """
        f: Array = np.linspace(0.0, 0.5 * rate_hz, LIMITS.trust_grid_points)
        if self.kind == "fir":  # works on the samples: what is folded is folded before it
            return 0.5 * rate_hz
        true, aliased = (np.abs(self.response(z, rate_hz)) ** 2 for z in (f, rate_hz - f))
        beyond = np.flatnonzero(aliased > LIMITS.max_aliased_power_share * true)
        return float(f[beyond[0]]) if beyond.size else 0.5 * rate_hz


@lru_cache(maxsize=8)
def _zeros_and_poles(filter_: AntiAlias) -> tuple[Complexes, Complexes]:
    """Zeros and poles, rad/s, of an analogue filter."""
    from scipy import signal

    w, form = 2 * np.pi * filter_.cutoff_hz, "bessel_mag" if filter_.kind == "bessel" else filter_.kind
    ripple_db, loss_db = filter_.ripple_db or LIMITS.pass_band_ripple_db, filter_.ripple_db or LIMITS.stop_band_loss_db
    zeros, poles, _ = signal.iirfilter(  # type: ignore[call-overload]
        filter_.order, w, ripple_db, loss_db, btype="lowpass", analog=True, ftype=form, output="zpk"
    )
    return np.asarray(zeros, complex), np.asarray(poles, complex)


@lru_cache(maxsize=8)
def _taps(filter_: AntiAlias, rate_hz: float) -> Array:
    """(order + 1,) taps of a windowed linear-phase filter."""
    from scipy import signal

    return np.asarray(signal.firwin(filter_.order + 1, filter_.cutoff_hz, fs=rate_hz), np.float64)
