"""A rig as frozen data in SI units, and the linear algebra and bearing theory that follow from it."""
