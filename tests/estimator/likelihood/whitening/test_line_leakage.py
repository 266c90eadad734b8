"""Leakage of noise from an edge of the band: it is no force amid the band."""

from __future__ import annotations

import numpy as np

from estimator import Channel, Model, Setting, compare, fit, simulate
from estimator.identification.batch.grid_start import fit_record
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.whitening.line_leakage import line_leakage

RATE_HZ = 29700.0
NOISE_RMS = 0.5  # m/s^2: integrated twice, 35 000 times the PSD of the force at the lower edge of the band
TRUE_LINEAR_SI = {"kL": 66e6, "c": 81.0, "S": 1.06e-5}


def rig(**known: float) -> Model:
    """A cap at 1850 Hz with a band from 107 Hz."""
    linear = {"bearing1.x": {name: Setting(value) for name, value in known.items()}}
    return Model((Channel("b1x", "bearing1", "x"),), band=(107.0, 8350.0), mass={"bearing1": 0.489}, linear=linear)


def test_noise_at_the_lower_edge_is_no_force_amid_the_band() -> None:
    """Where it leaks, S is 11 % too large, kL 0.4 % too small (3.5 sd each), and a coloured excitation is found."""
    y = simulate(rig(**TRUE_LINEAR_SI), RATE_HZ, 20.0, seed=3, noise=NOISE_RMS)
    found = fit(rig(), y, RATE_HZ).parameters
    for name, true in TRUE_LINEAR_SI.items():
        p = found[f"bearing1.x.{name}"]
        assert p.value is not None
        assert p.sd is not None
        assert abs(p.value - true) < 3.0 * p.sd, (name, p)
    assert compare(rig(), y, RATE_HZ).adequate


def test_an_edge_that_leaked_once_is_taken_out_in_all_of_a_fit() -> None:
    """With and without it a likelihood is of other data: a fit went to and fro between two values 1300 nats apart."""
    y = simulate(rig(**TRUE_LINEAR_SI), RATE_HZ, 4.0, seed=3, noise=NOISE_RMS)
    point = fit_record(rig(), prepare(rig(), y, RATE_HZ))
    assert point.whitening.leakage is not None
    assert point.data.leaking_edges_hz == point.whitening.leakage.edges_hz
    quiet = np.ones((1, point.data.bins.size), np.float32)  # nothing leaks with these weights
    again = line_leakage(point.data, quiet)
    assert again is not None
    assert again.edges_hz == point.data.leaking_edges_hz
