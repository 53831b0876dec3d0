"""Shapes that a program meets from people who mean it harm."""

from __future__ import annotations

import numpy as np
import trimesh


def slivers(count: int, seed: int = 0) -> trimesh.Trimesh:
    """Thin closed tetrahedra right across the box, all through each other."""
    generator = np.random.default_rng(seed)
    start = generator.uniform(-0.1, 0.1, (count, 3))
    end = np.clip(generator.normal(-start, 0.01), -0.1, 0.1)
    across = np.cross(end - start, generator.normal(size=(count, 3)))
    across *= 2e-3 / np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(end - start, across)
    other *= 2e-3 / np.linalg.norm(other, axis=1, keepdims=True)
    corners = np.stack([start, end, start + across, start + other], axis=1)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = trimesh.Trimesh(
        corners.reshape(-1, 3), (4 * np.arange(count)[:, None, None] + faces).reshape(-1, 3), process=False
    )
    if mesh.volume < 0:
        mesh.invert()
    return mesh
