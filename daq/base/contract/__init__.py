"""The sink contract, the clock, scaling of counts, errors."""
