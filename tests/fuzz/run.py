"""Fuzz one target with atheris (pip install -e ".[fuzz]"):  python tests/fuzz/run.py TARGET [--seconds S] [--inputs N]

Without a target it lists them. It prints the number of inputs at the end; an input that breaks a promise (raises,
hangs for 20 s, takes 2 GB, writes elsewhere, runs something) is written to tests/fuzz/cases/TARGET-..., where
test_fuzz.py keeps trying it, and ends the run with status 1.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import warnings
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1])]

import atheris  # noqa: E402

COMPILED = [
    "drivers.serial.cobs",
    "drivers.can.slcan_codec",
    "estimator",
]  # numba cannot compile what has been instrumented

with atheris.instrument_imports(include=["daq", "drivers", "scipy.io", "pyuff", "can.io"], exclude=COMPILED):
    from guard import guarded
    from seeds import seeds
    from targets import TARGETS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=[*TARGETS], nargs="?")
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--inputs", type=int, default=-1)
    options = parser.parse_args()
    if options.target is None:
        print("\n".join(TARGETS))
        return
    warnings.simplefilter("ignore")
    target = TARGETS[options.target]
    base = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=base) as scratch, tempfile.TemporaryDirectory(dir=base) as corpus:
        for k, data in enumerate(seeds(options.target)):
            (Path(corpus) / f"seed{k}").write_bytes(data)
        folder = Path(scratch)
        target(seeds(options.target)[0], folder)  # compiles and imports what is lazy

        def one(data: bytes) -> None:
            with guarded(folder):
                target(data, folder)

        arguments = [
            sys.argv[0], corpus, f"-max_total_time={options.seconds}", f"-runs={options.inputs}", "-timeout=20",
            "-rss_limit_mb=2048", "-max_len=8192", "-len_control=20", "-print_final_stats=1", "-verbosity=0",
            f"-artifact_prefix={HERE / 'cases' / options.target}-",
        ]  # fmt: skip
        atheris.Setup(arguments, one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
