"""The structure layer of a record: modes in the band, and the spectrum of what excites them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.identification.machine import MachineSurvey
from estimator.identification.record import RecordSurvey
from estimator.model.rig import MOTION_UNITS, Model
from estimator.parallel import map_threads

from .excitation import CellSpectrum, cell_spectrum
from .modes import OscillatorFit, fit_oscillators
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A resonance in the spectrum of a place.

    Parameters
    ----------
    place : str
        Such as "bearing1.x".
    frequency_hz, frequency_sd : float
        Undamped natural frequency and its standard deviation, Hz.
    damping, damping_sd : float
        Damping ratio and its standard deviation.
    energy_share : float
        Share of the kinetic energy of the place in the band.
    bearing : bool
        Whether it can be the mode of the cap on its bearing.
    """

    place: str
    frequency_hz: float
    frequency_sd: float
    damping: float
    damping_sd: float
    energy_share: float
    bearing: bool = False

    def to_json(self) -> dict[str, Any]:
        """An entry of `modes` in the JSON of a diagnosis."""
        names = ("place", "frequency_hz", "frequency_sd", "damping", "damping_sd", "bearing")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExcitationSpectrum:
    """Smooth spectrum of the force per mass that drives the modes of a place; without a mode, of the acceleration.

    Parameters
    ----------
    frequency_hz : (points,) float64
        Log-spaced frequencies in the band, Hz.
    psd : (points,) float64
        One-sided PSD, (m/s^2)^2/Hz.
    """

    frequency_hz: Array
    psd: Array

    def to_json(self) -> dict[str, list[float]]:
        """Frequencies and PSD as lists."""
        return {"frequency_hz": self.frequency_hz.tolist(), "psd": self.psd.tolist()}


@dataclass(frozen=True, slots=True, kw_only=True)
class PolePoint:
    """A pole of the fit with some number of modes, for a stabilisation diagram.

    Parameters
    ----------
    order : int
        Number of modes of the fit.
    frequency_hz, damping : float
        Hz, and damping ratio.
    stable : bool
        Whether the fit with one mode less has it too.
    """

    order: int
    frequency_hz: float
    damping: float
    stable: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceStructure:
    """Modes and excitation in the spectrum of one place.

    Parameters
    ----------
    channel : str
        Name of the channel.
    modes : tuple of Mode
        By frequency.
    excitation : ExcitationSpectrum
        What drives the modes.
    poles : tuple of PolePoint
        For a stabilisation diagram.
    misfit_db : float
        Rms distance of the spectrum from the fit beyond its scatter, dB.
    expected : int
        Modes that the rig itself has at the place: its cap, the cap at the other end of the shaft, and the disc.
    """

    channel: str
    modes: tuple[Mode, ...]
    excitation: ExcitationSpectrum
    poles: tuple[PolePoint, ...]
    misfit_db: float
    expected: int = 1

    @property
    def similar(self) -> tuple[Mode, ...]:
        """Modes with at least a tenth of the energy of the strongest."""
        top = max((m.energy_share for m in self.modes), default=0.0)
        return tuple(m for m in self.modes if m.energy_share >= LIMITS.similar_energy * top)

    @property
    def resonances(self) -> int:
        """Number of similar modes, those nearer than half an octave to the next one counted once."""
        ratios = np.diff(np.log(np.sort([m.frequency_hz for m in self.similar])))
        return int(np.count_nonzero(ratios > np.log(LIMITS.same_mode_ratio))) + (len(self.modes) > 0)

    @property
    def similar_share(self) -> float:
        """Share of the kinetic energy in the band that the similar modes hold."""
        return sum(m.energy_share for m in self.similar)


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureSurvey:
    """Modes of a record, and what excites them.

    Parameters
    ----------
    band : (float, float)
        Analysed band, Hz.
    places : mapping of str to PlaceStructure
        By place. A place whose record is too short, or whose channel is unusable, is absent.
    missing : mapping of str to str
        Why a place is absent, one line.
    """

    band: tuple[float, float]
    places: Mapping[str, PlaceStructure] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes of all places."""
        return tuple(m for own in self.places.values() for m in own.modes)

    def to_json(self) -> dict[str, Any]:
        """The part `structure` of the result of `diagnose`."""
        return {
            "modes": [mode.to_json() for mode in self.modes],
            "excitation": {place: own.excitation.to_json() for place, own in self.places.items()},
            "poles": [{"place": p, **asdict(pole)} for p, own in self.places.items() for pole in own.poles],
        }


def survey_structure(
    model: Model, y: Array, rate_hz: float, record: RecordSurvey, machine: MachineSurvey
) -> StructureSurvey:
    """Modes in the band of each place, with the spectrum of what excites them.

    Parameters
    ----------
    model : Model
        The rig: channels, band, shaft, and masses as far as they are known.
    y : (n, channels) float64
        Samples in SI units, columns in the order of ``model.channels``; NaN where a sample is missing.
    rate_hz : float
        Sampling rate, Hz.
    record : RecordSurvey
        Findings of the record layer; unusable channels are left out.
    machine : MachineSurvey
        Its narrow lines and those of its strike trains are left out of the spectra.

    Returns
    -------
    StructureSurvey
        Nothing is raised.

    References
    ----------
    Brillinger, Time Series, 1981, ch. 5; Bendat and Piersol, Random Data, 4th ed., ch. 6.
    """
    trains = tuple(train.frequency_hz for train in machine.strikes)
    columns: dict[str, int] = {}
    for k, channel in enumerate(model.channels):
        if channel.kind in MOTION_UNITS and channel.place in model.places and channel.name not in record.unusable:
            columns.setdefault(channel.place, k)
    forces = {c.place for c in model.channels if c.kind == "force" and c.name not in record.unusable}

    def at(place: str) -> PlaceStructure | str:
        k = columns[place]
        channel = model.channels[k]
        lines = machine.line_bands.get(channel.name, ())
        cells = cell_spectrum(y[:, k], channel.kind, rate_hz, model.band, lines, trains)
        if isinstance(cells, str):
            return cells
        own = _place(place, channel.name, cells, expected_modes(model, place))
        return _with_bearing_mode(own, place in forces)

    found = dict(zip(columns, map_threads(at, list(columns)), strict=True)) if np.ndim(y) == 2 else {}
    missing = {place: "its channel is unusable: see the record" for place in model.places if place not in columns}
    missing |= {place: own for place, own in found.items() if isinstance(own, str)}
    places = {place: own for place, own in found.items() if not isinstance(own, str)}
    return StructureSurvey(band=model.band, places=places, missing=missing)


def expected_modes(model: Model, place: str) -> int:
    """Modes that the rig has in the direction of a place: its caps on their bearings, discs and shaft."""
    if model.rotor is not None:
        return sum(dof.endswith(place[-1]) for dof in model.rotor.dofs)
    return 1 if model.shaft == "none" else 2 + ("disc" in model.mass)


def bearing_mode(survey: StructureSurvey, place: str, *, of_rig: bool = False) -> Mode | str:
    """The mode that can be that of the cap on its bearing, or why there is none, one line.

    One oscillator under a smooth force must explain the spectrum of the place, as must the oscillators that the rig
    file has: cap, other cap and disc on a shaft. A record with further modes of similar energy does not show which one
    is the bearing's.

    Parameters
    ----------
    survey : StructureSurvey
        What the structure layer says of the record.
    place : str
        Such as "bearing1.x".
    of_rig : bool
        Whether the rig file gives the mass of the cap, or a shaft that does. A joint fit of the rig and of structural
        modes beside it then shows which mode is the bearing's, and the strongest one is taken here.
    """
    own = survey.places.get(place)
    low, high = survey.band
    if own is None:
        return f"{place}: {survey.missing.get(place, 'not measured')}"
    band = f"the band {low:g}-{high:g} Hz of {own.channel}"
    marked = next((m for m in own.modes if m.bearing), None)
    if marked is not None:
        return marked
    if of_rig and own.modes:
        return max(own.modes, key=lambda mode: mode.energy_share)
    advice = "give masses or narrow the band"
    if not own.modes:
        return f"{band} holds no clear resonance: choose a band around that of the bearing"
    if own.resonances > own.expected:
        count = len(own.similar)
        return f"{band} holds {count} modes of similar strength; none can be attributed to the bearing: {advice}"
    if own.similar_share < LIMITS.min_energy_share:
        return f"the resonance in {band} holds only {100 * own.similar_share:.0f} % of its energy: {advice}"
    return (
        f"{band} is not explained by an oscillator under a smooth force, it departs by {own.misfit_db:.1f} dB; "
        f"no mode can be attributed to the bearing: {advice}"
    )


def _place(place: str, channel: str, cells: CellSpectrum, expected: int) -> PlaceStructure:
    """The structure seen at one place."""
    fits = fit_oscillators(cells)
    last = fits[-1]
    modes = tuple(
        Mode(
            place=place,
            frequency_hz=float(last.f_hz[m]),
            frequency_sd=float(last.f_sd_hz[m]),
            damping=float(last.damping[m]),
            damping_sd=float(last.damping_sd[m]),
            energy_share=float(last.energy[m]),
        )
        for m in range(last.f_hz.size)
    )
    f = np.geomspace(cells.f_hz[0], cells.f_hz[-1], LIMITS.excitation_points)
    psd = np.exp(np.interp(np.log(f), np.log(cells.f_hz), np.log(np.maximum(last.force, 1e-300))))
    return PlaceStructure(
        channel=channel,
        modes=modes,
        excitation=ExcitationSpectrum(frequency_hz=f, psd=psd),
        poles=_poles(fits),
        misfit_db=last.misfit_db,
        expected=expected,
    )


def _with_bearing_mode(own: PlaceStructure, driven: bool) -> PlaceStructure:
    """The place with its strongest mode as that of the bearing, where the rig explains all modes of similar strength.

    driven : whether a force is measured there. The shape of the spectrum is then that of the force, and not asked.
    """
    clear = own.resonances <= own.expected and own.misfit_db <= LIMITS.max_misfit_db
    if not own.modes or not (driven or (clear and own.similar_share >= LIMITS.min_energy_share)):
        return own
    top = max(own.modes, key=lambda mode: mode.energy_share)
    return replace(own, modes=tuple(replace(mode, bearing=mode is top) for mode in own.modes))


def _poles(fits: Sequence[OscillatorFit]) -> tuple[PolePoint, ...]:
    """Poles by number of modes, and whether the fit with one mode less has them."""
    out = []
    for before, fit in zip(fits, fits[1:], strict=False):
        for f, zeta in zip(fit.f_hz, fit.damping, strict=True):
            near = np.abs(before.f_hz / f - 1.0) < LIMITS.stable_frequency_rel
            stable = bool(np.any(near & (np.abs(before.damping / zeta - 1.0) < LIMITS.stable_damping_rel)))
            out.append(PolePoint(order=fit.f_hz.size, frequency_hz=float(f), damping=float(zeta), stable=stable))
    return tuple(out)
