"""One value for all places."""

import numpy as np

from estimator.results import Parameter, shared

PLACES = ("bearing1.x", "bearing1.y", "bearing2.x", "bearing2.y")


def parameters(values: np.ndarray, sd: np.ndarray) -> dict[str, Parameter]:
    pairs = zip(PLACES, values.tolist(), sd.tolist(), strict=True)
    return {f"{place}.cubic.kNL": Parameter(v, s, "N/m^3") for place, v, s in pairs}


def test_of_equal_places_the_mean_covers_and_p_is_calibrated() -> None:
    rng, sd = np.random.default_rng(1), np.array([0.05, 0.1, 0.2, 0.1])
    found = [shared(parameters(1.0 + sd * rng.standard_normal(4), sd))["cubic.kNL"] for _ in range(2000)]
    z = np.array([(f.value - 1.0) / f.sd for f in found])
    assert abs(z.std() - 1.0) < 0.06
    assert found[0].sd == np.sum(sd**-2.0) ** -0.5
    p = np.sort([f.p_equal for f in found])
    assert np.max(np.abs(p - (np.arange(2000) + 0.5) / 2000)) < 1.63 / np.sqrt(2000)  # Kolmogorov, 1 %


def test_places_that_differ_are_said_to() -> None:
    one = shared(parameters(np.array([1.0, 1.0, 1.0, 2.0]), np.full(4, 0.1)))["cubic.kNL"]
    assert "differ" in one.sentence("cubic.kNL")
    same = shared(parameters(np.array([1.0, 1.1, 0.9, 1.0]), np.full(4, 0.1)))["cubic.kNL"]
    assert same.sentence("cubic.kNL").endswith("one value for all of them would be 1 +- 0.05 N/m^3 (5 %)")


def test_a_place_that_cannot_tell_or_stands_alone_gives_no_shared_value() -> None:
    found = parameters(np.ones(4), np.full(4, 0.1)) | {"bearing1.x.kL": Parameter(1.0, 0.1, "N/m")}
    found["bearing2.y.cubic.kNL"] = Parameter(None, None, "N/m^3", False, reason="no")
    found["bearing1.x.coulomb.fc"] = Parameter(0.1, 0.01, "N")
    assert shared(found) == {}
