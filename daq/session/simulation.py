"""A rig file as a simulated machine with its device, for `virtual:` and `rotorscope simulate`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.clock import Clock, SystemClock
from daq.base.contract.errors import ConfigError
from daq.rig.rig import Rig
from drivers.can import CanDecoder, CanFrames
from drivers.contract import Event, Link, LinkStats, Reading
from drivers.protocol import FAULT_KINDS
from drivers.simulated import DeviceConfig, SimulatedDevice
from estimator.effects import NAMED
from estimator.model import LINEAR_UNITS, Effect, EffectUse, Model, Setting
from estimator.results import Parameter

CAP_KG, DISC_KG = 0.2, 0.5
RESONANCE_HZ = 1125.0  # of a cap without a stiffness, if the band allows it
DAMPING_RATIO = 0.02
ACCELERATION_RMS = 10.0  # m/s^2, rms, that an unknown excitation is chosen for
EFFECT_SHARE = 0.04  # of the bearing force, rms, of an effect without values
RATE_OVER_BAND = 3.2  # sampling rate over band.high where no rate is given
CREST_FACTOR = 49.05  # full scale over the expected rms: 50 g for 10 m/s^2
NOISE_SHARE = 2e-3  # of the expected rms, of a sensor without stated noise
BATCH_FRAMES = 256  # handed over at a time


def complete(model: Model, rate_hz: float) -> tuple[Model, dict[str, Parameter]]:
    """The model with a value for every parameter, and the parameters that were assumed, by full name.

    Masses 0.2 kg (disc 0.5 kg); stiffness for 1125 Hz, or for the middle of the band if that is outside; 2 % damping;
    white forces for 10 m/s^2 rms of acceleration; effects of 4 % of the bearing force.
    """
    assumed: dict[str, Parameter] = {}
    mass = dict(model.mass)
    for place in dict.fromkeys([*model.places, *model.linear]):
        if model.cap_mass(place) is None:
            mass[place] = CAP_KG
            assumed[f"{place}.m"] = Parameter(CAP_KG, 0.0, "kg")
    if model.shaft in ("chain", "beam") and "disc" not in mass:
        mass["disc"] = DISC_KG
        assumed["disc.m"] = Parameter(DISC_KG, 0.0, "kg")
    low, high = model.band
    f0 = RESONANCE_HZ if 1.5 * low < RESONANCE_HZ < high / 1.5 else math.sqrt(max(low, high / 100) * high)
    model = replace(model, mass=mass)
    linear = {}
    for place, settings in model.linear.items():
        m = model.cap_mass(place) or CAP_KG
        kL = _value(settings, "kL", m * (2 * math.pi * f0) ** 2)
        c = _value(settings, "c", 2 * DAMPING_RATIO * math.sqrt(abs(kL) * m))
        S = _value(settings, "S", 4 * c * m**2 / abs(kL) * ACCELERATION_RMS**2)  # S = 4 c k sigma_x^2
        linear[place] = {"kL": replace(settings["kL"], value=kL), "c": replace(settings["c"], value=c),
                         "S": replace(settings["S"], value=S)}  # fmt: skip
        for key in ("kL", "c", "S"):
            if settings[key].value is None:
                assumed[f"{place}.{key}"] = Parameter(linear[place][key].value, 0.0, LINEAR_UNITS[key])
    model = replace(model, linear=linear)
    uses = tuple(_complete_use(model, use, rate_hz, assumed) for use in model.effects)
    return replace(model, effects=uses), assumed


def _value(settings: Mapping[str, Setting], key: str, otherwise: float) -> float:
    value = settings[key].value
    return otherwise if value is None else value


def _complete_use(model: Model, use: EffectUse, rate_hz: float, assumed: dict[str, Parameter]) -> EffectUse:
    if all(s.value is not None for table in use.parameters.values() for s in table.values()):
        return use
    if use.custom is not None:
        missing = next(k for table in use.parameters.values() for k, s in table.items() if s.value is None)
        raise ConfigError(f"model.custom: {use.name} has no value for {missing}; give one to simulate it")
    from estimator.effects.engine import size, strengths

    effect: Effect = NAMED[use.name]
    units = {p.name: p.unit for p in effect.parameters}
    linear = replace(model, effects=())
    out = {}
    for place, table in use.parameters.items():
        natural = strengths(effect, size(linear, place, rate_hz), EFFECT_SHARE, linear)
        out[place] = {k: s if s.value is not None else replace(s, value=natural[k]) for k, s in table.items()}
        for k, s in table.items():
            if s.value is None:
                assumed[f"{place}.{use.name}.{k}"] = Parameter(natural[k], 0.0, units[k])
    return replace(use, parameters=out)


class Analogue:
    """`source(n)` of a simulated device: motion of the rig and noise of the sensors, SI.

    columns : channel of the model for each column. An axial channel (z) has noise only: the model has no such motion.
    """

    def __init__(
        self, model: Model, columns: list[int], noise: NDArray[np.float64], rate_hz: float, *, seed: int
    ) -> None:
        from estimator.simulation import Simulator

        moving = [i for i, c in enumerate(model.channels) if c.direction != "z"]
        self._simulator = Simulator(replace(model, channels=tuple(model.channels[i] for i in moving)), rate_hz, seed)
        self._columns = [moving.index(c) if c in moving else -1 for c in columns]
        self._noise = noise
        self._rng = np.random.default_rng(np.random.SeedSequence((seed, 1)))

    def __call__(self, n: int) -> NDArray[np.float64]:
        motion = self._simulator.next(n)
        y = self._noise * self._rng.standard_normal((n, len(self._columns)))
        for k, column in enumerate(self._columns):
            if column >= 0:
                y[:, k] += motion[:, column]
        return y


@dataclass(frozen=True, slots=True)
class Machine:
    """A simulated rig as a device. assumed : values that the rig file left open."""

    device: SimulatedDevice
    model: Model
    assumed: Mapping[str, Parameter]


def machine(
    rig: Rig, *, truth: Rig | None = None, seed: int = 1, seconds: float | None = None, layout: str | None = None,
    config: Mapping[str, object] | None = None,
) -> Machine:  # fmt: skip
    """The machine that a rig file describes, or the one of `truth` seen through the channels of `rig`.

    layout : of the frames, default what carries the channels over CAN FD. config : further fields of DeviceConfig.
    Raises ConfigError if the truth lacks a channel, or no frame carries so many.
    """
    source = truth or rig
    settings = source.acquisition or rig.acquisition
    rate_hz = settings.rate_hz if settings else float(math.ceil(RATE_OVER_BAND * rig.model.band[1] / 100) * 100)
    model, assumed = complete(source.model, rate_hz)
    columns = [_column(rig, source, k) for k in range(len(rig.model.channels))]
    expected = [_expected_rms(model, model.channels[c].kind, rate_hz, model.channels[c].place) for c in columns]
    full_scale = np.array([CREST_FACTOR * rms for rms in expected])
    noise = np.array([NOISE_SHARE * rms for rms in expected])
    for k, channel in enumerate(rig.model.channels):
        motion = channel.kind not in ("force", "tacho")
        if settings is not None and motion:
            noise[k] = settings.noise * rig.factors[k]
            if settings.full_scale is not None:
                full_scale[k] = settings.full_scale * rig.factors[k]
        if channel.kind == "tacho":
            full_scale[k], noise[k] = 2.0, 0.0
    names = tuple(c.name for c in rig.model.channels)
    analogue = Analogue(model, columns, noise, rate_hz, seed=seed)
    fields: dict[str, object] = {"seconds": seconds, "seed": seed} | dict(config or {})
    try:
        device = DeviceConfig(
            rate_hz=rate_hz,
            channels=names,
            units=rig.si_units,
            full_scale=tuple(full_scale.tolist()),
            layout=layout or "fd16",
            **fields,  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise ConfigError(f"{rig.path or 'rig file'}: a simulated device: {error}") from error
    return Machine(SimulatedDevice(analogue, device), model, assumed)


def fault_rates(faults: Sequence[str]) -> dict[str, float]:
    """From KIND:RATE words. Raises ConfigError."""
    rates = {}
    for text in faults:
        kind, _, share = text.partition(":")
        try:
            rates[kind] = float(share)
        except ValueError:
            rates[kind] = -1.0
        if kind not in FAULT_KINDS or not 0 <= rates[kind] <= 1:
            known = f"KIND is one of {', '.join(FAULT_KINDS)}, RATE a share of the frames from 0 to 1"
            raise ConfigError(f"--fault {text}: {known}, as in drop:0.001")
    return rates


def _column(rig: Rig, source: Rig, k: int) -> int:
    """Channel of the simulated model for channel k of the rig: with the same measurement, else the same name."""
    wanted = rig.model.channels[k]
    for i, c in enumerate(source.model.channels):
        if (c.place, c.kind) == (wanted.place, wanted.kind):
            return i
    raise ConfigError(
        f"{source.path or 'truth'}: does not measure {wanted.kind} of {wanted.place}, the rig's channel {wanted.name}; "
        "give it the rig's channels"
    )


def _expected_rms(model: Model, kind: str, rate_hz: float, place: str) -> float:
    settings = model.linear.get(place) or next(iter(model.linear.values()))
    kL, c, S = (float(settings[k].value or 0.0) for k in ("kL", "c", "S"))
    m = model.cap_mass(place) or CAP_KG
    if kind == "force":
        return math.sqrt(S * rate_hz / 2)
    x = math.sqrt(S / (4 * c * abs(kL))) if c and kL else ACCELERATION_RMS * m / max(abs(kL), 1.0)
    w = math.sqrt(abs(kL) / m)
    return {"displacement": x, "velocity": w * x}.get(kind, w * w * x)


class FrameSource:
    """The device's frames handed straight to the CAN decoder: the path of a bus without its queue, at full speed."""

    def __init__(self, device: SimulatedDevice) -> None:
        self.exhausted = False
        self._device = device

    def open(self) -> None: ...
    def close(self) -> None: ...

    def events(self) -> list[Event]:
        return []

    def receive(self, timeout_s: float) -> CanFrames | None:
        if self._device.finished:
            self.exhausted = True
            return None
        frames = [f for f in self._device.next(BATCH_FRAMES) if not f.damaged]
        return CanFrames.build([(f.identifier, f.data, round(1e9 * f.due_s)) for f in frames])


class OnDeviceTime:
    """A CAN decoder to which the host's time is that of the frames: nothing else says when a made-up sample was."""

    def __init__(self, decoder: CanDecoder, start_ns: int) -> None:
        self.stats, self.notices = decoder.stats, decoder.notices
        self._decoder, self._start_ns = decoder, start_ns

    def feed(self, frames: CanFrames, t_host_ns: int) -> list[Reading]:
        return self._decoder.feed(frames, self._start_ns + int(frames.t_ns[-1]) if len(frames) else t_host_ns)

    def nothing(self) -> str:
        """Why no sample has come."""
        return self._decoder.nothing()

    def finish(self, t_host_ns: int) -> list[Reading]:
        return self._decoder.finish(t_host_ns)

    def cause(self, reason: str) -> None:
        self._decoder.cause(reason)


def at_full_speed(device: SimulatedDevice, clock: Clock | None = None) -> Link:
    """A driver for the device without a bus and without waiting; its samples are dated as if it had run from now on."""
    decoder = CanDecoder(LinkStats(), device.config.base_id)
    start_ns = (clock or SystemClock()).now_ns()
    return Link("simulated", "simulated device", FrameSource(device), OnDeviceTime(decoder, start_ns))
