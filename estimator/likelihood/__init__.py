"""The force balance along the measured motion, and its spectral likelihood."""
