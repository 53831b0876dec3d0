"""The start of an episode tells nothing of the object (protocol section 3)."""

import numpy as np
import pytest

from tslam_bench.constants import NUM_POSES, WORKSPACE_EDGE
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.skin import build_skin
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.engine.starts import StartSampler
from tslam_bench.episodes import episode_seed
from tslam_bench.hand_constants import START_ARM_HIGH, START_ARM_LOW
from tslam_bench.objects import splits
from tslam_bench.objects.hand import load_hand

PREPARED = [name for name in splits.OBJECTS if name in splits.prepared_names("test")]
"""All 50 test objects where the whole split is prepared; the quick ones and a few more on a fresh machine."""


@pytest.mark.slow
def test_equal_pose_and_seed_give_the_same_first_observation_for_all_test_objects():
    assert len(PREPARED) >= 5
    batch = HandBatch(4, BatchSettings(objects=tuple(PREPARED), split="test"))
    arrays = batch.arrays
    first: dict[tuple[int, int], dict[str, bytes]] = {}
    for index, name in enumerate(PREPARED):
        poses = [(index + offset) % NUM_POSES for offset in (0, 3, 4, 5)]
        seeds = [episode_seed(pose, seed) for pose, seed in zip(poses, (0, 1, 2, 0), strict=True)]
        batch.reset(seeds, range(4), [name] * 4, poses)  # raises where the object touches the hand
        for env, key in enumerate(zip(poses, (0, 1, 2, 0), strict=True)):
            seen = {entry: arrays[entry][env].tobytes() for entry in OBSERVATION_ARRAYS}
            assert first.setdefault(key, seen) == seen, f"{name}, pose {key[0]}, seed {key[1]}"
    assert len({seen["qpos"] for seen in first.values()}) == len(first)


def test_the_start_box_is_clear_of_everything_that_the_gates_allow():
    """No point of the hand's shapes is below the top of W, in the corners of the box and in 200 draws."""
    hand = load_hand()
    sampler = StartSampler(PREPARED[0], None, "test")
    rng = np.random.RandomState(0)
    starts = [sampler.draw(rng).qpos for _ in range(200)]
    heights = np.array(starts)[:, 1]
    assert heights.min() >= START_ARM_LOW[1] and heights.max() <= START_ARM_HIGH[1]
    assert heights.min() < START_ARM_LOW[1] + 1e-3 and heights.max() > START_ARM_HIGH[1] - 1e-3
    batch = HandBatch(1, BatchSettings(object=PREPARED[0], split="test"))
    points = build_skin(hand.shapes).volume
    lowest = []
    for seed in range(40):
        batch.reset([seed], [0])
        matrices = batch._links[0][points.link].astype(np.float64)
        world = np.einsum("pij,pj->pi", matrices[:, :, :3], points.position) + matrices[:, :, 3]
        lowest.append(world[:, 2].min())
    assert min(lowest) > WORKSPACE_EDGE / 2


def test_objects_are_found_in_whatever_split_has_them():
    sampler = StartSampler(None, ["mug"], None)
    assert sampler.load("mug").split == "test" and sampler.load("coffeemug").name == "mug"
    train = splits.prepared_names("train")
    if train:
        assert sampler.load(train[0]).split == "train"
