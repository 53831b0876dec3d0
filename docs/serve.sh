#!/usr/bin/env bash
# Shows the documentation at http://127.0.0.1:8000 while you edit it, or builds it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if [ $# -gt 1 ] || { [ $# -eq 1 ] && [ "$1" != "--build" ]; }; then
    echo "usage: bash docs/serve.sh [--build]"
    echo
    echo "  --build   write build/site/ and stop; a warning, such as a broken link, is an error"
    [ "$1" = "--help" ] || [ "$1" = "-h" ] && exit 0
    exit 2
fi

source ./setup.sh
set_up_environment
if ! "$PYTHON" -c "import material" 2>/dev/null; then
    "$PYTHON" -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[docs]"
fi
export NO_MKDOCS_2_WARNING=true
if [ $# -eq 1 ]; then
    exec "$PYTHON" -m mkdocs build --strict
fi
exec "$PYTHON" -m mkdocs serve
