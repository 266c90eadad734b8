"""What every table of the rig file is: unknown keys are errors, numbers are finite, nothing is converted silently."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
