"""Kinds of task: how many, all of them reachable, and true in what they say."""

import re
from collections import Counter

import numpy as np
import pytest

from stable_data.condition import ConditionKind
from stable_data.instructions.deriving import KINDS, NUM_PATTERNS, SIMPLE_KINDS
from stable_data.instructions.kind import SEVERAL, SINGLE, TaskKind, members
from stable_data.instructions.naming import mentions
from stable_data.instructions.situation import TaskContext
from stable_data.scene import RelationKind
from stable_data.scene_graph.relations import relations_of
from tests.stable_data.instructions.tables import (
    BOX,
    DESK,
    DINING,
    MUG,
    SHELF,
    STACKS,
    TABLES,
    Table,
    Thing,
    table,
    told_somewhere,
)

PRIMITIVES = {"Pick", "PlaceOn", "PlaceAt", "Push", "RevoluteJointOpen", "RevoluteJointClose", "Press"}


def test_there_are_many_kinds_and_patterns() -> None:
    assert len(KINDS) >= 80
    assert NUM_PATTERNS >= 300
    assert len({kind.name for kind in KINDS}) == len(KINDS)


@pytest.mark.parametrize("kind", SIMPLE_KINDS, ids=lambda k: k.name)
def test_every_text_of_a_kind_names_every_role(kind: TaskKind) -> None:
    used = [set(re.findall(r"\{(\w+)", text)) & {*SINGLE, *SEVERAL} for text in kind.texts]
    assert all(roles == used[0] for roles in used)
    mentioned = {role for line in (*kind.goal, *kind.actions) for role in re.findall(r"\{(\w+)", line)}
    assert mentioned & {*SINGLE, *SEVERAL} <= used[0]
    assert {role for a, _, b in kind.links for role in (a, b)} <= used[0]


@pytest.mark.parametrize("name", [kind.name for kind in KINDS])
def test_every_kind_is_reachable_and_tells_the_truth(name: str) -> None:
    found = told_somewhere(name)
    assert found
    for one, told in found:
        assert not set("{}[]") & set("".join((told.text, *told.goal)))
        assert set(told.relations) <= set(relations_of(one.graph))
        assert len(set(told.objects)) == len(told.objects)
        assert {action.split("(")[0] for action in told.actions} <= PRIMITIVES
        meant = {n for m in mentions(told.text, one.namer) for n in (m.instance, m.name.anchor) if n}
        assert meant <= set(told.objects), told.text


def objects_found(kind: TaskKind, one: Table) -> list[dict[str, tuple[str, ...]]]:
    return [members(roles) for seed in range(6) for roles in kind.find(one.situation(np.random.default_rng(seed)))]


@pytest.mark.parametrize("one", TABLES, ids=lambda t: t.scene.scene_id)
def test_nothing_impossible_is_asked(one: Table) -> None:
    carriers = {about.get("support") for _, about in one.graph.nodes(data=True)}
    size = {o.instance: o.size for o in one.scene.objects}
    for kind in SIMPLE_KINDS:
        if "PlaceOn({y})" in kind.actions[0] and kind.actions[0].startswith("Pick({x"):
            for roles in objects_found(kind, one):
                for x in roles.get("x", roles.get("xs", ())):
                    assert x not in carriers, kind.name
                    assert x not in roles["y"]
                    assert sorted(size[x])[0] < max(size[roles["y"][0]]), kind.name


def test_what_lies_on_a_thing_keeps_it_where_it_is() -> None:
    loose = DESK.situation(np.random.default_rng(0)).loose
    assert DESK.instance("laptop_0") not in loose
    assert DESK.instance("phone_0") not in loose


def test_all_means_every_one_in_the_scene() -> None:
    kind = next(k for k in SIMPLE_KINDS if k.name == "gather_kind")
    for roles in objects_found(kind, DINING):
        categories = Counter(o.category for o in DINING.scene.objects)
        (category,) = {DINING.namer.objects[n].category for n in roles["xs"]}
        assert len(roles["xs"]) == categories[category]


def test_a_goal_that_is_reached_already_is_not_asked_for() -> None:
    things = [
        Thing("plate_0", 0.6, 0.3, (0.22, 0.22, 0.02)),
        Thing("fork_0", 0.46, 0.3, (0.02, 0.18, 0.015)),
        Thing("knife_0", 0.74, 0.3, (0.02, 0.2, 0.012)),
    ]
    laid = table("dining_table", things)
    situation = laid.situation(np.random.default_rng(0))
    names = {kind.name for kind in SIMPLE_KINDS if next(iter(kind.find(situation)), None)}
    assert not names & {"set_place", "lay_cutlery", "belongs_in", "take_off"}
    corner = {"back right", "back left", "front right", "front left"}
    corners = next(k for k in SIMPLE_KINDS if k.name == "corner")
    for roles in corners.find(situation):
        row, column = str(roles["corner"]).split()
        assert roles["corner"] in corner
        assert laid.graph.nodes[str(roles["x"])]["cell"] != f"{row}_{column}"


def test_open_laptops_are_closed_and_closed_ones_opened() -> None:
    def instances(kind_name: str, one: Table) -> set[str]:
        kind = next(k for k in SIMPLE_KINDS if k.name == kind_name)
        return {roles["x"][0] for roles in objects_found(kind, one)}

    assert SHELF.instance("laptop_0") in instances("close", SHELF)
    assert SHELF.instance("laptop_0") not in instances("open", SHELF)
    assert instances("close", DESK) == set()


@pytest.mark.parametrize(("name", "least"), [("two_steps", 2), ("before", 2), ("three_steps", 3)])
def test_steps_add_up_and_speak_of_different_things(name: str, least: int) -> None:
    for one, told in told_somewhere(name):
        assert len(told.actions) >= least
        assert len(told.goal) >= least
        assert len(told.objects) >= least
        said = [m.instance for m in mentions(told.text, one.namer)]
        assert set(said) <= set(told.objects)


def test_what_is_held_at_the_end_is_asked_for_in_the_last_step() -> None:
    joined = [told for name in ("two_steps", "before", "three_steps") for _, told in told_somewhere(name)]
    held = [(told.conditions, k) for told in joined for k, c in enumerate(told.conditions) if c.kind is ConditionKind.HELD]
    assert held
    for conditions, k in held:
        assert {c.subject for c in conditions[k:]} == {conditions[k].subject}


def test_pushes_stay_on_the_table_and_meet_nothing() -> None:
    situation: TaskContext = STACKS.situation(np.random.default_rng(0))
    for x in situation.loose:
        for side in (RelationKind.LEFT_OF, RelationKind.RIGHT_OF):
            assert not situation.can_slide(x, side, situation.margin(x, side))


def test_only_what_covers_an_object_is_in_its_way() -> None:
    kind = next(k for k in SIMPLE_KINDS if k.name == "make_room")

    def pushes(x: float) -> list[float]:
        """The lengths of the pushes, metres, where the mug stands in front of the box at this place."""
        laid = table("office_table", [Thing("box_0", 0.7, 0.5, BOX), Thing("mug_0", x, 0.2, MUG)])
        return [float(roles["cm"]) / 100 for roles in kind.find(laid.situation(np.random.default_rng(0)))]  # type: ignore[arg-type]

    half = (BOX[0] + MUG[0]) / 2
    assert pushes(0.7 - half - 0.005) == pushes(0.7 + half + 0.005) == []
    assert sorted(pushes(0.7 - half + 0.005)) == pytest.approx([0.02, 2 * half + 0.01], abs=0.011)
    assert len(pushes(0.7)) == 2
