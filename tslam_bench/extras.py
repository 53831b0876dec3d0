"""Optional dependencies: which extra brings a package that is missing.

The core scores and builds pages; ``tslam-bench[sim]`` simulates and learns, ``tslam-bench[assets]`` prepares objects,
``tslam-bench[ray]`` and ``tslam-bench[slurm]`` run jobs on several machines.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final

from tslam_bench.errors import MissingPackageError

EXTRAS: Final = {
    "assets": ("coacd", "collada", "lxml", "manifold3d", "mujoco", "networkx", "rtree", "skimage"),
    "sim": ("mani_skill", "safetensors", "sapien", "stable_baselines3", "tensorboard", "torch"),
    "ray": ("ray",),
    "slurm": ("submitit",),
}
"""Extra -> the modules that it brings."""


@contextlib.contextmanager
def named_extra() -> Iterator[None]:
    """Turns the failed import of a package of an extra into one line that says how to install it.

    Raises:
        MissingPackageError: a package of ``EXTRAS`` is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        extra = next((extra for extra, modules in EXTRAS.items() if name in modules), None)
        if extra is None:
            raise
        raise MissingPackageError(
            f"{name} is not installed, and this needs it; run: pip install 'tslam-bench[{extra}]' (or [all])"
        ) from error
