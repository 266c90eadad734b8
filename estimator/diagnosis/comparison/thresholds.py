"""Limits of the comparison of model and record, each with its unit and its origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Every limit by quantity and unit, file by file. rel : share of the quantity itself."""

    # curves
    mean_seconds: float = 5.0  # of the record that conditional means are taken over
    inner_rms: float = 0.75  # rms of displacement that the straight line of small motion is drawn through
    turn_orders: tuple[float, float] = (1.0, 2.0)  # orders that repeat with every turn

    # free_run
    oversample_factor: int = 8  # steps of the integration in a sample
    settle_decay_times: float = 12.0  # decay times until the start from rest is forgotten
    chunk_s: float = 4.0  # of a record that is resampled at a time
    block_cycles: float = 32.0  # of the lower band edge in a block of the spectrum of the error

    # heldout
    spectrum_cells: int = 40  # of the free force spectrum of the black box

    # survey
    max_hidden_force_percent: float = 3.0  # of the bearing force: the least effect that users are promised to see
    # of a record that shows the effects that are there: of 14 hidden ones in 10 to 12 s, 4 were not seen
    min_seconds_beside_modes: float = 15.0
    max_fitted_laws: int = 2  # that are fitted together with the model where only a law shows a force

    # twin
    twin_seconds: float = 5.0  # of the simulated record
    settle_seconds: float = 2.0  # from rest, under a measured force


LIMITS = Thresholds()
