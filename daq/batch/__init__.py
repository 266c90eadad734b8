"""Many logs at once: every analysis of an archive on Dask, with the answers as tables."""
