"""The fit on a rig integrated by another scheme, from no knowledge; and what it refuses."""

import numpy as np
import pytest
from reference_rig import DISC, MASS, PLACES, RATE, TRUTH, rig_model, rig_record, shaft_at_caps

from estimator.errors import DataError
from estimator.identification.batch import spectral as spectral
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    return rig_record(20.0, seed=1)


def test_linear_and_cubic_parameters_come_back_within_their_intervals(record: np.ndarray) -> None:
    fit = spectral.fit_spectral(rig_model("cubic"), record, RATE)
    z = []
    for i, place in enumerate(PLACES):
        for key in ("kL", "c", "S"):
            p = fit.parameters[f"{place}.{key}"]
            assert p.value is not None
            assert p.sd is not None
            z.append((p.value - TRUTH[key][i]) / p.sd)
            assert p.value == pytest.approx(TRUTH[key][i], rel={"kL": 0.005, "c": 0.06, "S": 0.015}[key])
        p = fit.parameters[f"{place}.cubic.kNL"]
        assert p.value == pytest.approx(1.3e18, rel=0.35)
        z.append((p.value - 1.3e18) / p.sd)
        assert fit.parameters[f"{place}.m"].value == MASS
    assert np.sqrt(np.mean(np.square(z))) < 1.6
    assert fit.messages == ()


def test_results_are_the_same_with_a_gap_as_without_its_samples(record: np.ndarray) -> None:
    holed = record.copy()
    holed[200000:200050, 2] = np.nan
    a, b = (spectral.fit_spectral(rig_model("cubic"), y, RATE).parameters for y in (record, holed))
    for name, p in a.items():
        if p.value is not None and p.sd:
            assert abs(p.value - b[name].value) < 1.0 * p.sd


def test_what_cannot_be_estimated_is_refused_in_one_line(record: np.ndarray) -> None:
    model = rig_model()
    dead, stuck = record.copy(), record.copy()
    dead[:, 1] = 0.0
    stuck[:, 1] = 3.0
    noise = np.random.default_rng(0).normal(size=record.shape)
    cases = [
        (model, dead, "b1y"),
        (model, stuck, "constant"),
        (model, record[:9000], "record"),
        (rig_model(band=(2500.0, 8000.0)), record, "resonance"),
        (rig_model(band=(150.0, 12800.0)), record, "Nyquist"),
        (model, noise, "resonance"),
        (model, record[:, :3], "channels"),
        (model, [[1.0, 2.0], [3.0]], "unequal"),
        (rig_model(linear={"bearing1.x": {"kL": Setting(-1e7)}}), record, "unstable: bearing1.x.kL"),
    ]
    for m, y, word in cases:
        with pytest.raises(DataError, match=word) as e:
            spectral.fit_spectral(m, y, RATE)
        assert "\n" not in str(e.value)


def test_a_start_value_far_off_does_not_matter(record: np.ndarray) -> None:
    escaping = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(-1e22)}})
    p = spectral.fit_spectral(rig_model(effects=(escaping,)), record, RATE).parameters["bearing1.x.cubic.kNL"]
    assert p.value == pytest.approx(1.3e18, rel=0.35)


def test_a_stiffness_that_the_rig_file_fixes_is_kept(record: np.ndarray) -> None:
    fixed = {"bearing1.x": {"kL": Setting(1.0e7, fixed=True)}}
    found = spectral.fit_spectral(rig_model("cubic", linear=fixed), record, RATE).parameters
    assert (found["bearing1.x.kL"].value, found["bearing1.x.kL"].sd) == (1.0e7, 0.0)
    assert found["bearing1.x.c"].value == pytest.approx(60.0, rel=0.06)


def test_a_record_in_pieces_is_distinguished_from_a_short_one(record: np.ndarray) -> None:
    holed = record.copy()
    holed[::6000] = np.nan
    with pytest.raises(DataError, match=r"too few stretches of 0.64 s without a .* 12 are needed"):
        spectral.fit_spectral(rig_model(), holed, RATE)
    with pytest.raises(DataError, match=r"the record has 0.5 s, at least 0.8 s are needed .* record longer"):
        spectral.fit_spectral(rig_model(), record[: int(0.5 * RATE)], RATE)


def exact_record(model: Model, n: int = 1 << 19) -> np.ndarray:
    """(n, 4) m/s^2 of the linear rig, made in the frequency domain: no integrator, no filter, no error."""
    rng, w = np.random.default_rng(0), 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    caps = shaft_at_caps(model.shaft, model.shaft_stiffness, model.shaft_damping, DISC, w)
    out = np.empty((n, 4))
    for pair in ((0, 2), (1, 3)):
        m, c, k, S = (np.array(z)[list(pair)] for z in (np.full(4, MASS), TRUTH["c"], TRUTH["kL"], TRUTH["S"]))
        D = caps + np.eye(2) * (k + 1j * np.multiply.outer(w, c) - np.multiply.outer(w**2, m))[:, None, :]
        F = (rng.normal(size=(w.size, 2)) + 1j * rng.normal(size=(w.size, 2))) * np.sqrt(S * RATE * n / 4)
        x = np.linalg.solve(D, F[..., None])[..., 0]
        out[:, pair] = np.fft.irfft(-(w[:, None] ** 2) * x, n, axis=0)
    return out


@pytest.mark.parametrize(("hz", "low"), [(123.5, 150.0), (123.5, 60.0), (300.0, 150.0)])
def test_a_disc_that_rings_beside_or_in_the_band_biases_nothing(hz: float, low: float) -> None:
    stiffness, damping = 0.5 * DISC * (2 * np.pi * hz) ** 2, DISC * 2 * np.pi * hz / 400 / 2  # Q 400
    model = rig_model(band=(low, 8000.0), shaft_stiffness=stiffness, shaft_damping=damping)
    fit = spectral.fit_spectral(model, exact_record(model), RATE)
    assert not any(m.code == "force_not_white" for m in fit.messages)
    found = [(fit.parameters[f"{p}.{q}"], TRUTH[q][i]) for i, p in enumerate(PLACES) for q in ("kL", "c", "S")]
    z = np.array([(p.value - true) / p.sd for p, true in found])
    assert np.abs(z).max() < 3.5
    assert np.sqrt(np.mean(z**2)) < 1.5


@pytest.mark.slow
def test_a_stiff_shaft_moves_the_resonances_and_biases_nothing() -> None:
    linear = {p: {k: Setting(float(TRUTH[k][i])) for k in ("kL", "c", "S")} for i, p in enumerate(PLACES)}
    known = {"disc": DISC, "bearing1": MASS, "bearing2": MASS}
    for stiffness, mass in ((1e7, known), (1e6, {"disc": DISC})):  # the shaft sets the scale of unknown masses
        y = simulate(rig_model(shaft_stiffness=stiffness, linear=linear), RATE, 15.0, seed=5)
        fit = spectral.fit_spectral(rig_model(shaft_stiffness=stiffness, mass=mass), y, RATE)
        assert not any(m.code == "force_not_white" for m in fit.messages)
        z = []
        for i, place in enumerate(PLACES):
            for key, true in (("kL", TRUTH["kL"][i]), ("c", TRUTH["c"][i]), ("m", MASS)):
                p = fit.parameters[f"{place}.{key}"]
                assert p.identifiable
                assert p.value is not None
                assert p.sd is not None
                if p.sd > 0:
                    z.append((p.value - true) / p.sd)
        assert np.max(np.abs(z)) < 4.0
        assert np.sqrt(np.mean(np.square(z))) < 1.7
