"""Laws of velocity and hysteresis."""
