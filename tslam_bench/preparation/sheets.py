"""Pictures of prepared objects: one object in four views, and contact sheets of many."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont

from tslam_bench.objects.store import PreparedObject

MESH_COLOUR = (0.44, 0.60, 0.82)
SOLID_COLOUR = (0.86, 0.66, 0.36)
SURFACE_COLOUR = (0.48, 0.70, 0.50)
CAPTION_HEIGHT = 22


def hull_colour(index: int) -> tuple[float, float, float]:
    """Colour of hull number ``index``: neighbours in number are far apart in hue."""
    red, green, blue = colorsys.hsv_to_rgb((index * 0.618034) % 1.0, 0.45 + 0.25 * (index % 2), 0.9)
    return red, green, blue


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def _panel(items: Sequence[tuple[trimesh.Trimesh, Any]], size: int, caption: str, sky_rays: int = 10) -> Image.Image:
    """One view with a caption below."""
    from tslam_bench.geometry.render import fit_camera, render

    camera = fit_camera([mesh for mesh, _ in items])
    low = min(float(mesh.vertices[:, 2].min()) for mesh, _ in items)
    picture = Image.new("RGB", (size, size + CAPTION_HEIGHT), "white")
    picture.paste(Image.fromarray(render(items, camera, size, ground=low, sky_rays=sky_rays)), (0, 0))
    draw = ImageDraw.Draw(picture)
    draw.text((size / 2, size + 4), caption, fill=(60, 60, 60), anchor="ma", font=ImageFont.load_default(13))
    return picture


def _in_rows(panels: Sequence[Image.Image], columns: int) -> Image.Image:
    """Panels of one size, side by side and row by row."""
    width, height = panels[0].size
    sheet = Image.new("RGB", (columns * width, -(-len(panels) // columns) * height), "white")
    for number, panel in enumerate(panels):
        sheet.paste(panel, (number % columns * width, number // columns * height))
    return sheet


def object_picture(prepared: PreparedObject, size: int = 360) -> Image.Image:
    """Mesh, hulls in colours, solid voxels and surface voxels of one object, side by side."""
    from tslam_bench.geometry.render import voxels_to_mesh

    hulls = [(_mesh(v, f), hull_colour(k)) for k, (v, f) in enumerate(prepared.hulls)]
    iou = prepared.record["gates"]["hull_iou"]
    panels = [
        _panel([(_mesh(prepared.vertices, prepared.faces), MESH_COLOUR)], size, f"{prepared.name}: true mesh"),
        _panel(hulls, size, f"{len(hulls)} collision hulls, IoU {iou:.3f}"),
        _panel([(voxels_to_mesh(prepared.solid), SOLID_COLOUR)], size, f"{int(prepared.solid.sum())} solid voxels"),
        _panel(
            [(voxels_to_mesh(prepared.surface), SURFACE_COLOUR)], size, f"{int(prepared.surface.sum())} surface voxels"
        ),
    ]
    return _in_rows(panels, len(panels))


def contact_sheet(
    objects: Iterable[tuple[str, np.ndarray, np.ndarray]], columns: int = 10, size: int = 150
) -> Image.Image:
    """Many meshes with their names: ``objects`` are (caption, vertices (V, 3), faces (F, 3)), each filling its panel."""
    panels = [
        _panel([(_mesh(vertices, faces), MESH_COLOUR)], size, caption, sky_rays=6)
        for caption, vertices, faces in objects
    ]
    return _in_rows(panels, columns)
