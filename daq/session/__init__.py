"""One core loop per device: readings in, ring, estimator, sinks."""
