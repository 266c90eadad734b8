"""Definition of an effect (the effect seam). One file in effects/ defines one `Effect`.

Laws are scalar functions that numba can compile, with one signature for all, so that the simulator, the estimator's
features and the report call the same text. All SI. Restoring convention (rig.py): M a + C v + K x + law = F.

    force(x, v, xo, vo, t, phase, s, p) -> float
        x, v : displacement and velocity at the place (for kind "shaft": disc minus the mean of the caps);
        xo, vo : those of the other direction at the same node; t : s; phase : shaft angle, rad;
        s : +1 in direction x, -1 in direction y; p : (k,) float64, the parameters in declared order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from .law_character import State, law_power, law_state

Kind = Literal["force", "memory", "disc", "shaft", "excitation", "sensor"]
FoundBy = Literal["law", "harmonics", "spectrum", "coherence", "samples"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One parameter of an effect: name, unit and limits.

    Parameters
    ----------
    name, unit : str
        As in a rig file; the unit is SI.
    low, high, default : float
        Limits and usual value, in SI for a parameter that is linear or given, else in multiples of `scale`.
    description : str
        What it is, for the user.
    linear : bool
        The law is proportional to it (an amplitude, solved for exactly). Otherwise it is searched on [low, high].
    scale : str
        Natural size of a searched parameter: "x" displacement rms, "v" velocity rms, "a" acceleration rms of the place,
        "m" its mass, "hz_peak" its resonance in Hz, "sample" the sampling interval in s, "band" the upper band edge in
        Hz; "1", "angle", "order" as they are; "bpfo", "balls" from the rig's geometry or ball_pass_order where known.
        Of a linear parameter only "shaft" counts: `Effect.typical` is then a share of the stiffness of each shaft half.
    given : bool
        Taken from the rig or the default, never searched.
    share : float
        Usual size of a further amplitude over the first amplitude of the effect, in SI.
    """

    name: str
    unit: str
    low: float
    high: float
    _: KW_ONLY
    default: float
    description: str
    linear: bool = False
    scale: str = "1"
    given: bool = False
    share: float = 1.0


def amplitude(
    name: str, unit: str, description: str, *, signed: bool = False, scale: str = "1", given: bool = False,
    share: float = 1.0,
) -> EffectParameter:  # fmt: skip
    """A parameter that the law is proportional to: from 0, or of either sign where it is signed; 0 by default."""
    return EffectParameter(
        name=name, unit=unit, low=-np.inf if signed else 0.0, high=np.inf, default=0.0, description=description,
        linear=True, scale=scale, given=given, share=share,
    )  # fmt: skip


def searched(
    name: str, unit: str, description: str, span: tuple[float, float, float], *, scale: str = "1", given: bool = False
) -> EffectParameter:
    """A parameter that the law is not proportional to. span : its limits and usual value, in multiples of `scale`."""
    low, high, default = span
    return EffectParameter(name, unit, low, high, default=default, description=description, scale=scale, given=given)


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """A physical effect or fault, and all that is known of it. Texts are printed by `rotorscope effects NAME`.

    Parameters
    ----------
    name : str
        As in a rig file.
    kind : {"force", "memory", "disc", "shaft", "excitation", "sensor"}
        Where it acts. force: on a bearing cap. memory: on a cap, with states of its own. disc: on the disc. shaft:
        between disc and caps. excitation: shapes the unknown force. sensor: changes a measured channel.
    parameters : tuple of EffectParameter
        In the order of p.
    equation, signature, distinguish, reference, check, on_machine : str
        The law in one line; what it shows in a record; what separates it from `confused_with`; its source; a value that
        its test reproduces; what to look at on the machine.
    confused_with : tuple of str
        Names of effects that look alike.
    refines : str or None
        Name of the effect that is this law with some of its amplitudes at zero. A diagnosis tries this law only where
        that effect is in the model already. None: the law contains no other one.
    scope : {"direction", "node", "bearings"}
        direction: parameters of its own in x and in y. node: one set for both directions of a node. bearings: one set
        for a direction of both bearings.
    one_direction : bool
        Of scope node: acts also where one direction alone is measured, as if nothing moved in the other.
    stationary_density : bool
        Whether exp(-H/T) stays the stationary density.
    force : callable or None
        force(x, v, xo, vo, t, phase, s, p) -> N, see above.
    for_given : callable or None
        for_given(p) -> the force law with the given parameters of this p built in, which is faster.
    states, rates, memory_force : int, callable, callable
        Of kind memory: the number of states z; rates(z, x, v, p, lin, dz) fills dz; memory_force(z, x, v, p, lin) -> N;
        lin = (m, kL, c) of the place.
    apply : callable or None
        Of kind sensor: apply(y (n,), rate_hz, p, rng) -> (n,).
    shape : callable or None
        Of kind excitation: shape(f_hz (n,), p) -> (n,) multiplier of S.
    found_by : {"law", "harmonics", "spectrum", "coherence", "samples"}
        What its parameters are estimated from. law: the force balance along the motion. harmonics: lines of a periodic
        force. spectrum: the residual force's spectrum, or the transfer function beside a measured force. coherence: of
        the residual forces at the two bearings. samples: the raw samples of a channel.
    harmonics : tuple of int, "all" or None
        Of found_by harmonics: the orders of its angle that the force has.
    channel_response : callable or None
        Of kind sensor: channel_response(w (n,) rad/s, p) -> (n,) complex, measured over true; None if there is none.
    spectral_factor : callable or None
        spectral_factor(f_hz (n,), p) -> (n,) multiplier of a white force's spectrum; None of an effect without.
    in_likelihood : bool
        Whether the held-out likelihood sees what it explains; not if that lies out of the band or beside the motion.
    watched : bool
        Whether the rolling estimate looks for it while samples arrive.
    typical : mapping of str to (float, float)
        Where strength is no force: the parameter that sets it -> its weak and its strong value, in multiples of the
        parameter's scale.
    """

    name: str
    kind: Kind
    parameters: tuple[EffectParameter, ...]
    equation: str
    signature: str
    confused_with: tuple[str, ...]
    distinguish: str
    reference: str
    check: str
    on_machine: str
    scope: Literal["direction", "node", "bearings"] = "direction"
    one_direction: bool = False
    stationary_density: bool = False
    force: Callable[..., float] | None = None
    for_given: Callable[[Any], Callable[..., float]] | None = None
    states: int = 0
    rates: Callable[..., None] | None = None
    memory_force: Callable[..., float] | None = None
    apply: Callable[..., Any] | None = None
    shape: Callable[..., Any] | None = None
    found_by: FoundBy = "law"
    harmonics: tuple[int, ...] | Literal["all"] | None = None
    channel_response: Callable[..., Any] | None = None
    spectral_factor: Callable[..., Any] | None = None
    in_likelihood: bool = True
    watched: bool = False
    refines: str | None = None
    typical: Mapping[str, tuple[float, float]] = field(default_factory=lambda: MappingProxyType({}), hash=False)

    @property
    def state(self) -> State:
        """The arguments that the force law is a function of, by evaluating the law.

        displacement, velocity: of its own direction, one of them; both: the two; directions: of the other direction,
        too; time, shaft_angle: of these, whatever else; none: no force law.
        """
        return "none" if self.force is None else law_state(self.force, self.parameters, self.one_direction)

    @property
    def power(self) -> int | None:
        """Exponent n of a law that is an amplitude times x^n."""
        return None if self.force is None else law_power(self.force, self.parameters)

    @property
    def turns(self) -> bool:
        """Whether the law depends on the shaft angle."""
        return self.state == "shaft_angle"

    @property
    def flat_magnitude(self) -> bool:
        """Whether the effect is a response that leaves the shape of its channel's spectrum: a gain or a delay."""
        return self.channel_response is not None and self.spectral_factor is None

    @property
    def scales_channel(self) -> bool:
        """Whether the effect is a response that is the same at every frequency: a gain."""
        if self.channel_response is None:
            return False
        slow, fast = self.channel_response(SLOW_AND_FAST, [q.default for q in self.parameters])
        return bool(slow == fast)

    @property
    def adds_noise(self) -> bool:
        """Whether the effect is noise of a sensor: seen in a spectrum, and no response."""
        return self.kind == "sensor" and self.found_by == "spectrum" and self.channel_response is None

    @property
    def adds_resonance(self) -> bool:
        """Whether the effect is a resonance under a cap: a linear memory, seen in a spectrum."""
        return self.kind == "memory" and self.found_by == "spectrum"


SLOW_AND_FAST = np.array([0.0, 1.0])  # rad/s
