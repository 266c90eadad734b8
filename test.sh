#!/usr/bin/env bash
# All the set-up and every check, in a virtual environment of its own: ./test.sh [pytest arguments]
set -euo pipefail
cd "$(dirname "$0")"
venv=${ROTORSCOPE_VENV:-.venv-test}
[ "${CI:-}" = true ] && rm -rf "$venv"
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
unset PYTHONDONTWRITEBYTECODE  # what one process compiles every other one reads
"$venv/bin/python" -m compileall -q daq drivers estimator  # pip does it for what is not editable; 0.2 s of every command
export PATH="$PWD/$venv/bin:$PATH"
pytest -q -n 0 -k complete_gap >/dev/null & compiling=$!  # one process compiles the tests and the laws for each worker
ruff check .
mypy
lint-imports
wait "$compiling" || true  # the suite says what is wrong
pytest -n 3 --dist worksteal "$@"  # of three workers on two cores one waits; one that has ended takes tests of the others
