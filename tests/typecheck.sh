#!/usr/bin/env bash
# Runs mypy on the library and on its leaves.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
exec .venv/bin/python -m mypy --config-file pyproject.toml -p tslam_bench -p tasks -p baselines -p leaderboard
