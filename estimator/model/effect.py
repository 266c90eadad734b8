"""What an effect is (the effect seam). One file in effects/ defines one `Effect`.

Laws are scalar functions that numba can compile, with one signature for all, so that the simulator, the estimator's
features and the report call the same text. All SI. Restoring convention (rig.py): M a + C v + K x + law = F.

    force(x, v, xo, vo, t, phase, s, p) -> float
        x, v : displacement and velocity at the place (for kind "shaft": disc minus the mean of the caps);
        xo, vo : those of the other direction at the same node; t : s; phase : shaft angle, rad;
        s : +1 in direction x, -1 in direction y; p : (k,) float64, the parameters in declared order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["force", "memory", "disc", "shaft", "excitation", "sensor"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """name, unit and limits of one parameter.

    linear : the law is proportional to it (an amplitude, solved for exactly); otherwise it is searched on [low, high].
    scale : the natural size. For a searched parameter, low, high and default are multiples of it (strength.py):
        "x" displacement rms, "v" velocity rms, "a" acceleration rms of the place, "m" its mass, "hz_peak" its resonance
        in Hz, "sample" the sampling interval in s, "band" the upper band edge in Hz;
        "1", "angle", "order": as they are; "bpfo", "balls": from the rig's geometry or ball_pass_order where known.
        For a linear parameter it says nothing: its size follows from the data.
    given : taken from the rig or the default, never searched.
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    description: str
    linear: bool = False
    scale: str = "1"
    given: bool = False


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical effect or fault. Texts are for the user: `rotorscope effects NAME` prints them.

    kind : force (acts on a cap), memory (a cap force with its own states), disc (acts on the disc), shaft (between
        disc and caps), excitation (shapes the unknown force), sensor (acts on a measured channel).
    scope : "direction": parameters of its own in x and in y; "node": one set shared by both directions of a node.
    one_direction : of scope node: also where one direction alone is measured, as if nothing moved in the other.
    stationary_density : whether exp(-H/T) survives (physics.md section 6, column FDT).
    states, rates, memory_force : for kind memory: number of states z;
        rates(z, x, v, p, lin, dz) -> None fills dz; memory_force(z, x, v, p, lin) -> float; lin = (m, kL, c).
    for_given : for a law that is far faster made for its given parameters: for_given(p) -> the same law, which reads
        those of this p whatever it is handed.
    apply : for kind sensor: apply(y (n,), rate_hz, p, rng) -> (n,).
    shape : for kind excitation: shape(f_hz (n,), p) -> (n,) multiplier of S.
    """

    name: str
    kind: Kind
    parameters: tuple[EffectParameter, ...]
    equation: str
    signature: str
    confused_with: tuple[str, ...]
    distinguish: str  # what separates it from those
    reference: str
    check: str  # value reproduced by its test, and its source
    on_machine: str  # what an engineer should look at on the machine
    scope: Literal["direction", "node"] = "direction"
    one_direction: bool = False
    stationary_density: bool = False
    force: Callable[..., float] | None = None
    for_given: Callable[[Any], Callable[..., float]] | None = None
    states: int = 0
    rates: Callable[..., None] | None = None
    memory_force: Callable[..., float] | None = None
    apply: Callable[..., Any] | None = None
    shape: Callable[..., Any] | None = None

    @property
    def turns(self) -> bool:
        """Whether the law goes with the shaft angle."""
        if self.force is None:
            return False
        p = [1.0 if q.linear else q.default for q in self.parameters]
        begin, later = (self.force(1.0, 1.0, 1.0, 1.0, 1.0, phase, 1.0, p) for phase in (0.0, 1.0))
        return bool(begin != later)
