"""Spectral matrices of all caps, explained by a rig and by changes of the rig, each with its background.

The response of one cap to the force at another shows masses, shaft and channels. The background acts at one cap: it
does not take the place of a wrong mass without more modes or a lower likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtrc

from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.background import Background
from estimator.model.rig import Model
from estimator.parallel import map_single_core

from .background_search import (
    force_dispersion,
    score_nats,
    search_background,
    search_from_starts,
    without_idle_modes,
)
from .cross_spectra import CrossSpectra, SearchTooLongError, Work
from .joint_spectrum import JointSpectrum, JointValues, ModePlace, Solution
from .spectral_problem import (
    cap_masses,
    caps_by_direction,
    measured_spectra,
    smooth_start,
    spectral_problem,
    with_known_background,
)
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrangement:
    """Which channel is at which place, and with which sign.

    Parameters
    ----------
    channel_of : tuple of int
        By place, the place whose channel is there in truth.
    sign : tuple of float
        By place, +1, or -1 where its channel is inverted.
    """

    channel_of: tuple[int, ...]
    sign: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigFit:
    """The spectra explained by a rig.

    Parameters
    ----------
    nats : float
        Log-likelihood less what the structural modes cost.
    misfit : float
        Largest rms of ln(measured / model) of a cap, beyond scatter.
    coherence_p_value, coherence_nats : float
        Of what the caps still predict of each other, and its log-likelihood ratio beyond chance.
    channels : Arrangement
        Which channel is where.
    solutions : tuple of (JointSpectrum, JointPoint)
        By direction.
    """

    nats: float
    misfit: float
    coherence_p_value: float
    coherence_nats: float
    channels: Arrangement
    solutions: tuple[Solution, ...]

    @property
    def dispersion(self) -> float:
        """Scatter of the whitened spectra over that of a complete model, 1 or more: nats count less by this factor."""
        each = [problem.dispersion(point) for problem, point in self.solutions]
        return max(1.0, *each)

    @property
    def explains(self) -> bool:
        """Whether the spectra show no misfit that a further search could explain."""
        return self.misfit < LIMITS.explained_misfit


class RigSpectra:
    """The spectral matrices of the caps, and their fit by a rig.

    Parameters
    ----------
    model : Model
        The rig as it is given, without disturbances.
    point : WorkingPoint
        Its fit.
    max_work : float
        Derivatives of spectra that all rigs on trial together may take.

    Raises
    ------
    SearchTooLongError
        By every method, once all rigs together took more work than they may.
    """

    def __init__(self, model: Model, point: WorkingPoint, max_work: float = LIMITS.max_work_derivatives) -> None:
        self._point, self._work = point, Work(limit=max_work)
        self.places = point.data.places
        self._spectra = measured_spectra(model, point, tuple(range(len(self.places))))
        self._directions = caps_by_direction(self.places)
        self.dispersion = force_dispersion(point)
        self._fall_power = 0  # in the spectra of the forces without modes, once it is known

    def begin_again(self) -> None:
        """Allow as much work once more."""
        self._work.done = 0.0

    @property
    def cost_nats(self) -> float:
        """Nats that a structural mode has to gain."""
        return LIMITS.min_gain_nats * self.dispersion

    @property
    def as_given(self) -> Arrangement:
        """Each channel at its own place."""
        return Arrangement(channel_of=tuple(range(len(self.places))), sign=(1.0,) * len(self.places))

    def as_fitted(self, model: Model, background: Background | None) -> RigFit:
        """The fit of the rig as given with a background that was found before, or without modes. Raises LinAlgError."""
        if background is None:
            return self.tried(model, self.as_given, None)
        out = []
        for places in self._directions:
            problem = self._problem(model, places, self.as_given)
            known = with_known_background(problem, self._point, background)
            out.append(known or self._plain(model, problem, self.as_given))
        return self.without_idle_modes(self._fit(out, self.as_given))

    def searched(self, model: Model, channels: Arrangement, start: RigFit | None = None) -> RigFit:
        """The fit of a rig whose background is sought, from the fit of another rig or from none.

        Raises numpy.linalg.LinAlgError where the rig explains nothing.
        """
        started, limit = self._started(model, channels, start), self._work.limit - self._work.done
        asked = [partial(self._searched, one, start, limit) for one in started]
        found, done = zip(*map_single_core(asked), strict=True)
        self._work.add_all(done)
        return self._fit([(replace(problem, work=self._work), point) for problem, point in found], channels)

    def _searched(self, started: Solution, start: RigFit | None, limit: float) -> tuple[Solution, float]:
        """The search of one direction, and its work. limit : of the work."""
        problem, point = replace(started[0], work=Work(limit=limit)), started[1]
        try:
            if start is None:
                found = search_from_starts([(problem, point)], self.cost_nats)
            else:
                found = search_background(problem, point, self.cost_nats, thorough=True)
        except SearchTooLongError:
            found = started
        return found, problem.work.done

    def without_idle_modes(self, fit: RigFit) -> RigFit:
        """The fit without the modes that gain less than they cost."""
        bare = [(problem, without_idle_modes(problem, point, self.cost_nats)) for problem, point in fit.solutions]
        return self._fit(bare, fit.channels)

    def tried(self, model: Model, channels: Arrangement, start: RigFit | None) -> RigFit:
        """The fit of a rig with the modes of the fit of another rig, or without. Raises numpy.linalg.LinAlgError."""
        return self._fit(self._started(model, channels, start), channels)

    def _fit(self, solutions: Sequence[Solution], channels: Arrangement) -> RigFit:
        """The fit with these solutions."""
        each = [problem.coherence(point) for problem, point in solutions]
        coherent, paid = sum(nats for nats, _ in each), sum(paid for _, paid in each)
        return RigFit(
            nats=sum(score_nats(one, self.cost_nats) for one in solutions),
            misfit=max(float(problem.misfit(point).max()) for problem, point in solutions),
            coherence_p_value=float(chdtrc(paid, 2.0 * coherent)) if paid else 1.0,
            coherence_nats=max(coherent - 0.5 * paid, 0.0),
            channels=channels,
            solutions=tuple(solutions),
        )

    def _started(self, model: Model, channels: Arrangement, start: RigFit | None) -> list[Solution]:
        """Problem and start by direction."""
        out = []
        for k, places in enumerate(self._directions):
            problem = self._problem(model, places, channels)
            if start is None:
                out.append(self._plain(model, problem, channels))
            else:
                form, _ = start.solutions[k]
                problem = replace(problem, octaves=form.octaves, fall_power=form.fall_power)
                values = self._values_of(problem, channels, start)
                out.append((problem, problem.maximised(values, tolerance_nats=LIMITS.tried_tolerance_nats)))
        return out

    def _problem(self, model: Model, places: tuple[int, ...], channels: Arrangement) -> JointSpectrum:
        """The spectral problem of the caps of one direction."""
        arranged = self._arranged(places, channels)
        return replace(spectral_problem(model, self._point, arranged, channels.channel_of), work=self._work)

    def _arranged(self, places: tuple[int, ...], channels: Arrangement) -> CrossSpectra:
        """The spectra of some places, by the channels that the arrangement puts there."""
        source = [channels.channel_of[i] for i in places]
        sign = np.array([channels.sign[i] for i in places])
        psd = self._spectra.psd[:, source][:, :, source] * sign[:, None] * sign
        return replace(self._spectra, places=places, psd=psd, noise=self._spectra.noise[:, source])

    def _plain(self, model: Model, problem: JointSpectrum, channels: Arrangement) -> Solution:
        """The problem and its point without modes; each channel keeps the frequency of its resonance."""
        point, source = self._point, list(channels.channel_of)
        ratio = cap_masses(model, point) / point.data.mass[source]
        moved = replace(point, kL=point.kL[source] * ratio, S=point.S[source] * ratio**2, nu=point.nu[source])
        best = smooth_start(problem, moved, (self._fall_power,) if self._fall_power else LIMITS.fall_powers)
        self._fall_power = best[0].fall_power  # one recorder has all channels
        return best

    def _values_of(self, problem: JointSpectrum, channels: Arrangement, start: RigFit) -> JointValues:
        """Values of another fit, moved with the channels; each keeps frequencies and mass ratios."""
        there = {i: (k, cap) for k, direction in enumerate(self._directions) for cap, i in enumerate(direction)}
        force, rest, modes, q = [], [], [], []
        for cap, i in enumerate(problem.spectra.places):
            k, cap0 = there[start.channels.channel_of.index(channels.channel_of[i])]
            old, point = start.solutions[k]
            heavier = float(np.log(problem.mass[cap] / old.mass[cap0]))
            v = point.values
            ln_psd = old.basis @ v.force[cap0] + 2.0 * heavier
            force.append(np.linalg.lstsq(problem.basis, ln_psd, rcond=None)[0])
            stiffness = _at_same_resonance(problem, cap, old, cap0, v, heavier)
            rest.append((v.noise[cap0], stiffness, v.damping[cap0] + heavier))
            own = [j for j, mode in enumerate(v.modes) if mode.cap == cap0]
            modes += [ModePlace(cap, v.modes[j].form) for j in own]
            q += [v.q[j] for j in own]
        noise, stiffness, damping = np.array(rest).T
        return JointValues(
            force=np.array(force), noise=noise, stiffness=stiffness, damping=damping, modes=tuple(modes),
            q=np.array(q).reshape(-1, 3),
        )  # fmt: skip


def _at_same_resonance(
    problem: JointSpectrum, cap: int, old: JointSpectrum, cap0: int, values: JointValues, heavier: float
) -> float:
    """ln of the bearing stiffness at which a heavier cap keeps its stiffness per mass, shaft included.

    cap, cap0 : its number in the new and in the old problem. values : of the old one. heavier : ln of the mass ratio.
    """
    kL = float(np.exp(values.stiffness[cap0]))
    f0 = np.sqrt(kL / old.mass[cap0]) / (2.0 * np.pi)
    at = [int(np.argmin(np.abs(one.spectra.f_hz - f0))) for one in (old, problem)]
    shaft, new = float(old.shaft[at[0], cap0, cap0].real), float(problem.shaft[at[1], cap, cap].real)
    ratio = float(np.exp(heavier))
    return float(np.log(max(ratio * (kL + shaft) - new, LIMITS.min_kept_stiffness_rel * ratio * kL)))
