"""The rolling estimators by the name that a rig file gives them (`[estimator] method`)."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from estimator.model import Model
from estimator.parallel import one_core
from estimator.results import OnlineEstimator

ESTIMATOR_OF_METHOD = {
    "spectral": ("estimator.identification.rolling", "RollingEstimator"),
    "score-matching": ("estimator.identification.moments", "RollingScoreMatching"),
}
LONGEST_WARM_UP_S = 10.0  # of made-up data
TURN_S = 5e-4  # after which a search has to let an estimate go on: ten turns and more are waited for in one

MakeEstimator = Callable[[Model, float], OnlineEstimator]


def maker(method: str, time_constant_s: float, watch: str = "usual") -> MakeEstimator:
    """The maker of the estimator `method` for a model and a rate. The estimator is imported at its first use.

    watch : the effects that the spectral one looks for beside the model: usual | catalogue | none.
    """
    module, name = ESTIMATOR_OF_METHOD[method]

    def make(model: Model, rate_hz: float) -> OnlineEstimator:
        made, more = getattr(import_module(module), name), dict[str, Any]()
        if method == "spectral":
            more["run"] = _in_thread
        if method == "spectral" and watch != "usual":
            more["watch"] = (
                import_module("estimator.identification.rolling").watchable_effects() if watch == "catalogue" else ()
            )
        estimator: OnlineEstimator = made(model, rate_hz, time_constant_s, **more)
        return estimator

    return make


def _in_thread(search: Callable[[], Any]) -> Callable[[], Any]:
    """Run a search in a separate thread; the returned function waits for its result."""
    found: list[Any] = []

    sys.setswitchinterval(min(sys.getswitchinterval(), TURN_S))

    def run() -> None:
        try:
            with one_core():  # the other ones have an estimate to make
                found.append(search())
        except Exception as problem:  # raised where the result is asked for
            found.append(problem)

    thread = threading.Thread(target=run, name="background search", daemon=True)
    thread.start()

    def result() -> Any:
        thread.join()
        if isinstance(found[0], Exception):
            raise found[0]
        return found[0]

    return result


def warm_up(make: MakeEstimator, model: Model, rate_hz: float, rows: int) -> None:
    """Compile everything before data come, with an estimator that is fed until its first estimate and dropped.

    It is fed noise through a resonance in the middle of the band, which any of them takes for a bearing on its spring.
    """
    estimator = make(model, rate_hz)
    f_hz = min(float(np.sqrt(max(model.band[0], 1e-3) * model.band[1])), rate_hz / 4)
    pole = np.exp((-0.05 + 1j) * 2 * np.pi * f_hz / rate_hz)
    blocks = max(1, int(LONGEST_WARM_UP_S * rate_hz / rows))
    white = np.random.default_rng(0).standard_normal((blocks * rows, len(model.channels)))
    back = np.exp(-2j * np.pi * np.fft.rfftfreq(len(white)))[:, None]  # by one sample
    response = (1.0 - back) ** 2 / (1.0 - 2.0 * pole.real * back + abs(pole) ** 2 * back**2)
    record = np.fft.irfft(response * np.fft.rfft(white, axis=0), len(white), axis=0)
    for k, block in enumerate(np.split(record, blocks)):
        estimator.update(10.0 * block)
        if k % 16 == 15 and estimator.snapshot().parameters:
            return
