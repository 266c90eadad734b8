"""A simulated device, with faults on request."""

from .simulated import DeviceConfig, SimulatedDevice

__all__ = ["DeviceConfig", "SimulatedDevice"]
