#!/usr/bin/env bash
# The link tests on real SocketCAN: boots the guest and runs `pytest -m guest` inside it. See CONTRIBUTING.md.
set -euo pipefail
top=$(cd "$(dirname "$0")/../.." && pwd)
guest=${SOCKETCAN_GUEST:-$top/../shared/socketcan-guest}
[ -f "$guest/qemu_can.sh" ] || { echo "no qemu_can.sh in $guest: set SOCKETCAN_GUEST" >&2; exit 2; }
python=${PYTHON:-$top/.venv-test/bin/python}
[ -x "$python" ] || { echo "$python is missing: run ./test.sh once, or set PYTHON" >&2; exit 2; }
export QC_HOME=${QC_HOME:-${XDG_CACHE_HOME:-$HOME/.cache}/rotorscope-guest}
share=$(mktemp -d)
trap 'rm -rf "$share"' EXIT
mkdir -p "$QC_HOME/numba"

# The emulated processor is another one than ours: compile here, for any processor, what would take minutes in there.
compiled="NUMBA_CPU_NAME=generic NUMBA_CACHE_DIR=$QC_HOME/numba"
loop=$(env $compiled PYTHONDONTWRITEBYTECODE=1 "$python" "$top/tests/guest/compile_ahead.py" "$share" | tail -n 1)

bash "$guest/qemu_can.sh" run -s "$share" -t "${GUEST_SECONDS:-1500}" -- \
  "modprobe canerr; cd $top && HOST_LOOP_S=$loop $compiled PYTHONDONTWRITEBYTECODE=1 PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 \
   $python -m pytest -p pytest_timeout -p no:cacheprovider -m guest -v -rP --durations=0 \
   --junit-xml=$share/guest.xml --basetemp=/tmp/guest tests/guest $* > $share/out.txt 2>&1" && rc=0 || rc=$?
cat "$share/out.txt" 2>/dev/null || cat "$share/.qc_console"
[ -z "${GUEST_XML:-}" ] || cp "$share/guest.xml" "$GUEST_XML" 2>/dev/null || true
exit "$rc"
