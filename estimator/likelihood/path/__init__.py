"""Gram matrices, Jacobian and Newton steps of the path likelihood, and standard deviations."""
