# Prepares the virtual environment that baselines/run_all.sh and tests/run.sh use. Sourced by both, not run by itself.
#
# Creates .venv beside this file, installs this package with constraints.txt, and leaves a stamp: while neither
# pyproject.toml nor constraints.txt changes, the next call does nothing. Sets PYTHON to the interpreter.
# A .venv that came along with a copied or moved clone is made this clone's: its scripts work on the folder of their making.
#
#   PYTHON_FOR_VENV   interpreter to create .venv with (default: python3.11, else python3)

set_up_environment() {
    local root stamp base found owner
    root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
    PYTHON="$root/.venv/bin/python"
    found="$(cat "$root/.venv/tslam-bench.stamp" 2>/dev/null || true)"  # callers stop at errors
    stamp="$(cat "$root/pyproject.toml" "$root/constraints.txt" | cksum) $root"
    if [ -x "$PYTHON" ] && [ "$found" = "$stamp" ]; then
        return 0
    fi
    case "$(uname -s) $(uname -m)" in
        "Linux x86_64" | Darwin* | MINGW* | MSYS* | CYGWIN*) ;;
        *)
            echo "setup: the simulator has no wheels for $(uname -s) on $(uname -m); take another machine," \
                "or 'pip install .' for scoring and pages alone" >&2
            return 2
            ;;
    esac
    owner="$(printf '%s' "$found" | cut -d ' ' -f 3-)"
    if [ -z "$owner" ] && [ -e "$root/.venv/bin/activate" ]; then
        owner="$(sed -n "s/^ *VIRTUAL_ENV=['\"]\\{0,1\\}\\(\\/[^'\"]*\\)\\/\\.venv['\"]\\{0,1\\}$/\\1/p" "$root/.venv/bin/activate" | head -n 1)"
    fi
    if [ -n "$owner" ] && ! [ "$owner" -ef "$root" ]; then
        if [ -L "$root/.venv" ]; then
            echo "setup: .venv is that of $owner; making another one here"
            rm "$root/.venv"
        elif [ -x "$PYTHON" ]; then
            echo "setup: .venv was made in $owner; its scripts are rewritten for this folder"
            _rewrite_scripts "$owner/.venv" "$root/.venv" || return 2
        fi
    fi
    base="$PYTHON"
    [ -x "$PYTHON" ] || base="${PYTHON_FOR_VENV:-$(command -v python3.11 || command -v python3)}"
    if ! "${base:-python3}" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))'; then
        echo "setup: ${base:-python3} is $("${base:-python3}" --version 2>&1); delete .venv if there is one," \
            "and set PYTHON_FOR_VENV to a Python 3.11 or 3.12" >&2
        return 2
    fi
    echo "setup: installing into $root/.venv (once; a few minutes)"
    [ -x "$PYTHON" ] || "$base" -m venv "$root/.venv" || return 2
    if ! "$PYTHON" -m pip install --quiet --disable-pip-version-check --constraint "$root/constraints.txt" --editable "$root[dev]"; then
        echo "setup: pip could not install the dependencies (see above); is the package index reachable? Run the command again" >&2
        return 2
    fi
    rm -f "$root/.venv/tslam-bench.stamp"  # in a copy made of hard links it is the other's, too
    echo "$stamp" >"$root/.venv/tslam-bench.stamp"
}

_rewrite_scripts() {  # FROM TO: scripts name the interpreter that they run, "activate" the folder that pip installs into
    "$2/bin/python" -I - "$1" "$2" <<'PROGRAM'
import os, pathlib, shutil, sys

old, new = (os.fsencode(argument) for argument in sys.argv[1:])
folder = pathlib.Path(sys.argv[2])
for path in [*(folder / "bin").iterdir(), folder / "pyvenv.cfg"]:
    if path.is_file() and not path.is_symlink():
        content = path.read_bytes()
        if old in content and b"\0" not in content:
            temporary = path.with_name(path.name + ".new")
            temporary.write_bytes(content.replace(old, new))
            shutil.copymode(path, temporary)
            temporary.replace(path)
PROGRAM
}
