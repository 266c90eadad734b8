#!/usr/bin/env bash
# The link tests on real SocketCAN: boots the guest and runs `pytest -m guest` inside it. See CONTRIBUTING.md.
set -euo pipefail
top=$(cd "$(dirname "$0")/../.." && pwd)
guest=${SOCKETCAN_GUEST:-$top/../shared/socketcan-guest}
[ -x "$guest/qemu_can.sh" ] || [ -f "$guest/qemu_can.sh" ] || { echo "no qemu_can.sh in $guest: set SOCKETCAN_GUEST" >&2; exit 2; }
python=${PYTHON:-$top/.venv-test/bin/python}
[ -x "$python" ] || { echo "$python is missing: run ./test.sh once, or set PYTHON" >&2; exit 2; }
export QC_HOME=${QC_HOME:-${XDG_CACHE_HOME:-$HOME/.cache}/rotorscope-guest}
share=$(mktemp -d)
trap 'rm -rf "$share"' EXIT
mkdir -p "$QC_HOME"
bash "$guest/qemu_can.sh" run -s "$share" -t "${GUEST_SECONDS:-600}" -- \
  "cd $top && NUMBA_CACHE_DIR=$share PYTHONDONTWRITEBYTECODE=1 $python -m pytest -p no:cacheprovider -m guest -n 0 tests/guest $* > $share/out.txt 2>&1; rc=\$?; exit \$rc" && rc=0 || rc=$?
cat "$share/out.txt" 2>/dev/null || cat "$share/.qc_console"
exit "$rc"
