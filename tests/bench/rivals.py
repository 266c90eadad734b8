"""Other people's methods behind one face: a measured place in, kL, c, kNL and S out.

Every rival gets the displacement, velocity and acceleration that our own band limit makes, the mass, and nothing of the
truth. One that sees a single place takes the shaft's spring and damper for the bearing's: they are taken off for it.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before the first import of jax

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

Floats = NDArray[np.float64]
ANY_SHAPE = {"xi_max": 0.2, "mpc_lim": None, "mpd_lim": None, "CoV_max": None}  # one channel: no shape to judge by


@dataclass(frozen=True, slots=True)
class Place:
    """Motion of one place in SI. raw : the channel as measured; path : displacement in the widest band there is.

    shaft : (N/m, N s/m), known and beside the bearing.
    """

    x: Floats
    v: Floats
    a: Floats
    raw: Floats
    path: Floats
    rate_hz: float
    band: tuple[float, float]
    mass: float
    shaft: tuple[float, float] = (0.0, 0.0)

    def found(self, k: float, c: float, kNL: float = np.nan, S: float = np.nan) -> dict[str, float]:
        return {"kL": k - self.shaft[0], "c": c - self.shaft[1], "kNL": kNL, "S": S}


def regression(p: Place) -> dict[str, float]:
    """Least squares of -m a on x, v, x^3."""
    columns = np.stack([p.x / p.x.std(), p.v / p.v.std(), (p.x / p.x.std()) ** 3])
    k, c, k3 = np.linalg.solve(columns @ columns.T, columns @ (-p.mass * p.a))
    left = p.mass * p.a + k * columns[0] + c * columns[1] + k3 * columns[2]
    S = float(left.var() / (p.band[1] - p.band[0]))
    return p.found(k / p.x.std(), c / p.v.std(), k3 / p.x.std() ** 3, S)


def kramersmoyal(p: Place) -> dict[str, float]:
    """Drift and diffusion of (x, v) by kernels (package kramersmoyal), the drift fitted with x, v, x^3 by density."""
    from kramersmoyal import km

    z = np.stack([p.x / p.x.std(), p.v / p.v.std()], axis=1)
    powers = np.array([[0, 0], [0, 1], [0, 2]])
    moments, (ex, ev) = km(z, bins=[60, 60], powers=powers)
    x, v = np.meshgrid(ex, ev, indexing="ij")
    density = moments[0]
    keep = density > 0.01 * density.max()
    w = np.sqrt(density[keep])
    columns = np.stack([x[keep], v[keep], x[keep] ** 3])
    drift = moments[1][keep] * p.rate_hz * p.v.std()  # m/s^2
    k, c, k3 = np.linalg.lstsq((columns * w).T, -p.mass * drift * w, rcond=None)[0]
    diffusion = float(np.average(moments[2][keep], weights=density[keep])) * p.rate_hz * p.v.var()
    return p.found(k / p.x.std(), c / p.v.std(), k3 / p.x.std() ** 3, 4 * p.mass**2 * diffusion)


def pysindy(p: Place) -> dict[str, float]:
    """Sparse regression (package pysindy, STLSQ) of (v, a) on monomials to the third degree of (x, v), scaled."""
    import pysindy as ps

    sx, sv = p.x.std(), p.v.std()
    w = sv / sx
    z, dz = np.stack([p.x / sx, p.v / sv], axis=1), np.stack([p.v / sx, p.a / sv], axis=1) / w
    model = ps.SINDy(
        optimizer=ps.STLSQ(threshold=0.002, alpha=0.0), feature_library=ps.PolynomialLibrary(3, include_bias=False)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(z, t=w / p.rate_hz, x_dot=dz, feature_names=["x", "v"])
        left = dz[:, 1] - np.asarray(model.predict(z))[:, 1]
    names = model.get_feature_names()
    row = dict(zip(names, np.asarray(model.coefficients())[1], strict=True))
    k, c, k3 = (-p.mass * w * sv * row[n] for n in ("x", "v", "x^3"))
    S = float((p.mass * w * sv) ** 2 * left.var() / (p.band[1] - p.band[0]))
    return p.found(k / sx, c / sv, k3 / sx**3, S)


def sfi(p: Place) -> dict[str, float]:
    """Underdamped parametric inference from positions with PASTIS selection (package StochasticForceInference 2).

    Monomials to the third degree of (x, v), scaled; its own measurement noise, selection and defaults.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    from SFI import TrajectoryCollection, UnderdampedLangevinInference
    from SFI.bases import monomials_up_to

    s, w = p.path.std(), p.v.std() / p.x.std()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = TrajectoryCollection.from_arrays(X=(p.path / s)[:, None], dt=w / p.rate_hz)
        inference = UnderdampedLangevinInference(data)
        inference.infer_force(monomials_up_to(order=3, dim=1, include_v=True, rank="vector"))
        inference.sparsify_force()
    row = dict(zip(inference.force_basis_labels, np.asarray(inference.force_coefficients_full), strict=True))
    k, c, k3 = (-p.mass * w**2 * row[n] for n in ("x0·e0", "v0·e0", "x0^3·e0"))
    S = 4 * float(inference.diffusion_average[0, 0]) * (p.mass * s) ** 2 * w**3
    return p.found(k, c / w, k3 / s**2, S)


def pyoma(p: Place) -> dict[str, float]:
    """Covariance-driven stochastic subspace identification (package pyOMA2) at the highest peak of the spectrum."""
    import logging

    logging.disable(logging.INFO)
    from pyoma2.algorithms import SSI
    from pyoma2.setup import SingleSetup

    f, power = welch(p.raw, p.rate_hz, nperseg=1 << int(np.log2(100 * p.rate_hz / p.band[0])))
    inside = (f > p.band[0]) & (f < p.band[1])
    peak = float(f[inside][np.argmax(power[inside])])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        setup = SingleSetup(p.raw[:, None], fs=p.rate_hz)
        setup.decimate_data(q=max(1, int(p.rate_hz / (5 * peak))))
        algorithm = SSI(name="ssi", br=40, ordmax=20, hc=ANY_SHAPE)
        setup.add_algorithms(algorithm)
        setup.run_by_name("ssi")
    hz, damping = algorithm.result.Fn_poles, algorithm.result.Xi_poles
    stable = []
    for order in range(4, hz.shape[1]):  # the column of the stabilisation diagram's pole at the peak, order by order
        apart = np.abs(hz[:, order] - peak)
        if np.isfinite(apart).any() and np.nanmin(apart) < 0.1 * peak:
            at = int(np.nanargmin(apart))
            stable.append((hz[at, order], damping[at, order]))
    if not stable:
        raise ValueError("no pole at the peak of the spectrum")
    f0, zeta = np.median(stable, axis=0)
    w = 2 * np.pi * f0
    return p.found(p.mass * w * w, 2 * p.mass * zeta * w)


PACKAGES = {  # method -> the package that it needs
    "regression": "numpy",
    "kramersmoyal": "kramersmoyal",
    "PySINDy": "pysindy",
    "SFI": "SFI",
    "pyOMA2 SSI": "pyoma2",
}
METHODS = {"regression": regression, "kramersmoyal": kramersmoyal, "PySINDy": pysindy, "SFI": sfi, "pyOMA2 SSI": pyoma}
