"""The result of any fit, whatever the method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .estimate import Parameter
from .shared_value import shared


@dataclass(frozen=True, slots=True)
class Fit:
    """Parameters by full name ("bearing1.x.kL"), in SI. log_likelihood in nats, None where a method has none.

    method : spectral | fokker-planck | score-matching | volterra. messages : one line each, for the user to read
    (assumptions the data contradict, what was left out).
    """

    parameters: Mapping[str, Parameter]
    log_likelihood: float | None
    samples: int
    method: str
    messages: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As schemas/fit.json, and `shared`: of each law's parameter, one value for all places."""
        return {
            "schema": 1,
            "parameters": {name: p.to_json() for name, p in self.parameters.items()},
            "shared": {name: value.to_json() for name, value in shared(self.parameters).items()},
            "log_likelihood": self.log_likelihood,
            "samples": self.samples,
            "method": self.method,
            "messages": list(self.messages),
        }
