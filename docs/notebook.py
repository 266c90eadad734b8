"""From a log to a named effect: python docs/notebook.py RIG.toml LOG.mcap"""

import sys

from daq import load_rig, read_log
from estimator import compare, diagnose, improve

rig = load_rig(sys.argv[1])
log = read_log(sys.argv[2])
record = log.samples(rig)  # (n, channels) in SI units, NaN where a sample is missing

comparison = compare(rig.model, record, log.rate_hz)
missing, low, high = comparison.missing
print(f"missing force: {missing:.2f} % of the bearing force ({low:.2f} to {high:.2f})")

diagnosis = diagnose(rig.model, record, log.rate_hz)
print("verdict:", diagnosis.verdict)

for rung in improve(rig.model, record, log.rate_hz).rungs:
    print(f"{', '.join(rung.effects) or 'linear'}: {rung.missing[0]:.2f} % missing")
