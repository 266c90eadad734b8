"""The folder of this file is on the import path: helpers that several folders share lie beside it."""

from hypothesis import settings

# The first call of compiled code takes seconds, and this machine may be busy: time is for the benchmarks.
settings.register_profile("rotorscope", deadline=None)
settings.load_profile("rotorscope")
