"""The fit while samples arrive: parameters from memories that forget exponentially."""

from .estimator import RollingEstimator
from .watch import watchable_effects

__all__ = ["RollingEstimator", "watchable_effects"]
