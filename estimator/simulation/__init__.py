"""Records of a simulated rig, deterministic by seed."""

from .simulator import Simulator, simulate
from .stepper import ShaftSpeed, Stationarity, stationarity

__all__ = ["ShaftSpeed", "Simulator", "Stationarity", "simulate", "stationarity"]
