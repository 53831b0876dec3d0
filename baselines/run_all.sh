#!/usr/bin/env bash
# Runs the whole benchmark on a fresh machine: set-up, assets, training, episodes, reconstruction, scores, page.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

for argument in "$@"; do
    if [ "$argument" = "-h" ] || [ "$argument" = "--help" ]; then
        cat <<'USAGE'
usage: bash baselines/run_all.sh --quick | --tiny | --scripted | --shipped | --full [options]

Does its own set-up (virtual environment, dependencies, assets), prints the commands it runs, and leaves
runs/<name>/index.html and leaderboard.json; logs are in runs/<name>/logs. Run it again to go on after a stop.

  --quick                five objects, all baselines after a few thousand training steps, and those whose weights are
                         shipped: 15 minutes on 2 cores
  --tiny                 one object, five explorers, hardly any training: checks that the path works
  --scripted             the whole test split, three seeds, explorers that are not trained: about an hour on 2 cores
  --shipped              the same and the learned policies whose weights are shipped, each seed with its own
  --full                 the whole test split, three seeds, the paper's training budget: days on a CPU

  --objects NAME ...     test objects instead of the preset's
  --baselines ID ...     policies instead of the preset's (tslam-bench baselines list), or installed module:Class
  --seeds N ...          repetitions of every episode
  --steps N              training steps of each learned baseline
  --reconstructors ID ...
                         reconstructors instead of the preset's (tslam-bench reconstruct list), or the like
  --retrain              train the learned reconstructors even if their weights are shipped
  --policy-salt DIGITS   hexadecimal digits that explorers' random numbers come from
  --output FOLDER        folder of the run (default: runs/ and the preset's name)
  --workers N            processes at a time (default: the cores); on a cluster: cores of one job that uses several
  --launcher NAME        local, ray or slurm: where the commands run (docs/clusters.md)
  --address ADDRESS      of the Ray cluster
  --slurm KEY=VALUE ...  parameters of submitit: slurm_partition=cpu timeout_min=600 mem_gb=8
  --dry-run              print the commands without running them
  --help                 this text
USAGE
        exit 0
    fi
done

source ./setup.sh
set_up_environment
exec "$PYTHON" -m tslam_bench.baselines.run "$@"
