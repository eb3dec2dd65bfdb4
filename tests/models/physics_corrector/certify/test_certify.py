"""What `certify` promises, on plain things."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.physics_corrector.certify import CertifyOptions, CorrectionStatus, certify
from stable_data.errors import ConfigError, SceneError
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.relations_kept import relations_kept
from stable_data.scene import RelationKind, Scene, Stage
from tests.models.physics_corrector.certify.things import ball, bowl, box, cylinder, laid

CUP, BOOK, PLATE = cylinder(0.04, 0.1), box(0.15, 0.2, 0.03), cylinder(0.1, 0.012)


def moved(before: Scene, after: Scene) -> dict[str, float]:
    return {o.instance: float(np.linalg.norm(np.subtract(o.position, before[o.instance].position))) for o in after.objects}


def test_two_cups_go_apart_and_no_farther() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0), ("c", CUP, 0.1, 0.1, 0.0))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.scene is not None
    assert result.audit is not None
    assert result.audit.card().clean
    how_far = moved(scene, result.scene)
    assert how_far["c"] == 0
    assert how_far["a"] + how_far["b"] == pytest.approx(0.02, abs=1.5e-3)


def test_what_is_clean_is_handed_back_as_it_is() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.5, 0.3, 4e-4), ("c", box(0.05, 0.05, 0.05), 0.4, 0.3, 0.1))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.scene is scene


def test_less_depth_may_be_allowed_than_the_audit_lets_pass() -> None:
    """Two books 0.45 mm in each other are clean, and may be parted all the same."""
    scene, shapes = laid(("a", BOOK, 0.2, 0.3, 0.0), ("b", BOOK, 0.34955, 0.3, 0.0))
    assert certify(scene, shapes).scene is scene
    parted = certify(scene, shapes, CertifyOptions(depth=4e-4))
    assert parted.scene is not None
    assert parted.audit is not None
    assert (parted.audit.card().max_penetration_mm or 0.0) < 0.4
    assert 0 < sum(moved(scene, parted.scene).values()) < 2e-3
    with pytest.raises(ConfigError, match=r"depth is 0\.001"):
        CertifyOptions(depth=1e-3)


def test_books_that_touch_stay() -> None:
    scene, shapes = laid(("a", BOOK, 0.2, 0.3, 0.0), ("b", BOOK, 0.35, 0.3, 0.0), ("c", CUP, 0.6, 0.3, 0.05))
    result = certify(scene, shapes)
    assert result.scene is not None
    how_far = moved(scene, result.scene)
    assert how_far == {"a": 0, "b": 0, "c": pytest.approx(0.05)}


def test_apple_in_a_bowl_stays_and_moves_with_it() -> None:
    things = (("bowl", bowl(), 0.3, 0.3, 0.0), ("apple", ball(0.03), 0.31, 0.3, 0.0041), ("far", CUP, 0.6, 0.3, 0.0))
    scene, shapes = laid(*things, ("near", CUP, 0.63, 0.3, 0.0))
    result = certify(scene, shapes)
    assert result.scene is not None
    assert moved(scene, result.scene)["apple"] == 0
    pushed, shapes = laid(*things, ("wall", box(0.1, 0.1, 0.2), 0.19, 0.3, 0.0), stages={"wall": Stage.TASK})
    result = certify(pushed, shapes)
    assert result.scene is not None
    gone = np.subtract(result.scene["bowl"].position, pushed["bowl"].position)
    assert gone[0] > 0.01
    assert np.subtract(result.scene["apple"].position, pushed["apple"].position) == pytest.approx(gone, abs=1e-12)
    assert relations_kept(pushed, result.scene, shapes).on_in_share == 1


def test_plates_stay_stacked() -> None:
    stack = [(f"plate_{n}", PLATE, 0.3 + 0.001 * n, 0.3, 0.0121 * n) for n in range(4)]
    scene, shapes = laid(*stack, ("cup", CUP, 0.42, 0.3, 0.0))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.scene is not None
    offsets = [np.subtract(result.scene[f"plate_{n}"].position, result.scene["plate_0"].position) for n in range(4)]
    expected = [np.subtract(scene[f"plate_{n}"].position, scene["plate_0"].position) for n in range(4)]
    assert np.array(offsets) == pytest.approx(np.array(expected), abs=1e-9)


def test_spoon_through_a_plate_comes_free() -> None:
    spoon = box(0.18, 0.02, 0.006)
    scene, shapes = laid(("plate", PLATE, 0.3, 0.3, 0.0), ("spoon", spoon, 0.42, 0.3, 0.003))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.audit is not None
    assert result.audit.card().max_penetration_mm == 0


def test_the_edge_and_the_restricted_zone_hold() -> None:
    things = (("a", CUP, 0.01, 0.3, 0.0), ("b", CUP, 0.4, 0.62, 0.0), ("c", CUP, 0.4, 0.3, 0.0))
    scene, shapes = laid(*things, zone=(0.35, 0.5, 0.25, 0.35))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.CERTIFIED
    assert result.audit is not None
    assert result.audit.card().out_of_bounds_rate == 0
    assert result.scene is not None
    assert result.scene["a"].position[0] == pytest.approx(0.04, abs=2e-3)


def test_what_hovers_is_lowered_and_what_sank_is_lifted() -> None:
    scene, shapes = laid(("a", CUP, 0.2, 0.3, 0.02), ("b", CUP, 0.5, 0.3, -0.02))
    result = certify(scene, shapes)
    assert result.scene is not None
    assert [o.position[2] for o in result.scene.objects] == pytest.approx([0.05, 0.05])


def test_task_objects_are_stiff() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0), stages={"a": Stage.TASK})
    result = certify(scene, shapes)
    assert result.scene is not None
    how_far = moved(scene, result.scene)
    assert how_far["a"] < 0.2 * how_far["b"]


def test_fixed_objects_are_obstacles() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0))
    result = certify(scene, shapes, CertifyOptions(fixed=frozenset({"b"})))
    assert result.scene is not None
    assert result.scene["b"] == scene["b"]
    both = certify(scene, shapes, CertifyOptions(fixed=frozenset({"a", "b"})))
    assert both.status is CorrectionStatus.INFEASIBLE
    assert "a is in b" in both.reason
    assert both.scene is None


def test_a_full_table_drops_the_smallest_or_says_so() -> None:
    tiles = [(f"tile_{n}", box(0.2, 0.2, 0.05), 0.1 + 0.1 * n, 0.15, 0.0) for n in range(4)]
    small = ("small", box(0.1, 0.1, 0.05), 0.2, 0.2, 0.0)
    scene, shapes = laid(*tiles, small, size=(0.41, 0.41))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.DROPPED
    assert result.audit is not None
    assert result.audit.card().clean
    assert [d.instance for d in result.dropped] == ["small"]
    assert "0.41" in result.dropped[0].reason
    refused = certify(scene, shapes, CertifyOptions(when_full="infeasible"))
    assert refused.status is CorrectionStatus.INFEASIBLE
    assert "small" in refused.reason
    task = replace(scene, objects=tuple(replace(o, stage=Stage.TASK) for o in scene.objects))
    assert certify(task, shapes).status is CorrectionStatus.INFEASIBLE


def test_a_table_smaller_than_its_objects() -> None:
    scene, shapes = laid(("book", BOOK, 0.05, 0.05, 0.0), ("pen", box(0.05, 0.01, 0.01), 0.05, 0.05, 0.0), size=(0.1, 0.1))
    result = certify(scene, shapes)
    assert result.status is CorrectionStatus.DROPPED
    assert [d.instance for d in result.dropped] == ["book"]
    alone = certify(replace(scene, objects=scene.objects[:1]), shapes[:1])
    assert (alone.status, alone.scene) == (CorrectionStatus.INFEASIBLE, None)
    assert "no free place was found on the table of 0.10 x 0.10 m" in alone.reason


def test_relations_that_the_scene_asks_for_are_restored() -> None:
    asked = (("apple", RelationKind.IN, "bowl"), ("cup", RelationKind.ON, "book"))
    things = (("bowl", bowl(), 0.3, 0.3, 0.0), ("apple", ball(0.03), 0.42, 0.3, 0.0), ("book", BOOK, 0.6, 0.3, 0.0))
    scene, shapes = laid(*things, ("cup", CUP, 0.6, 0.5, 0.0), relations=asked)
    result = certify(scene, shapes)
    assert result.scene is not None
    kept = relations_kept(scene, result.scene, shapes)
    assert (kept.asked_broken, kept.asked_restored) == (2, 2)
    left = certify(scene, shapes, CertifyOptions(restore=False))
    assert left.scene is not None
    assert relations_kept(scene, left.scene, shapes).asked_restored == 0


def test_directional_relations_are_kept_where_the_nearest_way_out_would_break_them() -> None:
    scene, shapes = laid(("a", BOOK, 0.35, 0.3, 0.0), ("b", BOOK, 0.45, 0.38, 0.0), yaws={"a": np.pi / 2, "b": np.pi / 2})
    result = certify(scene, shapes)
    assert result.scene is not None
    kept = relations_kept(scene, result.scene, shapes)
    assert kept.directional_held > 0
    assert kept.directional_share == 1


def test_movement_is_measured_from_the_original() -> None:
    original, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0))
    flow, _ = laid(("a", CUP, 0.3, 0.3, 0.0), ("b", CUP, 0.375, 0.3, 0.0))
    result = certify(flow, shapes, original=original)
    assert result.scene is not None
    assert max(moved(original, result.scene).values()) < 0.02


def test_a_missing_mesh_is_never_a_pass() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", box(0.08, 0.08, 0.1), 0.46, 0.3, 0.0))
    result = certify(scene, [shapes[0], Shape.box((0.08, 0.08, 0.1))])
    assert result.status is CorrectionStatus.UNKNOWN
    assert "b" in result.reason
    assert result.scene is not None
    by_boxes = audit_scene(result.scene, shapes)
    assert by_boxes.card().clean


def test_one_object_and_none() -> None:
    scene, shapes = laid(("a", CUP, 0.0, 0.3, 0.0))
    assert certify(scene, shapes).status is CorrectionStatus.CERTIFIED
    empty, none = laid()
    assert certify(empty, none).scene is empty


def test_bad_input_is_said() -> None:
    scene, shapes = laid(("a", CUP, 0.4, 0.3, 0.0))
    with pytest.raises(SceneError, match="0 shapes for 1 objects"):
        certify(scene, [])
    with pytest.raises(SceneError, match="ghost"):
        certify(scene, shapes, CertifyOptions(fixed=frozenset({"ghost"})))
    with pytest.raises(SceneError, match="other objects"):
        certify(scene, shapes, original=laid(("b", CUP, 0.4, 0.3, 0.0))[0])
    with pytest.raises(ConfigError, match="clearance"):
        CertifyOptions(clearance=-1.0)


@st.composite
def crowds(draw: st.DrawFn) -> tuple[Scene, list[Shape]]:
    kinds = (CUP, BOOK, PLATE, bowl(), ball(0.03), box(0.18, 0.02, 0.006), box(0.04, 0.05, 0.04))
    things = []
    for n in range(draw(st.integers(1, 9))):
        shape = draw(st.sampled_from(kinds))
        x, y = draw(st.floats(-0.05, 0.65)), draw(st.floats(-0.05, 0.55))
        things.append((f"thing_{n}", shape, x, y, draw(st.sampled_from((0.0, 0.0, 0.0, 0.004, 0.012, 0.05, -0.01)))))
    yaws = {name: draw(st.floats(-3.1, 3.1)) for name, *_ in things}
    return laid(*things, size=(0.6, 0.5), yaws=yaws)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(crowds())
def test_whatever_it_is_given_nothing_collides_in_silence(laid_out: tuple[Scene, list[Shape]]) -> None:
    scene, shapes = laid_out
    fixed = frozenset({scene.objects[0].instance})
    for options in (CertifyOptions(), CertifyOptions(fixed=fixed)):
        result = certify(scene, shapes, options)
        if result.scene is None:
            assert result.status is CorrectionStatus.INFEASIBLE
            assert result.reason
            continue
        names = [o.instance for o in result.scene.objects]
        assert sorted([*names, *(d.instance for d in result.dropped)]) == sorted(o.instance for o in scene.objects)
        shape = {o.instance: s for o, s in zip(scene.objects, shapes, strict=True)}
        audit = audit_scene(result.scene, [shape[name] for name in names])
        assert audit == result.audit
        assert audit.card().clean
        assert (result.status is CorrectionStatus.DROPPED) == bool(result.dropped)
        for name in options.fixed:
            assert result.scene[name] == scene[name]
        again = certify(result.scene, [shape[name] for name in names], options)
        assert again.scene is result.scene


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(crowds(), st.randoms(use_true_random=False))
def test_the_order_of_objects_does_not_matter(laid_out: tuple[Scene, list[Shape]], random: object) -> None:
    scene, shapes = laid_out
    order = list(range(len(shapes)))
    random.shuffle(order)  # type: ignore[attr-defined]
    other = replace(scene, objects=tuple(scene.objects[k] for k in order))
    first, second = certify(scene, shapes), certify(other, [shapes[k] for k in order])
    assert first.status == second.status
    assert first == certify(scene, shapes)
    assert {d.instance for d in first.dropped} == {d.instance for d in second.dropped}


def test_surroundings_are_obstacles_that_nothing_carries_or_judges() -> None:
    """A robot arm that hovers over the table beyond its edge, and a box in it."""
    scene, shapes = laid(
        ("0_arm_0", box(0.5, 0.06, 0.06), 0.0, 0.2, 0.05),
        ("1_box_0", box(0.1, 0.1, 0.1), 0.2, 0.22, 0.0),
        ("2_box_0", box(0.04, 0.04, 0.04), 0.1, 0.2, 0.0),
    )
    fixed = frozenset({"0_arm_0"})
    done = certify(replace(scene, fixed=fixed), shapes, CertifyOptions(when_full="infeasible", fixed=fixed))
    assert done.status is CorrectionStatus.CERTIFIED
    assert done.scene is not None
    assert done.scene["0_arm_0"] == scene["0_arm_0"]
    assert done.scene["2_box_0"] == scene["2_box_0"]  # there is room below the arm
    assert done.scene["1_box_0"].position != scene["1_box_0"].position
    assert done.scene["1_box_0"].position[2] == pytest.approx(0.05)
