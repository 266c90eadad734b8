"""The low-pass filters against those of scipy."""

import numpy as np
import pytest
from scipy.signal import firwin, kaiserord

from estimator.signals import low_pass


@pytest.mark.parametrize("width", [0.05, 0.4])
def test_the_filters_are_those_of_scipy(width: float) -> None:
    taps, beta = low_pass.kaiser_order(90.0, width)
    assert (taps, beta) == pytest.approx(kaiserord(90.0, width))
    for n in (taps, taps + 1):
        assert np.allclose(
            low_pass.kaiser_low_pass(n, 0.25, beta), firwin(n, 0.25, window=("kaiser", beta)), atol=1e-15
        )
