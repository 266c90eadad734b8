"""Whitening, Gram matrices, Jacobian and one Newton step of the path likelihood."""
