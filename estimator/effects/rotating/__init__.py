"""Laws of the shaft angle and of the rotor."""
