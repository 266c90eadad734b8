"""Standard deviations: by the curvature where the model is true, wider where parts of the record contradict it."""

from __future__ import annotations

import numpy as np
import pytest
from reference_rig import PLACES, RATE, TRUTH, rig_model, rig_record

from estimator.identification.batch import fit_spectral
from estimator.likelihood.fitting.fitted_values import fitted_parameters
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.uncertainty import joint_covariance

SECONDS = 12.0


@pytest.fixture(scope="module")
def steady() -> np.ndarray:
    return rig_record(SECONDS, seed=3)


def test_a_true_model_has_the_standard_deviations_of_the_curvature(steady: np.ndarray) -> None:
    model = rig_model("cubic")
    data = prepare(model, steady, RATE)
    point = fit_model(data, located_laws(model, data))
    k = len(point.fit.names)
    ratio = np.sqrt(np.diag(joint_covariance(point))[:k] / np.diag(point.fit.covariance))
    assert np.allclose(ratio, 1.0, rtol=0.02)
    S = fitted_parameters(point)["bearing1.x.S"]
    assert S.sd == pytest.approx(S.value / np.sqrt(point.gram.n[0].sum()), rel=0.05)


def test_a_stiffness_that_changes_along_the_record_widens_its_interval_only(steady: np.ndarray) -> None:
    moved = TRUTH["kL"] * [1.04, 1.0, 1.0, 1.0]
    y = rig_record(SECONDS, seed=3, change=(SECONDS / 2, moved))
    before, after = (fit_spectral(rig_model("cubic"), z, RATE).parameters for z in (steady, y))
    wider = {p: after[f"{p}.kL"].sd / before[f"{p}.kL"].sd for p in PLACES}  # type: ignore[operator]
    assert wider["bearing1.x"] > 3.0
    assert max(wider[p] for p in PLACES[1:]) < 1.5
