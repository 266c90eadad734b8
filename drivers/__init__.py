"""The link side: codecs without I/O, one file per link, the simulated device."""
