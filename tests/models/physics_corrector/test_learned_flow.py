"""The learned flow as the corrector calls it: scenes in, scenes out, weights that belong together."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.correction import CorrectionOptions, KnownShapes, shapes_by_instance
from models.physics_corrector.certify.flow_start import certify_moved, choose_start
from models.physics_corrector.corrector import PhysicsCorrector, Purpose
from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.physics_corrector.flow.expected_error import ExpectedError
from models.physics_corrector.learned_flow import LearnedFlow, load_flow, weights_fingerprint
from models.physics_corrector.scene_reading import known_directions
from models.point_encoder import PointEncoder
from models.point_encoder import save as save_encoder
from models.text_encoder import load_default as load_text_encoder
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.metrics.movement import movement
from stable_data.scene import Relation, RelationKind, Scene, TaskInfo
from tests.models.physics_corrector.certify.things import box, cylinder, laid
from tests.models.physics_corrector.flow.conditions import awake_network, small_settings
from tests.models.point_encoder.clouds import tiny_encoder
from tests.torch_threads import torch_threads

CUP, BOOK = cylinder(0.04, 0.1), box(0.15, 0.2, 0.03)
FREE: frozenset[str] = frozenset()


@pytest.fixture(scope="module")
def encoder() -> PointEncoder:
    return tiny_encoder()


@pytest.fixture
def weights(encoder: PointEncoder, tmp_path: Path) -> Path:
    """A network that was never trained, whose head is awake, with the encoder beside it."""
    settings = small_settings("set_transformer")
    settings = replace(settings, network=replace(settings.network, num_features=64, num_texts=384))
    path = tmp_path / "physics_corrector.safetensors"
    notes = {"encoder_fingerprint": encoder.fingerprint(), "text_encoder_fingerprint": load_text_encoder().fingerprint}
    save_corrector(path, settings, awake_network(settings).state_dict(), notes)
    save_encoder(encoder, path.with_name("point_encoder.safetensors"))
    return path


def two_scenes() -> tuple[list[Scene], list[list[Shape]]]:
    first, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0), ("c", BOOK, 0.2, 0.2, 0.0))
    second, others = laid(("d", BOOK, 0.3, 0.3, 0.0))
    return [first, second], [list(shapes), list(others)]


def moved_by(
    flow: LearnedFlow | None, scenes: list[Scene], shapes: list[list[Shape]], fixed: frozenset[str] = FREE
) -> list[Scene]:
    """The moved scenes, none of which is lost; the objects of the first one may be fixed."""
    assert flow is not None
    found = [scene for scene in flow(scenes, shapes, [fixed, *[FREE] * (len(scenes) - 1)][: len(scenes)]) if scene is not None]
    assert len(found) == len(scenes)
    return found


def known(scenes: list[Scene], shapes: list[list[Shape]]) -> KnownShapes:
    named = [shapes_by_instance(*pair) for pair in zip(scenes, shapes, strict=False)]
    return KnownShapes({name: shape for one in named for name, shape in one.items()})


def test_what_is_fixed_stays_bit_for_bit_and_the_rest_moves(weights: Path) -> None:
    scenes, shapes = two_scenes()
    first, _ = moved_by(load_flow(str(weights)), scenes, shapes, frozenset({"b"}))
    assert first["b"] == scenes[0]["b"]
    assert all(first[name].position != scenes[0][name].position for name in ("a", "c"))
    assert [o.instance for o in first.objects] == ["a", "b", "c"]


def test_a_scene_comes_out_as_it_would_alone(weights: Path) -> None:
    flow, (scenes, shapes) = load_flow(str(weights)), two_scenes()
    together = moved_by(flow, scenes, shapes)
    alone = [moved_by(flow, [scene], [own])[0] for scene, own in zip(scenes, shapes, strict=True)]
    for one, other in zip(together, alone, strict=True):
        assert one.poses() == pytest.approx(other.poses(), abs=1e-5)


def test_the_number_of_threads_changes_no_bit(rng: np.random.Generator) -> None:
    scenes, shapes = list[Scene](), list[list[Shape]]()
    for _ in range(7):  # products of this size are split among threads
        things = [(f"o_{n}", (CUP, BOOK)[n % 2], *rng.uniform(0.1, 0.7, 2).tolist(), 0.0) for n in range(8)]
        scene, own = laid(*things)
        scenes.append(scene)
        shapes.append(list(own))
    found = []
    for num_threads in (1, 2):
        with torch_threads(num_threads):
            found.append([moved.poses().tobytes() for moved in moved_by(load_flow(), scenes, shapes)])
    assert found[0] == found[1]


def test_more_steps_give_another_result(weights: Path) -> None:
    scenes, shapes = two_scenes()
    few, many = (moved_by(load_flow(str(weights), steps), scenes, shapes)[0].poses() for steps in (1, 16))
    assert not np.allclose(few, many)


def test_empty_scenes_come_back(weights: Path) -> None:
    flow = load_flow(str(weights))
    assert flow is not None
    empty = replace(two_scenes()[0][0], objects=())
    assert flow([empty], [[]], [FREE]) == [empty]
    assert flow([], [], []) == []


def test_features_of_another_encoder_are_refused(weights: Path) -> None:
    read = load_corrector(weights)
    other = tiny_encoder(preprocessing=replace(tiny_encoder().preprocessing, num_points=64))
    for encoder in (other, None):
        with pytest.raises(ConfigError, match="was trained on the features of encoder") as caught:
            LearnedFlow(read, encoder, load_text_encoder())
        assert caught.value.code == "encoder_mismatch"
    with pytest.raises(ConfigError, match="was trained on the features of text encoder"):
        LearnedFlow(read, tiny_encoder())


def test_another_number_of_features_is_refused(weights: Path, encoder: PointEncoder) -> None:
    read = load_corrector(weights)
    fewer = replace(read.settings, network=replace(read.settings.network, num_features=32))
    with pytest.raises(ConfigError, match="reads 32 point features per object, expected 64 or none"):
        LearnedFlow(replace(read, settings=fewer), encoder)


def test_what_cannot_be_reckoned_with_has_no_result_and_harms_no_other(weights: Path) -> None:
    scenes, shapes = two_scenes()
    x, y, z = scenes[0]["a"].position
    lost = replace(scenes[0], objects=(scenes[0]["a"].moved((x + 1e30, y, z), 0.0), *scenes[0].objects[1:]))
    flow = load_flow(str(weights))
    assert flow is not None
    nothing, moved = flow([lost, scenes[1]], [shapes[0], shapes[1]], [FREE, FREE])
    assert nothing is None
    assert moved is not None
    assert moved.poses() == pytest.approx(moved_by(flow, scenes[1:], shapes[1:])[0].poses(), abs=1e-5)
    (done,) = PhysicsCorrector(flow).correct([lost], known([lost], shapes))
    assert done.raw is None
    assert (done.status, done.reason) == (
        "infeasible",
        "the exact audit refuses objects that cannot be moved: a is off its area",
    )


def test_more_objects_than_a_network_was_trained_on(weights: Path) -> None:
    rng = np.random.default_rng(0)
    things = [(f"o_{n}", (CUP, BOOK)[n % 2], *rng.uniform(0.0, 4.0, 2).tolist(), 0.0) for n in range(200)]
    scene, shapes = laid(*things, size=(4.0, 4.0))
    (moved,) = moved_by(load_flow(str(weights), 1), [scene], [list(shapes)])
    assert (moved.poses() != scene.poses()).any(axis=1).all()


def test_none_is_no_flow() -> None:
    assert load_flow("none") is None
    assert weights_fingerprint("none") == "none"


def test_the_fingerprint_is_of_both_files(weights: Path) -> None:
    before = weights_fingerprint(str(weights))
    assert before == weights_fingerprint(str(weights))
    beside = weights.with_name("point_encoder.safetensors")
    beside.write_bytes(beside.read_bytes() + b" ")
    assert weights_fingerprint(str(weights)) != before
    with pytest.raises(ConfigError, match="no such file"):
        weights_fingerprint(str(weights.with_name("nothing")))


def test_raw_and_certified_stand_side_by_side(weights: Path) -> None:
    scenes, shapes = two_scenes()
    corrections = PhysicsCorrector(load_flow(str(weights))).correct(scenes, known(scenes, shapes))
    for scene, done in zip(scenes, corrections, strict=True):
        assert done.start is scene
        assert done.raw is not None
        assert done.card_raw is not None
        assert done.certified is not None
        assert done.card_after is not None
        assert done.card_after.clean
        assert done.card_after.move_mean_mm == movement(scene, done.certified)[0]
    before = corrections[0].card_before
    assert before is not None
    assert before.num_collisions == 1
    (alone,) = PhysicsCorrector().correct(scenes[:1], known(scenes, shapes))
    assert (alone.raw, alone.card_raw) == (None, None)
    with pytest.raises(ConfigError, match="expected an AssetStore"):
        PhysicsCorrector().correct(scenes[:1], known(scenes, shapes), CorrectionOptions(asks_engine=True))


def test_a_clean_scene_stays_as_it_is_although_the_flow_moves_it(weights: Path) -> None:
    scenes, shapes = two_scenes()
    done = PhysicsCorrector(load_flow(str(weights))).correct(scenes, known(scenes, shapes))[1]
    assert done.raw is not None
    assert movement(scenes[1], done.raw)[0] > 5  # millimetres: the flow does propose another place
    assert done.certified is not None
    assert np.array_equal(done.certified.poses(), scenes[1].poses())


def test_movement_of_objects_that_are_still_there() -> None:
    scene = two_scenes()[0][0]
    a, b, _ = scene.objects
    x, y, z = a.position
    after = replace(scene, objects=(a.moved((x + 0.03, y + 0.04, z), a.yaw + np.pi + 0.1), b))
    mean, farthest, turn = movement(scene, after)
    assert [mean, farthest] == pytest.approx([25.0, 50.0])
    assert turn == pytest.approx(180 - np.degrees(0.1))
    assert movement(scene, replace(scene, objects=())) == (0.0, 0.0, 0.0)


def test_certify_begins_where_the_flow_ended_if_that_is_farther_than_its_error() -> None:
    (scene, _), _ = two_scenes()
    assert choose_start(scene, None) is scene
    for shift, begins_anew in (
        ((0.004, 0.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.1, 2 * np.pi), False),  # heights are found exactly, and a whole turn is none
        ((0.004, 0.004, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0, -0.1), True),
    ):
        poses = scene.poses()
        poses[1] += shift
        begin = choose_start(scene, scene.with_poses(poses))
        assert (begin is not scene) == begins_anew
        assert begin.poses() == pytest.approx(poses if begins_anew else scene.poses())
    empty = replace(scene, objects=())
    assert choose_start(empty, replace(empty)) is empty


def test_what_would_change_sides_goes_back_with_what_it_carries() -> None:
    scene, _ = laid(
        ("left", CUP, 0.2, 0.3, 0.0), ("right", BOOK, 0.4, 0.3, 0.0), ("far", CUP, 0.4, 0.5, 0.0), ("top", CUP, 0.41, 0.31, 0.1)
    )
    scene = replace(
        scene, objects=tuple(replace(o, support="right" if o.instance == "top" else "table") for o in scene.objects)
    )
    poses = scene.poses()
    poses[0, 0] += 0.03  # stays to the left
    poses[1, 0] -= 0.3  # goes past it
    poses[3, 0] -= 0.28
    begin = choose_start(scene, scene.with_poses(poses)).poses()
    assert begin[0] == pytest.approx(poses[0])
    assert begin[1:] == pytest.approx(scene.poses()[1:])


def test_where_the_flow_leaves_no_room_the_layout_itself_decides() -> None:
    scene, shapes = laid(("one", BOOK, 0.08, 0.11, 0.0), ("other", BOOK, 0.235, 0.11, 0.0), size=(0.32, 0.22))
    raw = scene.with_poses(scene.poses() + np.array([0.0, 0.0, 0.0, np.pi / 4]))  # turned so, none has room
    done, _ = certify_moved(scene, raw, shapes)
    assert done.status is CorrectionStatus.CERTIFIED
    assert not done.dropped


def test_a_scene_does_not_depend_on_what_was_met_before(weights: Path) -> None:
    scenes, shapes = two_scenes()
    fresh, used = load_flow(str(weights)), load_flow(str(weights))
    moved_by(used, scenes[1:], shapes[1:])
    assert moved_by(used, scenes[:1], shapes[:1]) == moved_by(fresh, scenes[:1], shapes[:1])


def test_a_rearrangement_takes_all_moves_of_the_flow_and_keeps_what_the_task_states() -> None:
    """A flow that exchanges two things: a repair takes it back, because it breaks a direction; a rearrangement does not."""
    scene, shapes = laid(("a", CUP, 0.2, 0.3, 0.0), ("b", CUP, 0.5, 0.3, 0.0))

    def exchange(scenes: Sequence[Scene], _: object, __: object) -> list[Scene]:
        return [s.with_poses(s.poses()[::-1].copy()) for s in scenes]

    def corrected(start: Scene, purpose: Purpose) -> Scene:
        (done,) = PhysicsCorrector(exchange, purpose=purpose).correct([start], known([start], [list(shapes)]))
        assert done.certified is not None
        assert done.card_after is not None
        assert done.card_after.clean
        return done.certified

    assert corrected(scene, "repair") == scene
    assert corrected(scene, "rearrange").poses()[:, 0] == pytest.approx([0.5, 0.2])
    stated = TaskInfo("a kitchen", "cup a is left of cup b", relations=(Relation("a", RelationKind.LEFT_OF, "b"),))
    kept = corrected(replace(scene, task=stated), "rearrange")
    assert kept["a"].position[0] < kept["b"].position[0]


def test_directions_that_a_task_states_reach_the_network() -> None:
    scene, _ = laid(("a", CUP, 0.2, 0.3, 0.0), ("b", CUP, 0.5, 0.3, 0.0))
    stated = TaskInfo("a kitchen", "cup a is left of cup b", relations=(Relation("a", RelationKind.LEFT_OF, "b"),))
    order = known_directions([scene, replace(scene, task=stated)], 3)
    assert order.shape == (2, 3, 3, 2)
    assert not order[0].any()
    assert order[1, 0, 1].tolist() == [1.0, 0.0]  # b is farther along x than a
    assert order[1, 1, 0].tolist() == [-1.0, 0.0]


def test_expected_errors_change_the_result(weights: Path) -> None:
    scenes, shapes = two_scenes()
    errors = (ExpectedError(), ExpectedError(0.01, 0.1), ExpectedError(0.1, 0.1))
    results = [moved_by(load_flow(str(weights), error=e), scenes[:1], shapes[:1])[0].poses() for e in errors]
    assert not np.allclose(results[0], results[1])
    assert not np.allclose(results[1], results[2])
