"""What becomes of arrays that are let go."""

import subprocess
import sys

import pytest

ARRAYS = """
import resource
import numpy as np
from daq.base.console.memory import keep_freed

if {keep}:
    keep_freed()
faults = []
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    [np.ones(3_500_000) for _ in range(4)]  # 28 MB each
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(faults[0], faults[2])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's")
def test_arrays_are_made_where_others_were() -> None:
    def faults(keep: bool) -> tuple[int, ...]:
        code = ARRAYS.format(keep=keep)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return tuple(map(int, done.stdout.split()))

    new, again = faults(keep=True)
    assert again < 0.1 * new
    assert faults(keep=False)[1] > again
