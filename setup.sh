# Prepares the virtual environment that baselines/run_all.sh and tests/run.sh use. Sourced by both, not run by itself.
#
# Creates .venv beside this file, installs this package with constraints.txt, and leaves a stamp: while neither
# pyproject.toml nor constraints.txt changes, the next call does nothing. Sets PYTHON to the interpreter.
#
#   PYTHON_FOR_VENV   interpreter to create .venv with (default: python3.11, else python3)

set_up_environment() {
    local root stamp base
    root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
    PYTHON="$root/.venv/bin/python"
    stamp="$(cat "$root/pyproject.toml" "$root/constraints.txt" | cksum) $root"
    if [ -x "$PYTHON" ] && [ "$(cat "$root/.venv/tslam-bench.stamp" 2>/dev/null)" = "$stamp" ]; then
        return 0
    fi
    base="${PYTHON_FOR_VENV:-$(command -v python3.11 || command -v python3)}"
    if ! "$base" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))'; then
        echo "setup: $base is $("$base" --version 2>&1); set PYTHON_FOR_VENV to a Python 3.11 or 3.12" >&2
        return 2
    fi
    echo "setup: installing into $root/.venv (once; a few minutes)"
    [ -x "$PYTHON" ] || "$base" -m venv "$root/.venv" || return 2
    if ! "$PYTHON" -m pip install --quiet --disable-pip-version-check --constraint "$root/constraints.txt" --editable "$root[dev]"; then
        echo "setup: pip could not install the dependencies (see above); is the package index reachable? Run the command again" >&2
        return 2
    fi
    echo "$stamp" >"$root/.venv/tslam-bench.stamp"
}
