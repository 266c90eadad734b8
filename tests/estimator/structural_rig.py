"""Records of caps with structural modes, made in the frequency domain: one spring and damper a cap, no shaft."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.fft import irfft

from estimator.model.background import StructuralMode
from estimator.model.rig import Channel, Model

CAP_MASS_KG, DAMPING_N_S_M = 0.5, 60.0
STIFFNESS_N_M = CAP_MASS_KG * (2 * np.pi * 400.0) ** 2
SUPPORT_MODE = StructuralMode(form="support", mass=3.0, frequency_hz=290.0, damping=0.02)
PART_MODE = StructuralMode(form="attached", mass=0.02, frequency_hz=900.0, damping=0.02)


def structural_record(
    modes: Mapping[str, Sequence[StructuralMode]], seconds: float, rate_hz: float, seed: int
) -> tuple[Model, np.ndarray]:
    """The rig file's rig, without the modes, and (n, places) m/s^2 under a force that falls by 6 dB an octave.

    modes : by place.
    """
    rng, n = np.random.default_rng(seed), int(seconds * rate_hz)
    f = np.arange(n // 2 + 1) / seconds
    s = 2j * np.pi * np.maximum(f, 1.0)
    y = np.empty((n, len(modes)))
    for k, own in enumerate(modes.values()):
        bearing = STIFFNESS_N_M + DAMPING_N_S_M * s
        bearing = bearing / (1.0 + bearing * sum(m.compliance(s) for m in own))
        stiffness = CAP_MASS_KG * s**2 + bearing + sum(m.attached_stiffness(s) for m in own)
        force = (rng.normal(size=f.size) + 1j * rng.normal(size=f.size)) * 2500.0 / np.abs(s)
        y[:, k] = irfft(100.0 * force * s**2 / stiffness, n)
    caps = {place: place.split(".")[0] for place in modes}
    channels = tuple(Channel(place, cap, place[-1]) for place, cap in caps.items())
    return Model(channels, band=(100.0, 0.22 * rate_hz), mass=dict.fromkeys(caps.values(), CAP_MASS_KG)), y


def drawn_modes(count: int, seed: int) -> list[StructuralMode]:
    """Modes between 500 and 3000 Hz, three of four on the cap."""
    rng = np.random.default_rng(seed)
    out = []
    for f_hz, damping in zip(rng.uniform(500.0, 3000.0, count), rng.uniform(0.008, 0.03, count), strict=True):
        attached = bool(rng.random() < 0.75)
        mass = CAP_MASS_KG * (rng.uniform(0.02, 0.08) if attached else rng.uniform(2.0, 10.0))
        form = "attached" if attached else "support"
        out.append(StructuralMode(form=form, mass=mass, frequency_hz=float(f_hz), damping=float(damping)))
    return out
