#!/usr/bin/env bash
# Runs every check: set-up, lint, types, assets, tests, and a tiny real run of the whole chain.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

usage() {
    cat <<'USAGE'
usage: bash tests/run.sh [--fast] [pytest arguments]

Does its own set-up (virtual environment, quick assets), then runs ruff, mypy, the checks of generated pages,
a tiny run of the whole chain and the test suite.

  --fast    skip the tests marked slow
  --help    this text

Everything after these is handed to pytest, e.g. `bash tests/run.sh -k metrics`.
USAGE
}

markers=()
while [ $# -gt 0 ]; do
    case "$1" in
        -h | --help) usage; exit 0 ;;
        --fast) markers=(-m "not slow"); shift ;;
        *) break ;;
    esac
done

source ./setup.sh
set_up_environment

step() { printf '\n== %s\n' "$*"; "$@"; }

step "$PYTHON" -m ruff check .
step "$PYTHON" -m ruff format --check .
step bash tests/typecheck.sh
step "$PYTHON" -m tslam_bench.cli assets prepare --quick
step "$PYTHON" -m tslam_bench.cli assets prepare --objects cubemedium cubesmall  # of the fidelity tests
step "$PYTHON" docs/build_environment.py --check
step "$PYTHON" docs/build_results.py --check
step "$PYTHON" docs/build_objects.py --check
step "$PYTHON" docs/build_gpu.py --check
if [ $# -eq 0 ]; then  # a chosen test needs no run of the whole chain
    tiny="$(mktemp -d)"
    trap 'rm -rf "$tiny"' EXIT
    step bash baselines/run_all.sh --tiny --output "$tiny"
    test -s "$tiny/index.html"
fi
# One process per core; a file stays with one process, since its tests share what they prepare.
step "$PYTHON" -m pytest -n auto --dist loadfile "${markers[@]}" "$@"
