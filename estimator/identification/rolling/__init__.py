"""The same fit while samples arrive."""

from .estimator import RollingEstimator
from .watch import every

__all__ = ["RollingEstimator", "every"]
