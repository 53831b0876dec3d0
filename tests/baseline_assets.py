"""A small asset cache of boxes for tests that run the environment: ``from baseline_assets import primitive_cache``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import trimesh
from prepared_shapes import prepare_primitive

from tslam_bench.constants import SURFACE_SAMPLES
from tslam_bench.objects import store
from tslam_bench.objects.hand import hand_directory, load_hand

SHAPES = {
    "train": {"box": (0.10, 0.08, 0.06), "plate": (0.14, 0.10, 0.03)},
    "test": {"cubelarge": (0.12, 0.12, 0.12), "phone": (0.15, 0.05, 0.025)},
}
"""Split -> name -> edges (m) of the boxes in the cache; the test split's names must be known, so they are borrowed."""


def primitive_cache(cache: Path) -> Path:
    """Fills ``cache`` with the boxes of ``SHAPES`` and a link to the prepared hand."""
    load_hand()  # fails with the command that prepares it
    target = hand_directory(cache)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(hand_directory(), target_is_directory=True)
    for split, boxes in SHAPES.items():
        for name, extents in boxes.items():
            mesh = trimesh.creation.box(extents=extents)
            prepared = prepare_primitive(mesh, [mesh], name, spacing=4e-3)
            _, faces = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=np.random.default_rng(0))
            store.write(dataclasses.replace(prepared, split=split), np.asarray(faces), cache)
    return cache
