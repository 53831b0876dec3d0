#!/usr/bin/env bash
# Runs mypy on the package as users see it: the top-level folders laid out as subpackages of tslam_bench, by links.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root="$PWD"
layout="$(mktemp -d)"
trap 'rm -rf "$layout"' EXIT
mkdir "$layout/tslam_bench"
ln -s "$root"/tslam_bench/* "$layout/tslam_bench/"
for part in assets tasks baselines leaderboard; do
    ln -s "$root/$part" "$layout/tslam_bench/$part"
done
python="$root/.venv/bin/python"
cd "$layout"
"$python" -m mypy --config-file "$root/pyproject.toml" --cache-dir "$root/.mypy_cache" -p tslam_bench
