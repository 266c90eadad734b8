"""Shaft angle against time, in closed form, so that any chunk of a simulation sees the same shaft."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from estimator.arrays import Array


@dataclass(frozen=True, slots=True)
class ShaftSpeed:
    """A shaft speed: constant, with a ramp and a slow fluctuation.

    Parameters
    ----------
    rpm : float
        Speed at t = 0.
    ramp_rpm_per_s : float
        Rate of change of the speed.
    fluctuation : float
        Rms of the fluctuation as a fraction of `rpm`: eight sines between 0.2 and 2 times `fluctuation_hz`.
    fluctuation_hz : float
        Scale of the frequencies of the fluctuation.
    seed : int
        Seed of the frequencies and phases of the fluctuation.

    Examples
    --------
    >>> import numpy as np
    >>> from estimator.simulation import ShaftSpeed
    >>> turns = ShaftSpeed(600.0).phase(np.array([0.0, 0.1, 0.2])) / (2 * np.pi)
    >>> turns.round(3).tolist()
    [0.0, 1.0, 2.0]
    """

    rpm: float
    ramp_rpm_per_s: float = 0.0
    fluctuation: float = 0.0
    fluctuation_hz: float = 0.5
    _: KW_ONLY
    seed: int = 0

    def phase(self, t: Array) -> Array:
        """Shaft angle in rad at times t in s, any shape; 0 at t = 0 but for the fluctuation."""
        turns = (self.rpm * t + 0.5 * self.ramp_rpm_per_s * t * t) / 60.0
        if self.fluctuation:
            rng = np.random.default_rng(self.seed)
            f = self.fluctuation_hz * rng.uniform(0.2, 2.0, 8)
            start = rng.uniform(0.0, 2.0 * np.pi, 8)
            amplitude = self.rpm / 60.0 * self.fluctuation * np.sqrt(2.0 / 8)
            for fi, a in zip(f, start, strict=True):
                turns = turns + amplitude / (2 * np.pi * fi) * np.sin(2 * np.pi * fi * t + a)
        return np.asarray(2.0 * np.pi * turns)

    def pulses(self, t: Array, width_s: float, duty: float = 0.1) -> Array:
        """Tacho signal at times t in s, 0 to 1: high for `duty` of a turn from angle 0, averaged over `width_s`."""

        def high(turns: Array) -> Array:  # turns spent high since 0
            whole = np.floor(turns)
            return np.asarray(whole * duty + np.minimum(turns - whole, duty))

        before = self.phase(t - 0.5 * width_s) / (2 * np.pi)
        after = self.phase(t + 0.5 * width_s) / (2 * np.pi)
        moved = after - before
        still = np.asarray(np.mod(before, 1.0) < duty, dtype=float)
        return np.where(moved > 0, (high(after) - high(before)) / np.where(moved > 0, moved, 1.0), still)
