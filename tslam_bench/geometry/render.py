"""A small deterministic ray caster for pictures of meshes and voxel grids: no GPU, no display, no simulator.

One primary ray per sub-pixel, a key light that moves with the camera, sky light with ambient occlusion, and a soft contact
shadow on the ground below. Embree answers the rays where ``embreex`` is installed; trimesh's own slower intersector
does otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.geometry.triangles import face_normals

Colour = tuple[float, float, float]
"""sRGB, each channel in [0, 1]."""

_CREASE: Final = math.cos(
    math.radians(50)
)  # corners sharper than this are shaded flat; a cube's corner is at 54.7 degrees
_KEY: Final = (-0.45, 0.65, 0.75)  # direction to the key light: right, up, towards the viewer
_KEY_STRENGTH: Final = 0.72
_SKY_STRENGTH: Final = 0.62
_SHADOW_STRENGTH: Final = 0.42
_SHADOW_NET: Final = 56  # points per axis
_SHADOW_RAYS: Final = 32


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from. Angles in degrees, lengths in the unit of the meshes.

    Attributes:
        target: (3,) point in the middle of the picture.
        azimuth: of the camera seen from the target, counter-clockwise about z, from x.
        elevation: above the xy plane.
        height: height of the picture at the target.
        field_of_view: vertical opening angle; 0 for an orthographic camera.
    """

    target: tuple[float, float, float]
    azimuth: float = -60.0
    elevation: float = 25.0
    height: float = 0.25
    field_of_view: float = 0.0

    def axes(self) -> NDArray[np.float64]:
        """Rows: right, up, and from the target to the camera; orthonormal."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        back = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        return np.stack([right, np.cross(back, right), back])

    def rays(self, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origins and unit directions (width * height, 3) through the pixel centres, row by row from the top left."""
        axes = self.axes()
        pixel = self.height / height
        u = (np.arange(width) + 0.5 - width / 2) * pixel
        v = (height / 2 - np.arange(height) - 0.5) * pixel
        offset = u[None, :, None] * axes[0] + v[:, None, None] * axes[1]
        plane = (np.array(self.target) + offset).reshape(-1, 3)
        if self.field_of_view == 0:
            return plane + 100 * self.height * axes[2], np.broadcast_to(-axes[2], plane.shape).copy()
        eye = np.array(self.target) + axes[2] * self.height / (2 * math.tan(math.radians(self.field_of_view) / 2))
        directions = plane - eye
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.broadcast_to(eye, plane.shape).copy(), directions


def fit_camera(
    meshes: Sequence[trimesh.Trimesh],
    azimuth: float = -60.0,
    elevation: float = 25.0,
    field_of_view: float = 0.0,
    aspect: float = 1.0,
    margin: float = 1.12,
) -> Camera:
    """The camera of this direction whose picture holds all ``meshes``, with a ``margin`` around them.

    Args:
        aspect: width over height of the picture.
    """
    points = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)])
    points = points if len(points) else np.zeros((1, 3))
    camera = Camera((0.0, 0.0, 0.0), azimuth, elevation, 1.0, field_of_view)
    seen = points @ camera.axes().T
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    extent = np.maximum(np.ptp(seen, axis=0), 1e-6)
    height = max(extent[1], extent[0] / aspect)
    if field_of_view:  # what is nearer to the eye than the target looks larger
        height += extent[2] * math.tan(math.radians(field_of_view) / 2)
    x, y, z = (float(value) for value in centre @ camera.axes())
    return replace(camera, target=(x, y, z), height=float(height * margin))


def render(
    items: Sequence[tuple[trimesh.Trimesh, Colour]],
    camera: Camera,
    size: int | tuple[int, int] = 320,
    background: Colour | None = (1.0, 1.0, 1.0),
    ground: float | None = None,
    supersampling: int = 2,
    sky_rays: int = 12,
) -> NDArray[np.uint8]:
    """Picture of ``items``, the same bits for the same input on one platform.

    Args:
        items: meshes (z up) with their colours; empty meshes are skipped.
        camera: see :func:`fit_camera`.
        size: pixels, one number for a square or (width, height).
        background: colour, or None for a transparent one.
        ground: height of a plane that receives the contact shadow; None for no shadow.
        supersampling: rays per pixel and axis.
        sky_rays: rays per sub-pixel that look for the sky; 0 turns occlusion and shadow off.

    Returns:
        (height, width, 3) uint8, or (height, width, 4) with straight alpha if the background is transparent.
    """
    width, height = (size, size) if isinstance(size, int) else size
    if width < 1 or height < 1 or supersampling < 1 or sky_rays < 0:
        raise ValueError(f"render: size {size}, supersampling {supersampling}, sky_rays {sky_rays}; see the docstring")
    shape = (height * supersampling, width * supersampling)
    origins, directions = camera.rays(shape[1], shape[0])
    colour = np.zeros((len(origins), 3))
    alpha = np.zeros(len(origins))
    solid = [(mesh, tint) for mesh, tint in items if len(mesh.faces)]
    if solid:
        scene = _Scene(solid)
        face = scene.first_hit(origins, directions)
        hit = face >= 0
        colour[hit] = scene.shade(origins[hit], directions[hit], face[hit], camera, sky_rays)
        alpha[hit] = 1
        if ground is not None and sky_rays:
            shadow = scene.ground_shadow(origins[~hit], directions[~hit], ground)
            alpha[~hit] = shadow * _vignette(shape[1], shape[0])[~hit]
    # Averages are taken of linear, premultiplied light; a shadow is black with some alpha.
    premultiplied = np.concatenate([colour * alpha[:, None], alpha[:, None]], axis=1)
    pixels = premultiplied.reshape(height, supersampling, width, supersampling, 4).mean(axis=(1, 3))
    light, cover = pixels[..., :3], pixels[..., 3:]
    if background is not None:
        return _to_bytes(_encode(light + (1 - cover) * _decode(np.array(background))))
    straight = np.divide(light, cover, out=np.zeros_like(light), where=cover > 0)
    return _to_bytes(np.concatenate([_encode(straight), cover], axis=-1))


def voxels_to_mesh(grid: NDArray[np.bool_], fill: float = 0.9) -> trimesh.Trimesh:
    """One cube per occupied voxel of a (32, 32, 32) grid: metres, in the frame of the grid.

    Args:
        fill: edge of a cube in voxel edges; below 1 the gaps show the grid.
    """
    cells = np.argwhere(np.asarray(grid, dtype=bool))
    if grid.shape != (GRID_SIZE,) * 3:
        raise ValueError(f"voxels_to_mesh: shape {grid.shape}, expected {(GRID_SIZE,) * 3}")
    cube = trimesh.creation.box(extents=[fill * VOXEL_EDGE] * 3)
    centres = WORKSPACE_LOW + VOXEL_EDGE * (cells + 0.5)
    vertices = (centres[:, None] + cube.vertices[None]).reshape(-1, 3)
    faces = (8 * np.arange(len(cells))[:, None, None] + cube.faces[None]).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)


class _Scene:
    """All items as one mesh with a colour per face and a normal per corner."""

    def __init__(self, items: Sequence[tuple[trimesh.Trimesh, Colour]]) -> None:
        meshes = [trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh, _ in items]
        self._colour = _decode(np.repeat([tint for _, tint in items], [len(mesh.faces) for mesh in meshes], axis=0))
        corners = [mesh.vertex_normals[mesh.faces] for mesh in meshes]
        self._triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes])
        self._normal = face_normals(self._triangles)
        smooth = np.concatenate(corners)
        sharp = np.einsum("fci,fi->fc", smooth, self._normal) < _CREASE
        self._corner = np.where(sharp[..., None], self._normal[:, None], smooth)
        vertices = self._triangles.reshape(-1, 3)
        self._step = 1e-4 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        mesh = trimesh.Trimesh(vertices, np.arange(len(vertices)).reshape(-1, 3), process=False)
        tracer = trimesh.ray.ray_pyembree if trimesh.ray.has_embree else trimesh.ray.ray_triangle
        self._rays = tracer.RayMeshIntersector(mesh)

    def first_hit(self, origins: NDArray, directions: NDArray) -> NDArray[np.int64]:
        """Index of the first face each ray hits, -1 for none."""
        return np.asarray(self._rays.intersects_first(origins, directions), dtype=np.int64)

    def shade(self, origins: NDArray, directions: NDArray, face: NDArray, camera: Camera, sky_rays: int) -> NDArray:
        """Linear colour of the points where rays hit ``face``."""
        triangle, normal = self._triangles[face], self._normal[face]
        along = np.einsum("ij,ij->i", directions, normal)
        depth = np.einsum("ij,ij->i", triangle[:, 0] - origins, normal) / np.where(np.abs(along) < 1e-12, 1e-12, along)
        point = origins + depth[:, None] * directions
        shading = np.einsum("ic,icj->ij", _barycentric(triangle, point), self._corner[face])
        shading /= np.maximum(np.linalg.norm(shading, axis=1, keepdims=True), 1e-30)
        away = along > 0  # the inside of a surface that is not closed
        shading[away], normal = -shading[away], np.where(away[:, None], -normal, normal)

        axes = camera.axes()
        key = np.array(_KEY) @ axes / np.linalg.norm(_KEY)
        diffuse = np.clip(shading @ key * 0.8 + 0.2, 0, None)  # wrapped a little past the terminator
        sky = 0.75 + 0.25 * shading[:, 2]  # brighter from above
        sky *= self._openness(point + self._step * normal, shading, sky_rays)
        half = (key - directions) / np.linalg.norm(key - directions, axis=1, keepdims=True)
        gloss = 0.10 * np.clip(np.einsum("ij,ij->i", shading, half), 0, 1) ** 40
        light = _KEY_STRENGTH * diffuse + _SKY_STRENGTH * sky
        return self._colour[face] * light[:, None] + gloss[:, None]

    def ground_shadow(self, origins: NDArray, directions: NDArray, ground: float) -> NDArray:
        """Alpha of the shadow where rays that hit nothing meet the plane z = ground.

        The shadow is smooth, so it is computed on a coarse net on the plane and interpolated.
        """
        box = self._triangles.reshape(-1, 3)
        reach = 0.6 * float(np.ptp(box, axis=0).max())
        low, high = box.min(axis=0)[:2] - reach, box.max(axis=0)[:2] + reach
        axes = [np.linspace(low[k], high[k], _SHADOW_NET) for k in range(2)]
        net = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        points = np.column_stack([net, np.full(len(net), ground + self._step)])
        blocked = 1 - self._openness(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape), _SHADOW_RAYS)
        blocked = gaussian_filter(blocked.reshape(_SHADOW_NET, _SHADOW_NET), 0.7)

        down = directions[:, 2] < -1e-6
        depth = np.where(down, (ground - origins[:, 2]) / np.where(down, directions[:, 2], -1), 0)
        index = (origins[:, :2] + depth[:, None] * directions[:, :2] - low) / (high - low) * (_SHADOW_NET - 1)
        shadow = map_coordinates(blocked, index.T, order=1, mode="constant", cval=0.0)
        return _SHADOW_STRENGTH * np.where(down & (depth > 0), shadow, 0)

    def _openness(self, points: NDArray, normals: NDArray, count: int) -> NDArray:
        """Cosine-weighted share of the sky that points (M, 3) with unit normals see."""
        if count == 0 or len(points) == 0:
            return np.ones(len(points))
        turn = np.random.default_rng(0).random(len(points))  # turned per point: grain instead of bands
        reference = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        tangent = np.cross(reference, normals)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        bitangent = np.cross(normals, tangent)
        open_rays = np.zeros(len(points))
        for k in range(count):
            radius = math.sqrt((k + 0.5) / count)
            angle = 2 * math.pi * (k * 0.618033988749895 + turn)
            directions = radius * (np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * bitangent)
            directions += math.sqrt(1 - radius * radius) * normals
            open_rays += self.first_hit(points, directions) < 0
        return open_rays / count


def _vignette(width: int, height: int) -> NDArray[np.float64]:
    """(width * height,) from 0 at the picture's border to 1 at an eighth of its size from it: no shadow is cut off."""
    across, down = (np.clip(8 * (0.5 - np.abs((np.arange(n) + 0.5) / n - 0.5)), 0, 1) for n in (width, height))
    weight = np.outer(down, across).reshape(-1)
    return weight * weight * (3 - 2 * weight)


def _barycentric(triangle: NDArray, point: NDArray) -> NDArray:
    """Weights (M, 3) of the corners of ``triangle`` (M, 3, 3) at ``point`` (M, 3), clipped to the triangle."""
    a, b, p = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0], point - triangle[:, 0]
    aa, ab, bb = (np.einsum("ij,ij->i", x, y) for x, y in ((a, a), (a, b), (b, b)))
    pa, pb = np.einsum("ij,ij->i", p, a), np.einsum("ij,ij->i", p, b)
    determinant = np.maximum(aa * bb - ab * ab, 1e-30)
    v, w = (bb * pa - ab * pb) / determinant, (aa * pb - ab * pa) / determinant
    weights = np.clip(np.stack([1 - v - w, v, w], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def _decode(srgb: NDArray) -> NDArray[np.float64]:
    """sRGB in [0, 1] -> linear light."""
    srgb = np.asarray(srgb, dtype=np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _encode(light: NDArray) -> NDArray[np.float64]:
    """Linear light, clipped to [0, 1] -> sRGB."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _to_bytes(values: NDArray) -> NDArray[np.uint8]:
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
