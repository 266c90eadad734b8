"""Records of a simulated rig, deterministic by seed."""

from .shaft_speed import ShaftSpeed
from .simulator import Simulator, simulate
from .start import Stationarity, stationarity

__all__ = ["ShaftSpeed", "Simulator", "Stationarity", "simulate", "stationarity"]
