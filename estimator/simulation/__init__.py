"""A rig in time: what its sensors would send, deterministic by seed."""

from .simulator import Simulator, simulate
from .start import Stationarity, stationarity

__all__ = ["Simulator", "Stationarity", "simulate", "stationarity"]
