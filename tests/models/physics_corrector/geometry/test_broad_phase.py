"""The broad phase leaves exactly the pairs whose yawed boxes meet."""

import numpy as np
import shapely
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.physics_corrector.geometry.broad_phase import ObjectPairs, near_pairs


def random_boxes(seed: int, num_scenes: int = 3, num_objects: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Poses, half extents and mask of boxes of which some meet."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-0.5, 0.5, (num_scenes, num_objects, 4)) * (1, 1, 0.4, 14)
    half = rng.uniform(0.01, 0.25, (num_scenes, num_objects, 3))
    return torch.from_numpy(poses), torch.from_numpy(half), torch.from_numpy(rng.random((num_scenes, num_objects)) < 0.8)


def listed(pairs: ObjectPairs) -> list[tuple[int, int, int]]:
    """Scene, first, second of each pair."""
    return list(zip(pairs.scene.tolist(), pairs.first.tolist(), pairs.second.tolist(), strict=True))


@given(st.integers(0, 10**6))
def test_the_pairs_are_those_that_meet(seed: int) -> None:
    poses, half, mask = random_boxes(seed)
    rectangles = np.array(
        [
            [
                shapely.affinity.rotate(shapely.box(x - a, y - b, x + a, y + b), r, use_radians=True)
                for (x, y, _, r), (a, b, _) in z
            ]
            for z in (zip(p, h, strict=True) for p, h in zip(poses.tolist(), half.tolist(), strict=True))
        ]
    )
    z, tall = poses[..., 2], half[..., 2]
    expected = [
        (s, i, j)
        for s in range(len(mask))
        for i in range(mask.shape[1])
        for j in range(i + 1, mask.shape[1])
        if mask[s, i] and mask[s, j] and abs(z[s, i] - z[s, j]) <= tall[s, i] + tall[s, j]
        if shapely.intersects(rectangles[s, i], rectangles[s, j])
    ]
    assert listed(near_pairs(poses, half, mask)) == expected


def test_nothing_in_the_padding_and_nothing_that_is_not_finite_is_near() -> None:
    poses, half, mask = random_boxes(0)
    expected = listed(near_pairs(poses, half, mask))
    poses[~mask] = torch.nan
    half[~mask] = torch.inf
    assert listed(near_pairs(poses, half, mask)) == expected


def test_both_ways_lists_every_pair_from_either_side() -> None:
    pairs = near_pairs(*random_boxes(1))
    assert len(pairs) > 0
    assert listed(pairs.both_ways()) == [*listed(pairs), *((s, j, i) for s, i, j in listed(pairs))]


def test_a_scene_of_one_and_no_scene_have_no_pairs() -> None:
    assert len(near_pairs(torch.zeros(1, 1, 4), torch.ones(1, 1, 3), torch.ones(1, 1, dtype=torch.bool))) == 0
    assert len(near_pairs(torch.zeros(0, 5, 4), torch.ones(0, 5, 3), torch.ones(0, 5, dtype=torch.bool))) == 0
