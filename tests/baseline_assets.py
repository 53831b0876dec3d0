"""A small asset cache of primitives for tests that run the environment: ``from baseline_assets import primitive_cache``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import trimesh
from objects import prepare_primitive

from tslam_bench.assets import store
from tslam_bench.assets.hand import hand_directory, load_hand
from tslam_bench.constants import SURFACE_SAMPLES

SHAPES = {"box": (0.10, 0.08, 0.06), "plate": (0.14, 0.10, 0.03)}
"""Edges (m) of the boxes that the cache's train and test splits hold."""


def primitive_cache(cache: Path) -> Path:
    """Fills ``cache`` with boxes as objects ``box`` and ``plate`` of the train split, and a link to the prepared hand."""
    load_hand()  # fails with the command that prepares it
    target = hand_directory(cache)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(hand_directory(), target_is_directory=True)
    for name, extents in SHAPES.items():
        mesh = trimesh.creation.box(extents=extents)
        prepared = prepare_primitive(mesh, [mesh], name, spacing=4e-3)
        _, faces = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=np.random.default_rng(0))
        store.write(dataclasses.replace(prepared, split="train"), np.asarray(faces), cache)
    return cache
