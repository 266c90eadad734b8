"""Gauss-Newton fit of all laws of a model to a record, and the measured transfer function."""
