"""The same fit while samples arrive."""

from .estimator import RollingEstimator
from .watch import watchable_effects

__all__ = ["RollingEstimator", "watchable_effects"]
