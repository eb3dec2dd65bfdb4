from dataclasses import replace

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.sampled_collision import add_sampled_collisions, num_sampled_collisions
from stable_data.scene import Scene
from tests.models.physics_corrector.certify.things import box, laid

CUBE = box(0.1, 0.1, 0.1)


def card_of(scene: Scene, shapes: list[Shape]) -> MetricCard:
    audit = audit_scene(scene, shapes)
    return add_sampled_collisions(audit.card(), scene, shapes, audit)


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_the_papers_rule_agrees_with_the_exact_one_where_objects_overlap_clearly(yaw: float) -> None:
    scene, shapes = laid(("a", CUBE, 0.3, 0.3, 0.0), ("b", CUBE, 0.36, 0.3, 0.0), ("c", CUBE, 0.7, 0.5, 0.0))
    scene = scene.with_poses(scene.poses() + np.array([[0, 0, 0, yaw], [0, 0, 0, 0], [0, 0, 0, yaw]]))
    card = card_of(scene, list(shapes))
    assert card.oc == card.oc_sdf == pytest.approx(1 / 3)
    assert num_sampled_collisions(scene, list(shapes)) == 1


def test_pairs_of_fixed_objects_count_in_no_share() -> None:
    scene, shapes = laid(("a", CUBE, 0.3, 0.3, 0.0), ("b", CUBE, 0.36, 0.3, 0.0), ("c", CUBE, 0.7, 0.5, 0.0))
    scene = replace(scene, fixed=frozenset({"b", "c"}))
    assert audit_scene(scene, shapes).num_pairs == 2
    card = card_of(scene, list(shapes))
    assert card.oc == card.oc_sdf == 0.5


def test_objects_that_are_apart_do_not_collide_and_unknown_is_no_pass() -> None:
    scene, shapes = laid(("a", CUBE, 0.3, 0.3, 0.0), ("b", CUBE, 0.5, 0.3, 0.0))
    assert card_of(scene, list(shapes)).oc_sdf == 0
    meeting, shapes = laid(("a", CUBE, 0.3, 0.3, 0.0), ("b", CUBE, 0.33, 0.3, 0.0))
    assert card_of(meeting, [shapes[0], replace(shapes[1], is_exact=False)]).oc_sdf is None


def test_floating_by_the_papers_rule_is_a_gap_over_half_a_millimetre() -> None:
    scene, shapes = laid(("a", CUBE, 0.3, 0.3, 0.0), ("b", CUBE, 0.6, 0.3, 0.0))
    poses = scene.poses() + np.array([[0, 0, 0.4e-3, 0], [0, 0, 0.7e-3, 0]])
    assert audit_scene(scene.with_poses(poses), list(shapes)).card().float_gap == pytest.approx(0.5)
