"""Touch and coverage against closed forms and brute force; compiled loops against tensors; one environment against many."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from tslam_bench import grids
from tslam_bench.constants import TOUCH_DISTANCE
from tslam_bench.engine.field_atlas import FieldAtlas
from tslam_bench.engine.sensing import MAX_NEW_CONTACTS, Contacts, Sensing
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.sensing_torch import TorchSensing
from tslam_bench.engine.skin import Skin, build_skin
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import SignedDistanceField

RADIUS, OFFSET = 0.05, np.array([0.02, -0.01, 0.015])


def sphere_field(radius: float = RADIUS, spacing: float = 1.5e-3, centre: np.ndarray = OFFSET) -> SignedDistanceField:
    """Signed distance to a sphere off the object's origin, so that a wrong turn shows; float16 as prepared fields are."""
    reach = radius + 0.02
    axis = np.arange(-reach, reach + spacing, spacing)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = (np.linalg.norm(grid, axis=-1) - radius).astype(np.float16).astype(np.float32)
    return SignedDistanceField(centre + axis[0], spacing, values, 0.0)


@pytest.fixture(scope="module")
def skin():
    return build_skin(load_hand().shapes)


def random_links(generator: np.random.Generator, num_envs: int) -> np.ndarray:
    """(E, L, 3, 4): links scattered around the sphere, some touching, some inside, some outside W."""
    shape = (num_envs, len(SKIN_LINKS))
    rotation = Rotation.random(int(np.prod(shape)), random_state=np.random.RandomState(generator.integers(1 << 30)))
    matrices = np.zeros((*shape, 3, 4), dtype=np.float32)
    matrices[..., :3] = rotation.as_matrix().reshape(*shape, 3, 3)
    direction = generator.normal(size=(*shape, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    matrices[..., 3] = direction * generator.uniform(0.02, 0.16, (*shape, 1))
    return matrices


class OnTensors:
    """:class:`TorchSensing` on CPU tensors, behind the numpy interface of :class:`CompiledSensing`."""

    def __init__(self, num_envs: int, skin: Skin) -> None:
        self.sensing = TorchSensing(num_envs, skin, "cpu")
        self.set_object, self.begin = self.sensing.set_object, self.sensing.begin

    def step(self, link_matrices: np.ndarray, step: np.ndarray) -> Contacts:
        contacts = self.sensing.step(torch.from_numpy(link_matrices), torch.from_numpy(step))
        return Contacts(**{name: getattr(contacts, name).numpy() for name in CONTACTS})

    def link_touch(self) -> np.ndarray:
        return self.sensing.link_touch().numpy()

    @property
    def touched(self) -> np.ndarray:
        return self.sensing.touched.numpy()

    @property
    def visited(self) -> np.ndarray:
        return self.sensing.visited.numpy()

    @property
    def touched_step(self) -> np.ndarray:
        return self.sensing.touched_step.numpy()


KINDS = [OnTensors, CompiledSensing]
CONTACTS = ("on", "new", "points", "mask", "new_touched", "new_visited")


def put(sensing, poses, fields):
    for env, (pose, (name, field)) in enumerate(zip(poses, fields, strict=True)):
        sensing.set_object(env, name, field, pose)
    sensing.begin(range(len(poses)))
    return sensing


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pose", range(8))
def test_touch_and_contact_points_on_a_sphere(skin, pose, kind):
    sensing = put(kind(1, skin), [pose], [("sphere", sphere_field())])
    centre = grids.pose_rotation(pose) @ OFFSET
    matrices = random_links(np.random.default_rng(pose), 1)
    contacts = sensing.step(matrices, np.array([1]))
    placed = np.einsum("pij,pj->pi", matrices[0, skin.probes.link][:, :, :3], skin.probes.position)
    placed = placed + matrices[0, skin.probes.link][:, :, 3]
    gap = np.linalg.norm(placed - centre, axis=1) - RADIUS - skin.probes.radius
    clear = np.abs(gap - TOUCH_DISTANCE) > 0.1e-3  # the field's own error is about h^2 / (8 R) = 6 um
    assert clear.mean() > 0.9 and contacts.on[0].sum() > 5
    np.testing.assert_array_equal(contacts.on[0][clear], (gap <= TOUCH_DISTANCE)[clear])
    points = contacts.points[0][contacts.mask[0]]
    deep = np.linalg.norm(points - centre, axis=1) - RADIUS
    assert len(points) == min(MAX_NEW_CONTACTS, int(contacts.new.sum()))
    assert np.abs(deep).max() < 0.3e-3, "contact points lie on the surface"
    expected = placed[contacts.on[0]]
    expected = centre + RADIUS * (expected - centre) / np.linalg.norm(expected - centre, axis=1, keepdims=True)
    truth, found = grids.points_to_grid(expected), sensing.touched[0]
    assert (truth & found).sum() / (
        truth | found
    ).sum() > 0.75  # points near a voxel's face may fall on either side of it
    assert not (found & ~binary_dilation(truth, np.ones((3, 3, 3)))).any(), "and never further off than that"
    assert int(contacts.new_touched[0]) == int(found.sum())
    links = np.zeros(len(SKIN_LINKS), dtype=bool)
    links[skin.probes.link[contacts.on[0]]] = True
    np.testing.assert_array_equal(sensing.link_touch()[0], links)


@pytest.mark.parametrize("kind", KINDS)
def test_grids_accumulate_like_python_sets(skin, kind):
    num_envs, generator = 3, np.random.default_rng(5)
    sensing = put(kind(num_envs, skin), [0, 3, 6], [("sphere", sphere_field())] * num_envs)
    visited = [set() for _ in range(num_envs)]
    on_before = np.zeros((num_envs, len(skin.probes)), dtype=bool)
    touched_before = np.zeros(num_envs, dtype=int)
    for step in range(5):
        matrices = random_links(generator, num_envs)
        contacts = sensing.step(matrices, np.full(num_envs, step))
        for env in range(num_envs):
            chosen = matrices[env, skin.volume.link]
            world = np.einsum("pij,pj->pi", chosen[:, :, :3], skin.volume.position) + chosen[:, :, 3]
            cells = {tuple(v) for v in np.argwhere(grids.points_to_grid(world))}
            assert abs(int(contacts.new_visited[env]) - len(cells - visited[env])) <= 2  # float32 at a voxel's face
            visited[env] |= cells
            assert abs(int(sensing.visited[env].sum()) - len(visited[env])) <= 4
            count = int(sensing.touched[env].sum())
            assert int(contacts.new_touched[env]) == count - touched_before[env]
            assert int((sensing.touched_step[env] == step).sum()) == count - touched_before[env]
            touched_before[env] = count
        np.testing.assert_array_equal(contacts.new, contacts.on & ~on_before)
        on_before = contacts.on
    np.testing.assert_array_equal(sensing.touched, sensing.touched_step >= 0)
    sensing.begin([1])
    assert sensing.touched[1].sum() == sensing.visited[1].sum() == 0 and (sensing.touched_step[1] == -1).all()
    assert sensing.touched[0].sum() == touched_before[0], "the others keep their grids"


def assert_same(a: Contacts, b: Contacts, envs: slice = slice(None), exact: bool = False) -> None:
    """Equal touch, counts and masks; contact points to a float32's last bit, where the libraries may round differently."""
    for name in CONTACTS:
        first, second = getattr(a, name)[envs], getattr(b, name)
        if name == "points" and not exact:
            np.testing.assert_allclose(first, second, atol=3e-8)
        else:
            np.testing.assert_array_equal(first, second, err_msg=name)


def test_compiled_loops_agree_with_tensors(skin):
    """Random links and fields, several episodes: every output and every grid; a saved state goes on as the original."""
    num_envs, generator = 6, np.random.default_rng(9)
    poses = [0, 2, 5, 7, 1, 4]
    fields = [("large", sphere_field(0.06, 2e-3)), ("small", sphere_field(0.03, 1.5e-3))]
    chosen = [fields[env % 2] for env in range(num_envs)]
    occupancy = np.zeros((num_envs, 2, 32, 32, 32), dtype=np.uint8)
    tensors = put(OnTensors(num_envs, skin), poses, chosen)
    compiled = put(CompiledSensing(num_envs, skin, occupancy), poses, chosen)
    restored: list[Sensing] = []
    felt = 0
    for step in range(12):
        if step == 7:
            for sensing in (tensors, compiled):
                sensing.begin([1, 4])
        if step == 9:
            restored = [put(TorchSensing(num_envs, skin, "cpu"), poses, chosen)]
            restored.append(put(CompiledSensing(num_envs, skin), poses, chosen))
            for sensing, saved in zip(restored, (compiled.state(), tensors.sensing.state()), strict=True):
                sensing.set_state(range(num_envs), saved)
        matrices, now = random_links(generator, num_envs), np.full(num_envs, step)
        before = compiled.touched.copy()
        on = compiled.touches(matrices)
        np.testing.assert_array_equal(compiled.touched, before, err_msg="looking changes nothing")
        a, b = (sensing.step(matrices, now) for sensing in (compiled, tensors))
        assert_same(a, b)
        np.testing.assert_array_equal(on, a.on)
        felt += int(a.on.sum())
        for name in ("touched", "visited", "touched_step"):
            np.testing.assert_array_equal(getattr(tensors, name), getattr(compiled, name), err_msg=name)
        np.testing.assert_array_equal(tensors.link_touch(), compiled.link_touch())
        np.testing.assert_array_equal(tensors.sensing.occupancy, occupancy)
        for sensing in restored:
            on_tensors = isinstance(sensing, TorchSensing)
            c = sensing.step(*(map(torch.from_numpy, (matrices, now)) if on_tensors else (matrices, now)))
            for name in ("new", "new_touched", "new_visited"):
                np.testing.assert_array_equal(getattr(c, name), getattr(a, name), err_msg=f"restored {name}")
            np.testing.assert_array_equal(sensing.touched_step, compiled.touched_step)
    assert felt > 1000 and len(restored) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_any_batch_gives_the_same_bits(skin, kind):
    num_envs, generator = 5, np.random.default_rng(7)
    poses = [0, 2, 5, 7, 1]
    fields = [("large", sphere_field(0.06, 2e-3)), ("small", sphere_field(0.03, 1.5e-3))]
    chosen = [fields[env % 2] for env in range(num_envs)]
    batch = put(kind(num_envs, skin), poses, chosen)
    single = [put(kind(1, skin), [poses[env]], [chosen[env]]) for env in range(num_envs)]
    for step in range(1, 5):
        matrices = random_links(generator, num_envs)
        together = batch.step(matrices, np.full(num_envs, step))
        assert together.on.any(axis=1).all()
        for env in range(num_envs):
            one = slice(env, env + 1)
            assert_same(together, single[env].step(matrices[one], np.array([step])), one, exact=True)


def test_fields_come_and_go_without_growing(skin):
    """Many objects through few environments: always the field of the object at hand, in bounded memory."""
    generator = np.random.default_rng(13)
    sensing = CompiledSensing(2, skin)
    for episode in range(60):
        radii = 0.03 + 0.001 * np.array([episode % 23, (7 * episode) % 19])
        for env, radius in enumerate(radii):
            sensing.set_object(env, f"sphere{radius:.3f}", sphere_field(radius, 3e-3), 0)
        sensing.begin([0, 1])
        matrices = random_links(generator, 2)
        on = sensing.touches(matrices)
        for env, radius in enumerate(radii):
            alone = put(CompiledSensing(1, skin), [0], [("alone", sphere_field(radius, 3e-3))])
            np.testing.assert_array_equal(on[env], alone.touches(matrices[env : env + 1])[0])
    assert len(sensing.atlas.bound().values) <= (2 + FieldAtlas.SPARE_SLOTS) * sphere_field(0.053, 3e-3).values.size
