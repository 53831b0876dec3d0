"""``python -m tslam_bench.cli``: the ``tslam-bench`` command."""

from tslam_bench.cli import main

main()
