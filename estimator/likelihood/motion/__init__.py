"""Laws and regressors evaluated along a record of band-limited motion."""
