#!/usr/bin/env bash
# Test with the lowest or the newest supported versions: scripts/versions.sh lowest|newest [VENV]
# Builds a virtual environment of its own (default .venv-lowest, .venv-newest) and runs the tests of SB3's contract, of
# the semi-Markov process and of the tasks in it; some minutes. PYTHON says which Python; TORCH, if set, the version of
# torch where the lowest one has no wheel.
set -euo pipefail
cd "$(dirname "$0")/.."
which=${1:-}
venv=${2:-.venv-$which}
tests=(tests/contract tests/smdp tests/tasks/test_time_limit.py tests/tasks/test_copies.py tests/tbc_hrl/test_learn.py)

case $which in
lowest)  # the bounds of setup.cfg as pins
    pins=$(mktemp)
    sed -n '/^install_requires/,/^$/s/^ *\([A-Za-z0-9_-]*\)>=\(.*\)$/\1==\2/p' setup.cfg > "$pins"
    if [ -n "${TORCH:-}" ]; then sed -i "s/^torch==.*/torch==$TORCH/" "$pins"; fi
    echo "lowest versions:"
    cat "$pins"
    options=(--constraint "$pins")
    ;;
newest)
    options=(--upgrade --upgrade-strategy eager)
    if [ -n "${TORCH:-}" ]; then
        pins=$(mktemp)
        echo "torch==$TORCH" > "$pins"
        options+=(--constraint "$pins")
    fi
    ;;
*)
    echo "usage: scripts/versions.sh lowest|newest [VENV]" >&2
    exit 2
    ;;
esac

rm -rf build  # what an earlier build left would be packed again
test -x "$venv/bin/python" || "${PYTHON:-python3}" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet "${options[@]}" . pytest hypothesis pandas matplotlib tensorboard cloudpickle
"$venv/bin/python" - <<'END'
from importlib.metadata import version
for name in ("stable_baselines3", "sb3_contrib", "torch", "gymnasium", "gymnasium_robotics", "mujoco", "numpy", "scipy"):
    print(f"{name} {version(name)}")
END
OMP_NUM_THREADS=1 "$venv/bin/pytest" "${tests[@]}"  # not python -m pytest, which would import the checkout
