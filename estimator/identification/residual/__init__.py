"""The part of the residual force that a flexible black box can still predict."""
