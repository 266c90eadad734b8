"""Figures 4-19 of `rotorscope reproduce`: records, spectra, densities, eq. (36) and the bearing's theory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.model import Theory, taylor

from .reproduce_cases import PAPER_METHODS, RATE_HZ, TRUE_KNL, TRUE_STIFFNESS, Case, Row

Array = NDArray[np.float64]
BEARING_COLOURS = ("#1f5fa8", "#c2571a")
BEARING_TITLES = ("bearing 1", "bearing 2")


def _panels(columns: int, width: float = 9.0, height: float = 3.4) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns)
    flat = list(np.atleast_1d(axes))
    for ax in flat:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(True, color="#e4e4e4", linewidth=0.6)
        ax.set_axisbelow(True)
    return figure, flat


def _save(figure: Any, out: Path, number: int) -> None:
    figure.savefig(out / f"figure_{number:02d}.png", dpi=110)


def signals(out: Path, number: int, data: Array, rate_hz: float, quantity: str, scale: float, unit: str) -> None:
    """30 ms of both caps."""
    figure, axes = _panels(2)
    n = int(0.03 * rate_hz)
    for i, ax in enumerate(axes):
        ax.plot(np.arange(n) / rate_hz * 1e3, data[:n, i] * scale, color=BEARING_COLOURS[i], linewidth=0.9)
        ax.set(title=BEARING_TITLES[i], xlabel="time, ms", ylabel=f"{quantity}, {unit}")
    _save(figure, out, number)


def spectra(out: Path, number: int, x: Array, rate_hz: float) -> None:
    """Power spectral density of displacement."""
    from scipy.signal import welch

    figure, axes = _panels(2)
    for i, ax in enumerate(axes):
        f, p = welch(x[:, i], rate_hz, nperseg=4096)
        keep = (f > 10.0) & (f < 0.45 * rate_hz)
        ax.loglog(f[keep], p[keep] * 1e12, color=BEARING_COLOURS[i], linewidth=0.9)
        ax.set(title=BEARING_TITLES[i], xlabel="frequency, Hz", ylabel="displacement PSD, µm²/Hz")
    _save(figure, out, number)


def density(out: Path, number: int, data: Array, symbol: str) -> None:
    """Marginal density of each cap beside the Gaussian of the same variance; logarithmic, in standard deviations."""
    figure, axes = _panels(2)
    edges = np.linspace(-5.0, 5.0, 81)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for i, ax in enumerate(axes):
        z = data[:, i] / np.std(data[:, i])
        counts, _ = np.histogram(z, edges)
        seen = counts > 0
        p = counts / (len(z) * (edges[1] - edges[0]))
        ax.semilogy(middle[seen], p[seen], "o", color=BEARING_COLOURS[i], markersize=2.6, label="histogram")
        gauss = np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi)
        ax.semilogy(middle, gauss, color="#444444", linewidth=1, label="Gaussian")
        ax.set(title=BEARING_TITLES[i], xlabel=f"{symbol} / rms", ylabel="density", ylim=(1e-6, 1.0))
        ax.legend(frameon=False, fontsize=8, loc="lower center")
    _save(figure, out, number)


def joint(out: Path, number: int, x: Array) -> None:
    """Joint density of the two caps: as counted, and its logarithm."""
    figure, axes = _panels(2, height=3.9)
    z = x / np.std(x, axis=0)
    counts, ex, ey = np.histogram2d(z[:, 0], z[:, 1], bins=61, range=[[-4.0, 4.0]] * 2)
    p = counts.T / (counts.sum() * (ex[1] - ex[0]) * (ey[1] - ey[0]))
    for ax, image, label in ((axes[0], p, "density"), (axes[1], np.log10(np.where(p > 0, p, np.nan)), "log10 density")):
        drawn = ax.pcolormesh(ex, ey, image, cmap="viridis", rasterized=True)
        ax.grid(False)
        ax.set(xlabel="x1 / rms", ylabel="x2 / rms", aspect="equal")
        figure.colorbar(drawn, ax=ax, label=label, shrink=0.85)
    _save(figure, out, number)


def restoring(out: Path, number: int, case: Case, rows: Sequence[Row], direction: str) -> None:
    """Stiffness k(x) = kL + 3 kNL x^2 in and out, with the 95 % band of eq. (36), masses given."""
    figure, axes = _panels(2)
    x = case.x[direction]
    for i, ax in enumerate(axes):
        place = f"bearing{i + 1}.{direction}"
        grid = np.linspace(-3.0, 3.0, 121) * np.std(x[:, i])
        ax.plot(
            grid * 1e6,
            (TRUE_STIFFNESS[place] + 3 * TRUE_KNL * grid**2) * 1e-6,
            color="#444444",
            linewidth=1.4,
            label="in",
        )
        found = {
            r.parameter.rsplit(".", 1)[1]: r
            for r in rows
            if (r.case, r.masses, r.method) == (case.name, "given", PAPER_METHODS[1]) and r.parameter.startswith(place)
        }
        kL, kNL = found["kL"], found["kNL"]
        if kL.value is not None and kNL.value is not None and kL.sd is not None and kNL.sd is not None:
            k = (kL.value + 3 * kNL.value * grid**2) * 1e-6
            # kL and kNL err in opposite ways; drawn as if independent, the band is on the safe side
            sd = np.hypot(kL.sd, 3 * kNL.sd * grid**2) * 1e-6
            ax.fill_between(grid * 1e6, k - 1.96 * sd, k + 1.96 * sd, color=BEARING_COLOURS[i], alpha=0.2, linewidth=0)
            ax.plot(grid * 1e6, k, color=BEARING_COLOURS[i], linewidth=1.4, linestyle="--", label="out, eq. (36)")
        ax.set(title=f"bearing {i + 1}", xlabel="displacement, µm", ylabel="dF/dx, N/µm", ylim=(0.0, None))
        ax.legend(frameon=False, fontsize=8, loc="upper center")
    _save(figure, out, number)


def bearing_theory(out: Path, number: int, hertz: Theory, secant: bool) -> None:
    """Stiffness against displacement for each preload; right: linear stiffness against preload and the fitted ones."""
    figure, axes = _panels(2, height=3.9)
    curves = [c for c in hertz.curves if c.preload > 0]
    import matplotlib

    for shade, curve in zip(np.linspace(0.4, 1.0, len(curves)), curves, strict=True):
        colour = matplotlib.colormaps["Blues"](shade)
        k = curve.secant if secant else curve.tangent
        axes[0].plot(curve.x * 1e6, k * 1e-6, color=colour, linewidth=1.3, label=f"{curve.preload * 1e6:.1f}")
    axes[0].set(xlabel="displacement, µm", ylabel=f"{'F/x' if secant else 'dF/dx'}, N/µm", ylim=(0.0, None))
    axes[0].legend(title="preload, µm", frameon=False, fontsize=8, ncols=3, loc="lower center")
    quadratics = [c.secant_quadratic if secant else c.tangent_quadratic for c in curves]
    g = np.array([c.preload for c in curves]) * 1e6
    every = np.linspace(0.0, g.max(), 60)
    line = [taylor(hertz.bearing, u * 1e-6)[0] * 1e-6 for u in every]
    axes[1].plot(every, line, color="#1f5fa8", linewidth=1.2, label="at x = 0")
    axes[1].plot(g, [c.kL * 1e-6 for c in curves], "o", color="#1f5fa8", markersize=4)
    k0 = [q.k0 * 1e-6 for q in quadratics]
    axes[1].plot(g, k0, "s--", color="#7a7a7a", markersize=3.5, label="quadratic, |x| < g")
    fitted = [(r.preload_implied, r.kL.value) for r in hertz.fitted]
    points = np.array([(at * 1e6, k * 1e-6) for at, k in fitted if at is not None and k is not None]).reshape(-1, 2)
    label = "eq. (36), at the preload it implies"
    axes[1].plot(points[:, 0], points[:, 1], "^", color="#c2571a", markersize=5, label=label)
    axes[1].set(xlabel="preload, µm", ylabel="linear stiffness, N/µm", ylim=(0.0, None), xlim=(0.0, None))
    axes[1].legend(frameon=False, fontsize=8, loc="lower right")
    _save(figure, out, number)


def draw_all(out: Path, cases: Sequence[Case], rows: Sequence[Row], hertz: Theory) -> dict[int, str]:
    """Draw figures 4-19 into `out`; returns number -> caption."""
    rig = cases[0]
    captions: dict[int, str] = {}
    for base, direction, word in ((4, "x", "vertical (x)"), (10, "y", "horizontal (y)")):
        x, v = rig.x[direction], rig.v[direction]
        signals(out, base, x, RATE_HZ, "displacement", 1e6, "µm")
        signals(out, base + 1, v, RATE_HZ, "velocity", 1e3, "mm/s")
        spectra(out, base + 2, x, RATE_HZ)
        density(out, base + 3, x, "displacement")
        density(out, base + 4, v, "velocity")
        joint(out, base + 5, x)
        for offset, text in enumerate(
            (
                "displacement of the two caps",
                "velocity of the two caps",
                "spectra of the displacement",
                "density of the displacement: not Gaussian, the cubic cuts its tails",
                "density of the velocity: Gaussian whatever the stiffness",
                "joint density of the two displacements",
            )
        ):
            captions[base + offset] = f"{word}: {text}"
    restoring(out, 16, rig, rows, "x")
    restoring(out, 17, rig, rows, "y")
    captions[16] = "vertical (x): stiffness in and out of eq. (36), masses given, with its 95 % band"
    captions[17] = "horizontal (y): stiffness in and out of eq. (36), masses given, with its 95 % band"
    bearing_theory(out, 18, hertz, secant=False)
    bearing_theory(out, 19, hertz, secant=True)
    captions[18] = "Hertz theory of the bearing: tangent stiffness dF/dx by preload; linear stiffness against preload"
    captions[19] = "Hertz theory of the bearing: secant stiffness F/x by preload; linear stiffness against preload"
    return dict(sorted(captions.items()))
