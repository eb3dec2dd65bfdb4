"""Alignment with a task: what is there, what holds, what is too much."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.embedded_world.scenes import make_scene
from stable_data.errors import SceneError
from stable_data.instructions.deriving import derive_task
from stable_data.metrics import alignment
from stable_data.metrics.alignment import Alignment, AlignmentReference, align, reference_of, requires_the_same
from stable_data.metrics.alignment_summary import summarise_alignment
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.matching import ObjectMatching, RequiredObject
from stable_data.metrics.reply_validity import reply_validity
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo, Vec3
from stable_data.scene_graph.relations import direction_of, relations_of, scene_graph
from tests.stable_data.instructions.tables import TABLES, Table

LEFT, RIGHT, FRONT, BEHIND = RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND
ON, IN, ABOVE = RelationKind.ON, RelationKind.IN, RelationKind.ABOVE
TABLETOP = Tabletop("office_table", (1.2, 0.6))


def thing(name: str, position: Vec3, size: Vec3 = (0.1, 0.1, 0.1), yaw: float = 0.0) -> SceneObject:
    return SceneObject(name, name.split("_")[0], position, yaw, size)


# A pen is right of a mug and left of a book; a card lies on the book; a stone lies about.
PEN, MUG, BOOK, CARD, STONE = (
    thing("pen_0", (0.6, 0.3, 0.05)),
    thing("mug_0", (0.3, 0.3, 0.05)),
    thing("book_0", (0.9, 0.3, 0.05), (0.2, 0.2, 0.1)),
    thing("card_0", (0.9, 0.3, 0.11), (0.1, 0.1, 0.02)),
    thing("stone_0", (0.6, 0.5, 0.05)),
)
RELATIONS = (
    Relation("pen_0", RIGHT, "mug_0"),
    Relation("pen_0", LEFT, "book_0"),
    Relation("card_0", ON, "book_0"),
    Relation("mug_0", RelationKind.IS_AT, "middle_left"),
)
SCENE = Scene("s", TABLETOP, (PEN, MUG, BOOK, CARD, STONE))
TASK = TaskInfo("A desk.", "Do it.", task_objects=("pen_0", "mug_0", "book_0", "card_0"), relations=RELATIONS)
REFERENCE = reference_of(replace(SCENE, task=TASK, relations=relations_of(scene_graph(SCENE, {}))))


def with_objects(*objects: SceneObject) -> Scene:
    return replace(SCENE, objects=objects)


def renamed(scene: Scene, order: list[int]) -> Scene:
    """The objects in another order and with names that say nothing."""
    return replace(scene, objects=tuple(replace(scene.objects[k], instance=f"thing {n}") for n, k in enumerate(order)))


def containers_of(one: Table) -> Mapping[str, bool | None]:
    return {name: about.get("container") for name, about in one.graph.nodes(data=True)}


def figures(found: Alignment) -> tuple[float | None, ...]:
    return found.awt, found.aws, found.aws_graph, found.distractor_rate


@pytest.mark.parametrize("one", TABLES, ids=lambda t: t.scene.scene_id)
def test_a_scene_is_aligned_with_itself(one: Table) -> None:
    num_entailed = 0
    for seed in range(30):
        task = derive_task(one.scene, one.graph, np.random.default_rng(seed))
        reference = reference_of(replace(one.scene, task=task, relations=relations_of(one.graph)))
        found = align(one.scene, reference, containers=containers_of(one))
        assert found.awt == 1
        assert found.aws == (1 if task.relations else None)
        assert found.aws_graph == (1 if reference.graph else None)
        assert found.distractor_rate == pytest.approx(1 - len(reference.required) / len(one.scene.objects))
        num_entailed += len(task.relations)
    assert num_entailed


@pytest.mark.sim
def test_scenes_of_the_embedded_world_are_aligned_with_themselves() -> None:
    num_entailed = 0
    for number in (1, 4, 5, 7):
        made = make_scene(number, 2)
        scene = made.scene
        audit = audit_scene(scene, [t.shape for t in made.placed])
        contacts = {o.instance: o.supports or () for o in audit.objects}
        containers = {o.instance: t.asset.hollow is not None for o, t in zip(scene.objects, made.placed, strict=True)}
        scene = replace(scene, relations=relations_of(scene_graph(scene, contacts, containers=containers)))
        found = align(scene, reference_of(scene), contacts=contacts, containers=containers)
        assert not found.missing
        assert found.broken == ()
        assert found.graph_broken == ()
        num_entailed += len(found.reference.entailed)
    assert num_entailed


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(TABLES), st.integers(0, 1000), st.integers(0, 2**32 - 1))
def test_names_and_order_of_the_objects_do_not_count(one: Table, seed: int, shake: int) -> None:
    task = derive_task(one.scene, one.graph, np.random.default_rng(seed))
    reference = reference_of(replace(one.scene, task=task, relations=relations_of(one.graph)))
    rng = np.random.default_rng(shake)
    poses = one.scene.poses() + rng.normal(0, [0.1, 0.1, 0, 0.5], (len(one.scene.objects), 4))
    scene = one.scene.with_poses(poses)
    other = renamed(scene, rng.permutation(len(scene.objects)).tolist())
    assert figures(align(scene, reference)) == figures(align(other, reference))


@pytest.mark.parametrize("gone", TASK.task_objects)
def test_a_missing_task_object_costs_its_share_and_its_relations(gone: str) -> None:
    found = align(with_objects(*(o for o in SCENE.objects if o.instance != gone)), REFERENCE)
    assert found.awt == pytest.approx(1 - 1 / 4)
    assert [r.instance for r in found.missing] == [gone]
    lost = [r for r in RELATIONS if gone in (r.subject, r.target)]
    assert lost
    assert set(found.broken or ()) >= set(lost)
    assert f"missing: {gone.split('_')[0]}" in str(found)


def test_swapping_left_and_right_breaks_exactly_these() -> None:
    mug, book = replace(MUG, position=(0.85, 0.3, 0.05)), replace(BOOK, position=(0.3, 0.3, 0.05))
    card = replace(CARD, position=(0.3, 0.3, 0.11))
    found = align(with_objects(PEN, mug, book, card, STONE), REFERENCE)
    assert found.broken == (RELATIONS[0], RELATIONS[1], RELATIONS[3])
    assert found.aws == pytest.approx(1 / 4)
    assert "broken: pen_0 right of mug_0" in str(found)


@pytest.mark.parametrize("kind", [LEFT, RIGHT, FRONT, BEHIND])
@settings(max_examples=30, deadline=None)
@given(dx=st.floats(-0.3, 0.3), dy=st.floats(-0.3, 0.3))
def test_a_direction_holds_within_45_degrees(kind: RelationKind, dx: float, dy: float) -> None:
    scene = with_objects(thing("mug_0", (0.6, 0.45, 0.05)), thing("pen_0", (0.6 + dx, 0.45 + dy, 0.05)))
    asked = AlignmentReference("r", (RequiredObject("p", ("pen",)), RequiredObject("m", ("mug",))), (Relation("p", kind, "m"),))
    along = {LEFT: -dx, RIGHT: dx, FRONT: -dy, BEHIND: dy}[kind]
    x, y = scene["pen_0"].position[0] - 0.6, scene["pen_0"].position[1] - 0.45
    across = abs(y) if kind in (LEFT, RIGHT) else abs(x)
    if abs(along - across) > 1e-9:
        assert align(scene, asked).aws == float(along > across)


def test_one_more_distractor_between_them_does_not_break_a_direction() -> None:
    crowd = [thing(f"stone_{k}", (0.35 + 0.05 * k, 0.3, 0.05), (0.01, 0.01, 0.1)) for k in range(1, 5)]
    assert align(with_objects(*SCENE.objects, *crowd), REFERENCE).aws == 1
    assert align(with_objects(*SCENE.objects, *crowd), REFERENCE).distractor_rate == pytest.approx(5 / 9)


def test_what_shall_be_on_a_thing_may_be_on_it_through_another_or_in_it_but_not_the_other_way_round() -> None:
    asked = [RequiredObject("ball", ("ball",)), RequiredObject("tray", ("tray",))]
    on, into = (AlignmentReference("r", tuple(asked), (Relation("ball", kind, "tray"),)) for kind in (ON, IN))
    tray = thing("tray_0", (0.6, 0.45, 0.05), (0.3, 0.3, 0.1))
    between = thing("napkin_0", (0.6, 0.45, 0.11), (0.1, 0.1, 0.02))
    piled = with_objects(tray, between, thing("ball_0", (0.6, 0.45, 0.145), (0.05, 0.05, 0.05)))
    assert (align(piled, on).aws, align(piled, into).aws) == (1, 0)
    inside = with_objects(tray, thing("ball_0", (0.6, 0.45, 0.04), (0.05, 0.05, 0.05)))
    found = [align(inside, one, containers={"tray_0": True}) for one in (on, into)]
    assert [one.aws for one in found] == [1, 1]
    assert (found[0].num_stacked, found[0].num_contained) == (0, 1)
    beside = with_objects(tray, thing("ball_0", (0.2, 0.45, 0.025), (0.05, 0.05, 0.05)))
    assert (align(beside, on).aws, align(beside, into).aws) == (0, 0)


@pytest.mark.parametrize(
    ("relation", "holds"),
    [
        (Relation("m", RelationKind.IS_AT, "middle_left"), 1),
        (Relation("m", RelationKind.IS_AT, "back_left"), 0),
        (Relation("m", RelationKind.FACE_TO, "front"), 1),
        (Relation("m", RelationKind.FACE_TO, "left"), 0),
        (Relation("m", ON, TABLE), 1),
        (Relation("c", ON, TABLE), 1),
        (Relation("m", LEFT, TABLE), 0),
        (Relation("c", ABOVE, "b"), 1),
        (Relation("b", RelationKind.BELOW, "c"), 1),
        (Relation("m", ABOVE, "b"), 0),
        (Relation("m, p, b", RelationKind.EQUALLY_SPACED, "x"), 1),
        (Relation("m, p, c", RelationKind.EQUALLY_SPACED, "x"), 0),
        (Relation("m, p, b", RelationKind.EQUALLY_SPACED, "y"), 0),
        (Relation("p", RelationKind.BETWEEN, "m, b"), 1),
        (Relation("p", RelationKind.BETWEEN, "c, m"), 1),
        (Relation("m", RelationKind.BETWEEN, "p, b"), 0),
        (Relation("p", RelationKind.BETWEEN, "c, b"), 0),
    ],
    ids=str,
)
def test_every_kind_of_relation_is_judged(relation: Relation, holds: int) -> None:
    required = tuple(RequiredObject(word[0], (word,)) for word in ("mug", "pen", "book", "card"))
    assert align(SCENE, AlignmentReference("r", required, (relation,))).aws == holds


def block_scene(rng: np.random.Generator, count: int, kind: str = "toy_block") -> Scene:
    points = rng.uniform(0.1, 0.8, (count, 2))
    return with_objects(
        *(SceneObject(f"{k}_{kind}", kind, (x, y, 0.02), 0.0, (0.04, 0.04, 0.04)) for k, (x, y) in enumerate(points))
    )


def directions(scene: Scene, pairs: list[tuple[int, int]]) -> tuple[Relation, ...]:
    """The direction that holds between each pair of objects."""
    found = []
    for one, other in pairs:
        a, b = scene.objects[one], scene.objects[other]
        kind = direction_of(a.position[0] - b.position[0], a.position[1] - b.position[1])
        assert kind is not None
        found.append(Relation(a.instance, kind, b.instance))
    return tuple(found)


def blocks_asked(scene: Scene, pairs: list[tuple[int, int]]) -> AlignmentReference:
    required = tuple(RequiredObject(o.instance, (o.category,)) for o in scene.objects)
    return AlignmentReference("blocks", required, directions(scene, pairs))


@pytest.mark.parametrize("seed", range(4))
def test_six_identical_blocks_get_the_best_of_all_720_roles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    asked = blocks_asked(block_scene(rng, 6), [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5), (1, 4)])
    scene = block_scene(rng, 6)

    def num_held(roles: tuple[int, ...]) -> int:
        role = {r.instance: roles[k] for k, r in enumerate(asked.required)}
        return sum(directions(scene, [(role[r.subject], role[r.target])])[0].kind is r.kind for r in asked.entailed)

    best = max(num_held(roles) for roles in permutations(range(6)))
    assert align(scene, asked).aws == pytest.approx(best / len(asked.entailed))


@pytest.mark.parametrize("count", [6, 12])
def test_swapped_roles_of_identical_objects_cost_nothing(count: int) -> None:
    rng = np.random.default_rng(count)
    scene = block_scene(rng, count, "chopsticks")
    pairs = [(k, n) for k in range(count) for n in range(k + 1, count) if (k + n) % 3 == 0]
    found = align(renamed(scene, rng.permutation(count).tolist()), blocks_asked(scene, pairs))
    assert found.aws == 1


def test_what_is_spoken_of_by_its_place_alone_may_be_anything_there_and_one_will_do() -> None:
    tray, mug, pen = thing("tray_0", (0.6, 0.3, 0.02), (0.4, 0.3, 0.04)), thing("mug_0", (0.5, 0.3, 0.09)), PEN
    full = with_objects(tray, mug, replace(pen, position=(0.7, 0.3, 0.09)))
    relations = (Relation("mug_0", ON, "tray_0"), Relation("pen_0", ON, "tray_0"))
    task = replace(TASK, task_objects=("tray_0", "mug_0", "pen_0"), relations=relations)
    said, unsaid = (
        reference_of(replace(full, task=replace(task, task=words)))
        for words in ("Take the mug and the pens off the tray.", "Take everything off the tray.")
    )
    by_kind = reference_of(replace(full, task=replace(task, task="Take the crockery off the tray.")))
    assert [r.categories for r in by_kind.required] == [("tray",), ("mug",), ("pen",)]
    assert [r.categories for r in said.required] == [("tray",), ("mug",), ("pen",)]
    assert [r.categories for r in unsaid.required] == [("tray",), ()]
    other = with_objects(tray, thing("stapler_0", (0.6, 0.3, 0.09)), STONE)
    beside = with_objects(tray, STONE)
    assert [(a.awt, a.aws) for a in (align(other, unsaid), align(beside, unsaid))] == [(1.0, 1.0), (1.0, 0.0)]
    assert align(with_objects(tray), unsaid).awt == 0.5
    assert align(other, said).awt == 1 / 3


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(TABLES), st.integers(0, 1000), st.randoms(use_true_random=False))
def test_a_reference_requires_the_same_under_other_names(one: Table, seed: int, random: Random) -> None:
    reference = reference_of(replace(one.scene, task=derive_task(one.scene, one.graph, np.random.default_rng(seed))))
    names = {r.instance: f"thing {k}" for k, r in enumerate(random.sample(reference.required, len(reference.required)))}
    required = [replace(r, instance=names[r.instance]) for r in reference.required]
    entailed = [_under(r, names) for r in reference.entailed]
    other = AlignmentReference("other", tuple(required), tuple(random.sample(entailed, len(entailed))))
    assert requires_the_same(reference, other)
    assert requires_the_same(other, reference)
    if entailed:
        assert not requires_the_same(reference, replace(other, entailed=other.entailed[1:]))
        assert not requires_the_same(replace(reference, entailed=reference.entailed[1:]), other)
    assert not requires_the_same(
        reference, AlignmentReference("other", other.required[1:] or (RequiredObject("x", ("kiwi",)),))
    )


def _under(relation: Relation, names: Mapping[str, str]) -> Relation:
    """A relation under other names, with its direction turned."""
    subject = ", ".join(names.get(name, name) for name in relation.subject.split(", "))
    target = ", ".join(names.get(name, name) for name in relation.target.split(", "))
    turned = {RelationKind.LEFT_OF: RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF: RelationKind.BEHIND}
    if relation.kind in turned:
        return Relation(target, turned[relation.kind], subject)
    return replace(relation, subject=subject, target=target)


def test_which_of_two_mugs_is_on_the_plate_and_which_beside_it_counts() -> None:
    def reference(*entailed: Relation) -> AlignmentReference:
        things = (("a", "mug"), ("b", "mug"), ("c", "plate"), ("d", "tray"))
        return AlignmentReference("task", tuple(RequiredObject(name, (kind,)) for name, kind in things), entailed)

    on_plate, left = Relation("a", RelationKind.ON, "c"), Relation("a", RelationKind.LEFT_OF, "d")
    assert requires_the_same(
        reference(on_plate, left), reference(Relation("b", RelationKind.ON, "c"), Relation("d", RelationKind.RIGHT_OF, "b"))
    )
    assert not requires_the_same(reference(on_plate, left), reference(on_plate, replace(left, subject="b")))
    between = Relation("a", RelationKind.BETWEEN, "c, d")
    assert requires_the_same(reference(between), reference(replace(between, target="d, c")))
    assert not requires_the_same(
        reference(Relation("a", RelationKind.IS_AT, "back_left")), reference(Relation("a", RelationKind.IS_AT, "back_right"))
    )


def test_nothing_entailed_is_not_full_marks() -> None:
    found = align(SCENE, AlignmentReference("r", (RequiredObject("m", ("mug",)),)))
    assert (found.awt, found.aws, found.aws_graph) == (1, None, None)
    without_graph = reference_of(replace(SCENE, task=TASK))
    assert without_graph.graph is None
    assert align(SCENE, without_graph).aws_graph is None
    assert align(SCENE, without_graph).aws == 1


def test_an_empty_scene_has_nothing() -> None:
    found = align(with_objects(), REFERENCE)
    assert figures(found) == (0, 0, 0, None)
    assert set(found.broken or ()) == set(RELATIONS)


def test_a_search_that_was_given_up_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alignment, "match", lambda may_be, wishes: ObjectMatching({"pen_0": "pen_0"}, is_best=False))
    found = align(SCENE, REFERENCE)
    assert (found.awt, found.aws, found.aws_graph) == (0.25, None, None)
    assert "relations unknown" in str(found)
    summary = summarise_alignment([found])
    assert (summary.aws.num_scenes, summary.aws.num_unknown, summary.aws.micro) == (0, 1, None)
    assert "1 scenes unknown" in str(summary)


@pytest.mark.parametrize(
    ("words", "is_enough"),
    [("Hand me the cup.", True), ("Hand me the teacup.", False), ("Hand me the cup and the teacup.", False)],
)
def test_what_is_called_by_a_wider_noun_may_be_whatever_has_that_noun(words: str, is_enough: bool) -> None:
    teacup = SceneObject("teacup_0", "teacup", (0.3, 0.3, 0.05), 0.0, (0.1, 0.1, 0.1))
    reference = reference_of(replace(with_objects(teacup), task=TaskInfo("A desk.", words, task_objects=("teacup_0",))))
    found = align(with_objects(MUG), reference)
    assert found.awt == float(is_enough)
    assert align(with_objects(teacup), reference).awt == 1


def test_references_that_cannot_be_judged_are_refused() -> None:
    for task in (None, TaskInfo("A desk.", "Do it."), TaskInfo("A desk.", "Do it.", task_objects=("ghost_0",))):
        with pytest.raises(SceneError, match="task objects are") as caught:
            reference_of(replace(SCENE, task=task))
        assert caught.value.code == "task_objects_unknown"
    with pytest.raises(SceneError, match="mug_0 is not a required object") as caught:
        AlignmentReference("r", (RequiredObject("p", ("pen",)),), (Relation("p", LEFT, "mug_0"),))
    assert caught.value.code == "task_relation_unknown"
    with pytest.raises(SceneError, match="different names"):
        AlignmentReference("r", (RequiredObject("p", ("pen",)), RequiredObject("p", ("mug",))))
    with pytest.raises(SceneError, match="one or more"):
        AlignmentReference("r", ())


def test_a_set_is_pooled_by_scene_and_by_relation() -> None:
    without_mug = align(with_objects(PEN, BOOK, CARD, STONE), REFERENCE)
    bare = align(SCENE, AlignmentReference("r", (RequiredObject("m", ("mug",)),)))
    summary = summarise_alignment([align(SCENE, REFERENCE), without_mug, bare, align(with_objects(), REFERENCE)])
    assert summary.awt == pytest.approx((1 + 0.75 + 1 + 0) / 4)
    assert summary.num_complete == 2
    assert (summary.aws.num_scenes, summary.aws.num_held, summary.aws.num_relations) == (3, 4 + 2 + 0, 12)
    assert summary.aws.macro == pytest.approx((1 + 0.5 + 0) / 3)
    assert summary.distractor_rate == pytest.approx((1 / 5 + 1 / 4 + 4 / 5) / 3)
    assert summary.num_empty == 1
    assert summary.num_objects == pytest.approx(14 / 4)
    assert summary.num_objects_reference == 5
    assert summary.num_stacked == pytest.approx(3 / 4)
    assert summary.num_contained == 0
    text = str(summary)
    assert "6 of 12 (50.0 %), mean over 3 scenes 50.0 %" in text
    assert "1 of 4 scenes without objects" in text


def test_no_scenes_have_no_figures() -> None:
    summary = summarise_alignment([])
    assert (summary.awt, summary.aws.micro, summary.aws.macro, summary.distractor_rate) == (None, None, None, None)
    assert "none asked for" in str(summary)


def test_replies_are_counted_and_unknown_ones_are_not_valid() -> None:
    assert reply_validity(0, (), 0).share is None
    found = reply_validity(3, ("reply_truncated", "object_unknown", "reply_truncated"), 1)
    assert found.invalid == (("reply_truncated", 2), ("object_unknown", 1))
    assert (found.num_valid, found.num_invalid, found.num_unknown, found.num_replies) == (3, 3, 1, 7)
    assert found.share == pytest.approx(3 / 7)
    assert "1 unknown" in str(found)
    assert "reply_truncated" in str(found)
