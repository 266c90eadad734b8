#!/usr/bin/env bash
# All the set-up, in a virtual environment of its own, and `rotorscope demo`: ./demo.sh [options of rotorscope demo]
set -euo pipefail
cd "$(dirname "$0")"
venv=${ROTORSCOPE_VENV:-.venv}
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".[all]"
"$venv/bin/python" -m compileall -q daq drivers estimator  # pip does it for what is not editable; 0.2 s of every command
exec "$venv/bin/rotorscope" demo "$@"
