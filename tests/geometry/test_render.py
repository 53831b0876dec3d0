"""Pictures against geometry: silhouettes, directions, occlusion, alpha, determinism."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tslam_bench.constants import VOXEL_EDGE
from tslam_bench.geometry.render import Camera, fit_camera, render, voxels_to_mesh
from tslam_bench.grids import points_to_grid

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
FRONT = Camera((0.0, 0.0, 0.0), azimuth=-90, elevation=0, height=0.25)


def ball(radius: float = 0.05, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(at)
    return mesh


def cover(picture: np.ndarray) -> np.ndarray:
    """Alpha in [0, 1]."""
    return picture[..., 3] / 255


def test_silhouette_of_a_sphere_has_the_area_of_its_disc() -> None:
    picture = render([(ball(), RED)], FRONT, 200, background=None, sky_rays=0)
    assert picture.shape == (200, 200, 4)
    area = cover(picture).sum() * (0.25 / 200) ** 2
    assert area == pytest.approx(np.pi * 0.05**2, rel=0.02)


def test_perspective_silhouette_of_a_sphere() -> None:
    """Seen from distance d, a sphere of radius r fills a cone of half-angle asin(r / d)."""
    camera = Camera((0.0, 0.0, 0.0), -90, 0, height=0.25, field_of_view=40)
    distance = 0.125 / np.tan(np.radians(20))
    picture = render([(ball(), RED)], camera, 200, background=None, sky_rays=0)
    radius = distance * np.tan(np.arcsin(0.05 / distance))
    assert cover(picture).sum() * (0.25 / 200) ** 2 == pytest.approx(np.pi * radius**2, rel=0.02)


@pytest.mark.parametrize(
    ("camera", "point", "row", "column"),
    [
        (FRONT, (0.08, 0, 0), 0.5, 0.82),  # from -y: x to the right
        (FRONT, (0, 0, 0.08), 0.18, 0.5),  # z up
        (Camera((0.0, 0.0, 0.0), 0, 0, 0.25), (0, 0.08, 0), 0.5, 0.82),  # from +x: y to the right
        (
            Camera((0.0, 0.0, 0.0), 0, 90, 0.25),
            (-0.08, 0, 0),
            0.18,
            0.5,
        ),  # from above: away from the camera's side is up
        (Camera((0.08, 0.0, 0.0), -90, 0, 0.25), (0.08, 0, 0), 0.5, 0.5),  # the target is in the middle
    ],
)
def test_directions(camera: Camera, point: tuple[float, float, float], row: float, column: float) -> None:
    alpha = cover(render([(ball(0.01, point), RED)], camera, 100, background=None, sky_rays=0))
    rows, columns = np.indices(alpha.shape)
    assert (rows * alpha).sum() / alpha.sum() / 100 == pytest.approx(row, abs=0.02)
    assert (columns * alpha).sum() / alpha.sum() / 100 == pytest.approx(column, abs=0.02)


def test_camera_axes_are_a_rotation() -> None:
    axes = Camera((0.0, 0.0, 0.0), 37, -20).axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_the_nearer_thing_hides_the_farther() -> None:
    items = [(ball(0.05), BLUE), (ball(0.02, (0, -0.07, 0)), RED)]
    picture = render(items, FRONT, 101, sky_rays=0).astype(int)
    middle, side = picture[50, 50], picture[50, 66]
    assert middle[0] > middle[2] and side[2] > side[0]
    assert (picture[0, 0] == 255).all()


def test_light_comes_from_above_and_crevices_are_darker() -> None:
    mesh = ball(0.08)
    bright = render([(mesh, (0.7, 0.7, 0.7))], FRONT, 80).mean(axis=2)
    assert bright[20, 40] > bright[60, 40] + 20
    # A ball in a deep cup sees less of the sky than a free one.
    cup = trimesh.creation.annulus(0.055, 0.06, 0.3)
    above = Camera((0.0, 0.0, 0.0), 0, 90, 0.1)
    free = render([(ball(), RED)], above, 40).astype(int)[20, 20, 0]
    inside = render([(ball(0.05, (0, 0, -0.1)), RED), (cup, BLUE)], above, 40).astype(int)[20, 20, 0]
    assert inside < free - 10


def test_shadow_lies_below_the_object_and_fades() -> None:
    camera = Camera((0.0, 0.0, 0.0), -90, 30, height=0.4)
    picture = render([(ball(), RED)], camera, 120, background=None, ground=-0.05)
    without = render([(ball(), RED)], camera, 120, background=None)
    shadow = cover(picture) - cover(without)
    assert shadow.max() > 0.05
    rows, _ = np.indices(shadow.shape)
    assert (rows * shadow).sum() / shadow.sum() > 60
    assert shadow[0].max() < 0.01
    assert (picture[(shadow > 0.02) & (cover(without) == 0)][:, :3] == 0).all()


def test_fitted_camera_holds_everything() -> None:
    mesh = trimesh.creation.box(extents=[0.2, 0.05, 0.1])
    mesh.apply_translation([0.3, -0.1, 0.5])
    for field_of_view in (0.0, 50.0):
        for azimuth in (-60.0, 10.0, 200.0):
            camera = fit_camera([mesh], azimuth, 30, field_of_view)
            alpha = cover(render([(mesh, RED)], camera, 60, background=None, sky_rays=0))
            border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
            assert border.max() == 0 and 0.05 < alpha.mean() < 0.9


def test_empty_scene_is_background() -> None:
    picture = render([(trimesh.Trimesh(), RED)], fit_camera([trimesh.Trimesh()]), (30, 20), background=(0.5, 0.5, 0.5))
    assert picture.shape == (20, 30, 3) and (picture == 128).all()
    assert (render([], FRONT, 8, background=None, ground=0.0) == 0).all()


def test_same_input_same_bits() -> None:
    items = [(ball(), RED), (voxels_to_mesh(points_to_grid(ball(0.08).vertices)), BLUE)]
    first, second = (render(items, FRONT, 40, background=None, ground=-0.1) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_without_embree_the_picture_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [(ball(0.05), RED), (ball(0.03, (0.06, 0, 0.02)), BLUE)]
    fast = render(items, FRONT, 24, sky_rays=2)
    monkeypatch.setattr(trimesh.ray, "has_embree", False)
    slow = render(items, FRONT, 24, sky_rays=2)
    assert np.mean(np.abs(fast.astype(int) - slow)) < 0.5


def test_voxels_to_mesh() -> None:
    grid = np.zeros((32, 32, 32), dtype=bool)
    grid[3, 4, 5] = grid[3, 4, 6] = grid[20, 0, 31] = True
    mesh = voxels_to_mesh(grid, fill=0.5)
    assert mesh.body_count == 3 and mesh.is_watertight
    assert mesh.volume == pytest.approx(3 * (0.5 * VOXEL_EDGE) ** 3)
    np.testing.assert_array_equal(points_to_grid(mesh.vertices), grid)
    assert len(voxels_to_mesh(np.zeros_like(grid)).faces) == 0
    with pytest.raises(ValueError, match="shape"):
        voxels_to_mesh(np.zeros((2, 2, 2), dtype=bool))


def test_bad_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="size"):
        render([], FRONT, 0)
