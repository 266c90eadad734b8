"""A simulated device, with faults on request."""
