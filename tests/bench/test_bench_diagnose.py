"""Time, processor and memory of comparison and diagnosis of one minute at 25.6 kHz, four channels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = """
import resource, sys, time
import numpy as np
from daq.rig.rig import load_rig
from estimator.diagnosis.comparison.comparison import compare
from estimator.diagnosis.verdict.diagnose import diagnose
model, y = load_rig(sys.argv[2]).model, np.load(sys.argv[3])
work = {"compare": compare, "diagnose": diagnose}[sys.argv[1]]
work(model, y[: 5 * 25600], 25600.0)  # compiled laws are read from the cache
wall, cpu = time.perf_counter(), time.process_time()
work(model, y, 25600.0)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
print(time.perf_counter() - wall, time.process_time() - cpu, peak)
"""


@pytest.mark.bench
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("command", "target_s"), [("compare", 5.0), ("diagnose", 15.0)])
def test_one_minute(command: str, target_s: float, tmp_path: Path) -> None:
    import numpy as np

    from daq.commands.study.hidden import RATE_HZ, Case, hidden
    from daq.rig.rig import load_rig
    from estimator.simulation.simulator import simulate

    rig = ROOT / "configs/tiwari_vyas_1997.toml"
    truth, _, noise = hidden(load_rig(rig).model, Case("clearance", "strong", "bearing1", 1), 60.0)
    np.save(tmp_path / "y.npy", simulate(truth, RATE_HZ, 60.0, seed=1, noise=noise, full_scale=490.5))
    program = [sys.executable, "-c", PROGRAM, command, str(rig), str(tmp_path / "y.npy")]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(program, capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    wall, cpu, peak = (float(z) for z in done.stdout.split())
    print(
        f"\n{command} of 60 s, 4 channels: {wall:.1f} s (asked {target_s:g}), processor {cpu:.1f} s, "
        f"peak {peak:.2f} GB (asked 1.5); load {os.getloadavg()[0]:.1f}"
    )
    assert wall > 0.0
