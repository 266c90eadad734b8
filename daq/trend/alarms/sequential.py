"""A sequential test for a change of a number that is estimated again and again, at an accepted false-alarm rate.

The values in control are taken as white noise beside a slow drift that comes back (autoregressive, order one), which
together are ARMA(1, 1). Its prediction errors are white; a CUSUM of them (Page 1954) raises an alarm. A change of the
mean by d shifts the errors by d (1 - phi) / (1 - theta) in the long run. The threshold follows from the accepted rate
by the run length of the CUSUM (Brook & Evans 1972), averaged over what the learned values leave uncertain.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from math import exp, inf, log, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import ndtr

MAX_PHI = 0.999  # a drift that returns over more than a thousand values looks like a change
MIN_SHIFT = (
    0.1  # half of the shift that is looked for, in standard deviations of the errors: below it, it takes for ever
)
CHAIN_STATES = 60  # of the Markov chain
SURE_LOG_SCALE_SD = 0.12  # of a baseline that is watched by: twice it moves the run length by about a factor of two
MAX_LOG_SCALE_SD = 0.5  # beyond it a baseline says nothing
MAX_THRESHOLD = 200.0  # standard deviations
NODES_OF_MEAN, NODES_OF_SCALE = 7, 7  # of the average over what is not known
MAX_DELAY_VALUES = 10_000
NEVER_SHARE = 1e-14  # probability
START_ERRORS = 50  # of the filter, before its errors are white
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """How a number behaves in control.

    mean, sd : of the values, and of their prediction errors. phi, theta : of the ARMA(1, 1), 0 <= theta <= phi < 1;
    both 0: white. values : that it was learned from. typical_sd : median of their stated standard deviations, 0: none.
    """

    mean: float
    sd: float
    phi: float
    theta: float
    values: int
    typical_sd: float = 0.0

    @property
    def gain(self) -> float:
        """Shift of the errors in the long run over a shift of the mean."""
        return (1.0 - self.phi) / (1.0 - self.theta)

    @property
    def spread(self) -> float:
        """Standard deviation of a value over that of its prediction error."""
        return sqrt(1.0 + (self.phi - self.theta) ** 2 / (1.0 - self.phi**2))

    def to_json(self) -> dict[str, Any]:
        """Its numbers by name."""
        return asdict(self)


def errors_of(values: Floats, phi: float, theta: float) -> Floats:
    """(n,) prediction errors of values without their mean."""
    from scipy.signal import lfilter  # loads for half a second, and few rigs have alarms

    out: Floats = lfilter([1.0, -phi], [1.0, -theta], values)
    return out


def learn(values: Floats, sds: Floats | None = None) -> Baseline:
    """The baseline of (n,) values, equally spaced, in control; by conditional least squares.

    sds : (n,) stated standard deviations.
    """
    n, skip = len(values), min(START_ERRORS, len(values) // 4)

    def fitted(phi: float, theta: float) -> tuple[float, float]:
        """Mean, and mean square of the errors."""
        e, one = errors_of(values, phi, theta)[skip:], errors_of(np.ones(n), phi, theta)[skip:]
        mean = float(one @ e / (one @ one))
        return mean, float(np.mean((e - mean * one) ** 2))

    def loss(p: Floats) -> float:
        phi, theta = _shape(p)
        return 0.5 * n * log(max(fitted(phi, theta)[1], 1e-300))

    white = 0.5 * n * log(max(fitted(0.0, 0.0)[1], 1e-300))
    starts = [np.array([a, b]) for a in (0.0, 2.0, 4.0) for b in (-1.0, 1.0)]
    best = min((minimize(loss, s, method="Nelder-Mead", options={"maxiter": 200, "xatol": 0.02}) for s in starts),
               key=lambda found: found.fun)  # fmt: skip
    phi, theta = _shape(best.x) if white - best.fun > log(n) else (0.0, 0.0)  # two more numbers, Schwarz 1978
    mean, square = fitted(phi, theta)
    typical = 0.0 if sds is None or not np.isfinite(sds).any() else float(np.nanmedian(sds))
    return Baseline(mean=mean, sd=max(sqrt(square), 1e-12 * abs(mean), 1e-300), phi=phi, theta=theta, values=n,
                    typical_sd=typical)  # fmt: skip


def _shape(p: Floats) -> tuple[float, float]:
    """phi and theta of two numbers without limits: theta between 0 and phi."""
    phi = MAX_PHI / (1.0 + exp(-min(max(float(p[0]), -30.0), 30.0)))
    return phi, phi / (1.0 + exp(-min(max(float(p[1]), -30.0), 30.0)))


def run_length(reference: float, threshold: float, mean: float = 0.0, scale: float = 1.0) -> float:
    """Mean number of errors until a one-sided CUSUM passes its threshold.

    reference, threshold : in the standard deviation that is believed; mean, scale : of the errors in that unit.
    """
    width = threshold / (CHAIN_STATES - 0.5)  # the first state is half as wide
    at = width * np.arange(CHAIN_STATES)
    edges = (at[None, :] + 0.5 * width - at[:, None] + reference - mean) / scale
    below = ndtr(edges)
    step = np.diff(below, axis=1, prepend=0.0)
    if step[-1].sum() > 1.0 - NEVER_SHARE:  # it does not leave even from just below the threshold
        return inf
    return float(np.linalg.solve(np.eye(CHAIN_STATES) - step, np.ones(CHAIN_STATES))[0])


def _log_scale_sd(values: int, phi: float, theta: float, radians: float) -> float:
    """Standard deviation of the logarithm of the errors' scale at a frequency, by the information of an ARMA(1, 1).

    radians : per value.
    """
    own = 0.5 / values
    if phi > 0:
        cross = -1.0 / (1.0 - phi * theta)
        information = np.array([[1.0 / (1.0 - phi**2), cross], [cross, 1.0 / (1.0 - theta**2)]])
        turn = np.exp(-1j * radians)
        gradient = np.array([(turn / (1.0 - phi * turn)).real, -(turn / (1.0 - theta * turn)).real])
        own += float(gradient @ np.linalg.solve(information, gradient)) / values
    return min(sqrt(own), MAX_LOG_SCALE_SD)


def baseline_is_sure(baseline: Baseline) -> bool:
    """Whether enough was learned: a number that drifts slowly needs longer."""
    return _log_scale_sd(baseline.values, baseline.phi, baseline.theta, 0.0) <= SURE_LOG_SCALE_SD


@lru_cache(maxsize=64)
def threshold(reference: float, values: int, phi: float, theta: float, per: float) -> float:
    """Threshold of a one-sided CUSUM that passes it once in `per` errors on average, over many baselines.

    values : that the baseline was learned from, with phi and theta: what these leave uncertain is averaged over. Of the
    scale that is the frequency of which an excursion to the threshold, at the reference a value, is half a period.
    """
    m, wm = np.polynomial.hermite_e.hermegauss(NODES_OF_MEAN)
    s, ws = np.polynomial.hermite_e.hermegauss(NODES_OF_SCALE)

    def excess(h: float) -> float:
        log_sd = _log_scale_sd(values, phi, theta, pi * min(1.0, reference / h))
        rate = 0.0
        for a, u in zip(m / sqrt(values), wm / wm.sum(), strict=True):
            for b, v in zip(np.exp(s * log_sd), ws / ws.sum(), strict=True):
                rate += u * v / run_length(reference, h, mean=float(a), scale=float(b))
        return log(max(rate * per, 1e-300))

    low, high = 1e-3, 4.0
    if excess(low) <= 0:
        return low  # a single error beyond the reference is rarer than what is accepted
    while excess(high) > 0 and high < MAX_THRESHOLD:
        low, high = high, 2.0 * high
    return float(brentq(excess, low, high, xtol=1e-3)) if high < MAX_THRESHOLD else MAX_THRESHOLD


class Cusum:
    """A two-sided CUSUM. change : of the value, that is an alarm. per : mean number of values between false alarms."""

    def __init__(self, baseline: Baseline, change: float, per: float) -> None:
        self.baseline = baseline
        shift = abs(change) * baseline.gain / baseline.sd
        self.reference = max(0.5 * shift, MIN_SHIFT)
        self.threshold = threshold(
            round(self.reference, 3), baseline.values, round(baseline.phi, 4), round(baseline.theta, 4), 2.0 * per
        )
        self._value: float | None = None
        self._error = 0.0
        self.up = self.down = 0.0

    def update(self, value: float, sd: float | None = None) -> int:
        """Take a value. +1 or -1: the mean is above or below the baseline; 0: nothing to say."""
        b = self.baseline
        own = value - b.mean
        if self._value is None:  # nothing predicts it
            self._error = own / b.spread
        else:
            self._error = own - b.phi * self._value + b.theta * self._error
        self._value = own
        error = self._error / b.sd
        if sd is not None and b.typical_sd > 0:  # less certain than when it was learned: it counts less
            error /= max(1.0, sd / b.typical_sd)
        self.up = max(0.0, self.up + error - self.reference)
        self.down = max(0.0, self.down - error - self.reference)
        return 1 if self.up > self.threshold else -1 if self.down > self.threshold else 0

    def reset(self) -> None:
        """Begin again, after an alarm."""
        self.up = self.down = 0.0

    def interrupted(self) -> None:
        """The next value does not follow the last one: there was a gap."""
        self._value = None

    def delay(self, change: float) -> float:
        """Values until a change of the mean is an alarm, if the noise adds nothing; on average, if it never is then."""
        size = abs(change) / self.baseline.sd
        errors = size * errors_of(np.ones(MAX_DELAY_VALUES), self.baseline.phi, self.baseline.theta)
        steps = np.cumsum(errors - self.reference)
        passed = steps - np.minimum(np.minimum.accumulate(steps), 0.0) > self.threshold
        if passed.any():
            return float(np.argmax(passed)) + 1.0
        return run_length(self.reference, self.threshold, mean=size * self.baseline.gain)
