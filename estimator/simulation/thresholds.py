"""Limits of the room `simulation`, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # simulator
    block_samples: int = 1024  # output samples made at a time; another size gives other random numbers
    margin_samples: int = 512  # before and after a block, for the memory of sensor effects

    # start
    burn_s: float = 0.5  # run before the record where the stationary density is not known
    min_barrier_t: float = 20.0  # height of the potential barrier of a softening model, over its temperature

    # stepper
    shape_taps: int = 4096  # length of the filter that gives a force its spectral shape


LIMITS = Thresholds()
