"""How much memory PhysX needs on a GPU for so many hands and hulls. Numbers only: no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from tslam_bench.errors import InvalidInputError

HAND_SHAPES: Final = 37
"""Collision shapes of the hand: capsules, the spheres in their far ends, boxes."""
CONTACTS_PER_PAIR: Final = 6
"""Contact points that PhysX keeps for one pair of convex shapes, at most."""
TOUCHING_PAIRS: Final = 64
"""Pairs (hand shape, hull) within the contact offset of one hand at a time: docs/gpu.md states what was measured."""
LARGEST_MEMORY: Final = 2**31 - 1
"""PhysX counts contacts, patches and pairs in 32 bits."""


@dataclass(frozen=True)
class GpuMemory:
    """The sizes that ``sapien.physx.set_gpu_memory_config`` takes; contacts, patches and pairs are counts, the rest bytes."""

    max_rigid_contact_count: int
    max_rigid_patch_count: int
    found_lost_pairs_capacity: int
    temp_buffer_capacity: int
    heap_capacity: int
    collision_stack_size: int


def gpu_memory(num_envs: int, hulls: int) -> GpuMemory:
    """Sizes for ``num_envs`` hands on objects of at most ``hulls`` hulls each.

    * patches: ``num_envs * min(HAND_SHAPES * (hulls + 1), TOUCHING_PAIRS)``, one per touching pair (the table is one shape more);
    * contacts: ``CONTACTS_PER_PAIR`` times that;
    * found and lost pairs: ``2 * num_envs * HAND_SHAPES * (hulls + 1)``, all pairs appearing and vanishing in one step;
    * each rounded up to a power of two and not below ManiSkill's defaults, which small scenes keep;
    * collision stack: 256 bytes for each touching pair (an estimate); heap and temporary buffer: ManiSkill's defaults,
      doubled with each doubling of the environments above 1,024.

    Raises:
        InvalidInputError: PhysX cannot count that many.
    """
    pairs = HAND_SHAPES * (hulls + 1)
    touching = num_envs * min(pairs, TOUCHING_PAIRS)
    growth = _power_of_two(max(1, -(-num_envs // 1024)))
    sizes = GpuMemory(
        max_rigid_contact_count=max(2**19, _power_of_two(CONTACTS_PER_PAIR * touching)),
        max_rigid_patch_count=max(2**18, _power_of_two(touching)),
        found_lost_pairs_capacity=max(2**25, _power_of_two(2 * num_envs * pairs)),
        temp_buffer_capacity=2**24 * growth,
        heap_capacity=2**26 * growth,
        collision_stack_size=max(2**22, _power_of_two(256 * touching)),
    )
    if max(vars(sizes).values()) > LARGEST_MEMORY:
        raise InvalidInputError(
            f"num_envs {num_envs}: with {hulls} hulls an object PhysX would need more than 2^31 entries in one of its "
            "buffers; use fewer environments"
        )
    return sizes


def _power_of_two(value: int) -> int:
    """The smallest power of two that is at least ``value``."""
    return 1 << max(0, value - 1).bit_length()
