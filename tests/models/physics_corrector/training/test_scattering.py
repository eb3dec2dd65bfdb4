from dataclasses import replace

import torch

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.scattering import scatter
from tests.models.physics_corrector.training.training_scenes import rows, with_fixed

CUBE, ON_CUBE = 0, 1


def batch(count: int = 200) -> LayoutBatch:
    return rows(1).take(torch.zeros(count, dtype=torch.int64))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_things_are_anywhere_on_the_table_and_face_any_way() -> None:
    scenes = batch()
    poses = scatter(scenes, generator())
    xy = poses[..., :2][scenes.mask]
    assert (xy >= 0).all()
    assert (xy <= scenes.table[0]).all()
    spread = poses[:, CUBE, :2].std(0) / scenes.table[0]
    assert (spread > 0.2).all()
    assert poses[:, CUBE, 3].std() > 1.5
    assert torch.equal(poses[..., 2], scenes.poses[..., 2])


def test_what_is_carried_stays_on_its_carrier() -> None:
    scenes = batch()
    poses = scatter(scenes, generator())
    apart = (poses[:, ON_CUBE, :2] - poses[:, CUBE, :2]).norm(dim=1)
    before = (scenes.poses[:, ON_CUBE, :2] - scenes.poses[:, CUBE, :2]).norm(dim=1)
    torch.testing.assert_close(apart, before, atol=1e-5, rtol=0)
    turned = torch.remainder((poses - scenes.poses)[:, [CUBE, ON_CUBE], 3], 2 * torch.pi)
    torch.testing.assert_close(turned[:, 0].cos(), turned[:, 1].cos(), atol=1e-4, rtol=0)


def test_bodies_find_room() -> None:
    scenes = batch()
    poses = scatter(scenes, generator())
    roots = scenes.mask & (scenes.parent == -1)
    radius = scenes.sizes[..., :2].mean(-1) / 2
    apart = torch.cdist(poses[..., :2], poses[..., :2]) - radius[:, None] - radius[:, :, None]
    pairs = (roots[:, None] & roots[:, :, None]).triu(1)
    assert float((apart[pairs] < 0).float().mean()) < 0.02


def test_fixed_bodies_and_padding_stay() -> None:
    scenes = with_fixed(batch(), ON_CUBE)  # a body with a fixed object is fixed
    poses = scatter(scenes, generator())
    assert torch.equal(poses[:, [CUBE, ON_CUBE]], scenes.poses[:, [CUBE, ON_CUBE]])
    assert torch.equal(poses[~scenes.mask], scenes.poses[~scenes.mask])
    zone = replace(
        scenes, zone=torch.tensor([[0.3, 0.9, 0.2, 0.6]]).expand(len(scenes), 4), has_zone=torch.ones_like(scenes.has_zone)
    )
    inside = scatter(zone, generator())[:, 2, :2]
    is_in = ((inside > torch.tensor([0.35, 0.25])) & (inside < torch.tensor([0.85, 0.55]))).all(1)
    assert float(is_in.float().mean()) < 0.05
