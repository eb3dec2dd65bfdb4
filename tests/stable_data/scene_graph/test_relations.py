"""The scene graph on layouts whose answer is plain, and on real ones whose answer is recorded."""

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import (
    Contacts,
    cell_of,
    facing_of,
    is_between,
    is_held,
    relations_of,
    scene_graph,
    supports,
    yawed_rectangle,
)

TABLETOP = Tabletop("office_table", (1.2, 0.6))


def box(name: str, position: Vec3, size: Vec3 = (0.1, 0.1, 0.1), yaw: float = 0.0) -> SceneObject:
    return SceneObject(name, name.split("_")[1], position, yaw, size)


def scene_of(*objects: SceneObject) -> Scene:
    return Scene("scene", TABLETOP, objects)


def links(scene: Scene, contacts: Contacts, containers: Mapping[str, bool | None] | None = None) -> set[Relation]:
    graph = scene_graph(scene, contacts, containers=containers)
    return {r for r in relations_of(graph) if r.kind in (RelationKind.ON, RelationKind.IN)}


BOWL = box("1_bowl_0", (0.6, 0.3, 0.05), (0.2, 0.2, 0.1))
BALL = box("2_ball_0", (0.6, 0.3, 0.06), (0.06, 0.06, 0.06))
CUBE = box("3_cube_0", (0.61, 0.3, 0.12), (0.06, 0.06, 0.06))


def test_a_ball_in_a_bowl_is_in_it_and_the_bowl_is_on_the_table() -> None:
    found = links(scene_of(BALL, BOWL), {"2_ball_0": ("1_bowl_0",), "1_bowl_0": (TABLE,)}, {"1_bowl_0": True})
    assert found == {Relation("2_ball_0", RelationKind.IN, "1_bowl_0"), Relation("1_bowl_0", RelationKind.ON, TABLE)}


def test_what_lies_on_contents_below_the_rim_is_in_the_container_and_above_it_is_on_the_contents() -> None:
    contacts = {"2_ball_0": ("1_bowl_0",), "1_bowl_0": (TABLE,), "3_cube_0": ("2_ball_0", "1_bowl_0")}
    containers = {"1_bowl_0": True, "2_ball_0": False}
    low = box("3_cube_0", (0.6, 0.3, 0.1), CUBE.size)
    assert Relation("3_cube_0", RelationKind.IN, "1_bowl_0") in links(scene_of(BOWL, BALL, low), contacts, containers)
    assert Relation("3_cube_0", RelationKind.ON, "2_ball_0") in links(scene_of(BOWL, BALL, CUBE), contacts, containers)


def test_a_thing_on_another_one_in_a_container_is_on_that_one_too_but_a_heap_is_not() -> None:
    crate = box("1_crate_0", (0.6, 0.3, 0.1), (0.3, 0.3, 0.2))
    book, apple = box("2_book_0", (0.6, 0.3, 0.03), (0.2, 0.15, 0.04)), box("3_apple_0", (0.6, 0.3, 0.085), (0.07, 0.07, 0.07))
    contacts = {"1_crate_0": (TABLE,), "2_book_0": ("1_crate_0",), "3_apple_0": ("2_book_0",)}
    on_in = links(scene_of(crate, book, apple), contacts, {"1_crate_0": True, "2_book_0": False})
    assert {(r.subject, r.kind, r.target) for r in on_in if r.subject == "3_apple_0"} == {
        ("3_apple_0", RelationKind.ON, "2_book_0"),
        ("3_apple_0", RelationKind.IN, "1_crate_0"),
    }
    assert is_held(on_in, Relation("3_apple_0", RelationKind.ON, "2_book_0"))
    assert is_held(on_in, Relation("3_apple_0", RelationKind.IN, "1_crate_0"))
    assert not is_held(on_in, Relation("3_apple_0", RelationKind.IN, "2_book_0"))
    assert not is_held(on_in, Relation("2_book_0", RelationKind.ON, "3_apple_0"))
    ball = box("2_ball_0", (0.58, 0.3, 0.045), (0.07, 0.07, 0.07))
    upper = box("3_ball_1", (0.61, 0.3, 0.085), (0.07, 0.07, 0.07))  # in the dip beside the first one
    contacts = {"1_crate_0": (TABLE,), "2_ball_0": ("1_crate_0",), "3_ball_1": ("2_ball_0",)}
    assert [r.kind for r in links(scene_of(crate, ball, upper), contacts, {"1_crate_0": True}) if r.subject == "3_ball_1"] == [
        RelationKind.IN
    ]


def test_plates_that_nest_are_each_on_the_one_below_by_boxes_alone() -> None:
    plates = [box(f"{k}_plate_{k}", (0.6, 0.3, 0.0125 + 0.008 * k), (0.2, 0.2, 0.025)) for k in range(3)]
    assert supports(scene_of(*plates), {}) == {"0_plate_0": TABLE, "1_plate_1": "0_plate_0", "2_plate_2": "1_plate_1"}


@pytest.mark.parametrize(
    ("middle", "holds"), [((0.5, 0.32), True), ((0.1, 0.3), False), ((0.5, 0.9), False), ((0.3, 0.3), False)]
)
def test_what_lies_between_two_things_is_seen_from_them_in_opposite_directions(
    middle: tuple[float, float], holds: bool
) -> None:
    assert is_between(middle, (0.3, 0.3), (0.8, 0.35)) is holds


def test_nothing_is_in_a_thing_that_is_known_to_be_no_container() -> None:
    contacts = {"2_ball_0": ("1_bowl_0",), "1_bowl_0": (TABLE,)}
    assert Relation("2_ball_0", RelationKind.ON, "1_bowl_0") in links(scene_of(BOWL, BALL), contacts, {"1_bowl_0": False})


@pytest.mark.parametrize(("height", "kind"), [(0.004, RelationKind.ON), (0.03, RelationKind.IN)])
def test_how_deep_a_thing_is_in_a_mat_says_nothing(height: float, kind: RelationKind) -> None:
    mat = box("1_mat_0", (0.6, 0.3, height / 2), (0.2, 0.2, height))
    mouse = box("2_mouse_0", (0.6, 0.3, height / 2 + 0.02), (0.06, 0.1, 0.04 - 1e-9))
    assert Relation("2_mouse_0", kind, "1_mat_0") in links(scene_of(mat, mouse), {})


def test_a_thing_that_leans_on_a_bowl_stands_on_the_table() -> None:
    pen = box("4_pen_0", (0.72, 0.3, 0.05), (0.02, 0.02, 0.1))
    contacts = {"4_pen_0": (TABLE, "1_bowl_0"), "1_bowl_0": (TABLE,)}
    assert Relation("4_pen_0", RelationKind.ON, TABLE) in links(scene_of(BOWL, pen), contacts, {"1_bowl_0": True})


def test_a_dice_on_a_thin_floor_is_in_the_vase_though_it_almost_meets_the_table() -> None:
    dice = box("5_dice_0", (0.6, 0.3, 0.018), (0.03, 0.03, 0.03))
    contacts = {"5_dice_0": (TABLE, "1_bowl_0"), "1_bowl_0": (TABLE,)}
    assert Relation("5_dice_0", RelationKind.IN, "1_bowl_0") in links(scene_of(BOWL, dice), contacts, {"1_bowl_0": True})


@pytest.mark.parametrize(("gap", "support"), [(0.0, "1_box_0"), (0.009, "1_box_0"), (0.02, None)])
def test_without_contact_a_small_gap_still_belongs_and_a_large_one_floats(gap: float, support: str | None) -> None:
    scene = scene_of(box("1_box_0", (0.3, 0.3, 0.05)), box("2_cup_0", (0.3, 0.3, 0.15 + gap)))
    assert supports(scene, {})["2_cup_0"] == support


def test_the_plate_under_the_centre_carries_and_not_the_one_beside() -> None:
    scene = scene_of(
        box("1_plate_0", (0.3, 0.3, 0.01), (0.2, 0.2, 0.02)),
        box("2_plate_1", (0.5, 0.3, 0.01), (0.2, 0.2, 0.02)),
        box("3_cup_0", (0.43, 0.3, 0.07), (0.1, 0.1, 0.1)),
    )
    contacts = {"3_cup_0": ("1_plate_0", "2_plate_1"), "1_plate_0": (TABLE,), "2_plate_1": (TABLE,)}
    assert supports(scene, contacts) == {"1_plate_0": TABLE, "2_plate_1": TABLE, "3_cup_0": "2_plate_1"}


def test_footprints_replace_boxes_where_given() -> None:
    scene = scene_of(box("1_plate_0", (0.3, 0.3, 0.01), (0.2, 0.2, 0.02)), box("2_cup_0", (0.38, 0.3, 0.07)))
    half = np.array([(0.2, 0.2), (0.3, 0.2), (0.3, 0.4), (0.2, 0.4)])
    assert supports(scene, {})["2_cup_0"] == "1_plate_0"
    assert supports(scene, {}, {"1_plate_0": half})["2_cup_0"] is None


@pytest.mark.parametrize(
    ("dx", "dy", "kind"),
    [
        (-0.2, 0.1, RelationKind.LEFT_OF),
        (0.2, 0.1, RelationKind.RIGHT_OF),
        (0.1, -0.2, RelationKind.IN_FRONT_OF),
        (-0.1, 0.2, RelationKind.BEHIND),
    ],
)
def test_the_longer_axis_gives_the_direction(dx: float, dy: float, kind: RelationKind) -> None:
    scene = scene_of(box("1_a_0", (0.6 + dx, 0.3 + dy, 0.05)), box("2_b_0", (0.6, 0.3, 0.05)))
    assert scene_graph(scene, {}).has_edge("1_a_0", "2_b_0", key=kind)


def test_directions_end_at_their_reach_and_are_said_once() -> None:
    near, far = box("2_b_0", (0.1 + 0.48, 0.3, 0.05)), box("2_b_0", (0.1 + 0.49, 0.3, 0.05))
    first = box("1_a_0", (0.1, 0.3, 0.05))
    assert nx.number_of_edges(scene_graph(scene_of(first, near), {}).subgraph(["1_a_0", "2_b_0"])) == 1
    assert nx.number_of_edges(scene_graph(scene_of(first, far), {}).subgraph(["1_a_0", "2_b_0"])) == 0


def test_above_is_said_of_a_lamp_that_hangs_over_a_book_and_not_of_a_stack() -> None:
    book = box("1_book_0", (0.3, 0.3, 0.01), (0.2, 0.2, 0.02))
    lamp = box("2_lamp_0", (0.3, 0.3, 0.4))
    assert scene_graph(scene_of(lamp, book), {}).has_edge("2_lamp_0", "1_book_0", key=RelationKind.ABOVE)
    assert scene_graph(scene_of(book, lamp), {}).has_edge("1_book_0", "2_lamp_0", key=RelationKind.BELOW)
    stacked = scene_graph(scene_of(lamp, book), {"2_lamp_0": ("1_book_0",)})
    assert not stacked.has_edge("2_lamp_0", "1_book_0", key=RelationKind.ABOVE)


@pytest.mark.parametrize(
    ("degrees", "facing"),
    [(0, "front"), (22, "front"), (23, "front_right"), (90, "right"), (140, "back_right"), (180, "back"), (-170, "back"),
     (-135, "back_left"), (-90, "left"), (-45, "front_left"), (360, "front")],
)  # fmt: skip
def test_facing_has_eight_bins(degrees: float, facing: str) -> None:
    assert facing_of(math.radians(degrees)) == facing


def test_cells_are_a_grid_of_nine() -> None:
    points = [(0.1, 0.1), (0.6, 0.3), (1.1, 0.59), (-1.0, 9.0)]
    assert [cell_of(p, (1.2, 0.6)) for p in points] == ["front_left", "middle_middle", "back_right", "back_left"]


def test_a_row_is_evenly_spaced_within_a_tenth() -> None:
    cups = [box(f"{k}_cup_{k}", (x, 0.3, 0.05), (0.05, 0.05, 0.1)) for k, x in enumerate((0.1, 0.3, 0.51, 0.7))]
    rows = [r for r in relations_of(scene_graph(scene_of(*cups), {})) if r.kind is RelationKind.EQUALLY_SPACED]
    assert rows == [Relation("0_cup_0, 1_cup_1, 2_cup_2, 3_cup_3", RelationKind.EQUALLY_SPACED, "x")]
    uneven = [box(f"{k}_cup_{k}", (x, 0.3, 0.05)) for k, x in enumerate((0.1, 0.3, 0.6))]
    assert not any(r.kind is RelationKind.EQUALLY_SPACED for r in relations_of(scene_graph(scene_of(*uneven), {})))


def test_an_empty_scene_has_an_empty_graph() -> None:
    assert relations_of(scene_graph(scene_of(), {})) == ()


def test_a_yawed_rectangle_turns_counter_clockwise() -> None:
    turned = yawed_rectangle(box("1_a_0", (0.5, 0.5, 0.0), (0.2, 0.1, 0.1), math.pi / 2))
    assert turned[0] == pytest.approx((0.55, 0.4))


NAMES = [f"{k}_thing_{k}" for k in range(7)]
PLACES = st.tuples(
    *(st.floats(0.0, high) for high in (1.2, 0.6, 0.3)), *(st.floats(0.01, 0.3) for _ in range(3)), st.floats(-4, 4)
)


@st.composite
def layouts(draw: st.DrawFn) -> tuple[Scene, dict[str, tuple[str, ...]]]:
    names = NAMES[: draw(st.integers(1, len(NAMES)))]
    places = [draw(PLACES) for _ in names]
    objects = [box(n, p[:3], p[3:6], p[6]) for n, p in zip(names, places, strict=True)]
    touched = st.lists(st.sampled_from([*names, TABLE]), max_size=3, unique=True)
    return scene_of(*objects), {n: tuple(draw(touched)) for n in names}


@settings(max_examples=60, deadline=None)
@given(layouts())
def test_carriers_never_form_a_circle_whatever_the_contacts_say(layout: tuple[Scene, dict[str, tuple[str, ...]]]) -> None:
    scene, contacts = layout
    carriers = supports(scene, contacts)
    assert list(carriers) == [o.instance for o in scene.objects]
    tree = nx.DiGraph((child, carrier) for child, carrier in carriers.items() if carrier is not None)
    assert nx.is_directed_acyclic_graph(tree)


@settings(max_examples=40, deadline=None)
@given(layouts())
def test_relations_are_sorted_and_have_no_opposites(
    layout: tuple[Scene, dict[str, tuple[str, ...]]],
) -> None:
    scene, contacts = layout
    found = relations_of(scene_graph(scene, contacts))
    assert list(found) == sorted(set(found))
    about_places = (RelationKind.FACE_TO, RelationKind.IS_AT, RelationKind.EQUALLY_SPACED)
    pairs = [frozenset((r.subject, r.target)) for r in found if r.kind not in about_places]
    assert len(pairs) == len(set(pairs))
    assert set().union(*pairs) <= {o.instance for o in scene.objects} | {TABLE}
    assert found == relations_of(scene_graph(scene, contacts))


def _shifted(truth: dict[str, object]) -> set[str]:
    """Objects that were moved after their relation was recorded, and what stands on them."""
    defects: list[dict[str, object]] = truth["defects"]  # type: ignore[assignment]
    objects: dict[str, dict[str, object]] = truth["objects"]  # type: ignore[assignment]
    moved = {str(d["instance"]) for d in defects} | {str(n) for d in defects for n in d.get("moved_along", ())}  # type: ignore[attr-defined]
    while more := {n for n, o in objects.items() if o["parent"] in moved} - moved:
        moved |= more
    return moved


def _in_last(on_in: Collection[Relation]) -> list[Relation]:
    """The truth names the container of what lies on another thing in it."""
    return sorted(on_in, key=lambda r: r.kind is RelationKind.IN)


def test_boxes_alone_find_nearly_every_recorded_parent(measured_data: Path) -> None:
    root = measured_data
    truths = json.loads((root / "truth.json").read_text())
    dataset = MesaTaskDataset(root)
    hits = wrong = missed = 0
    for scene_id, truth in truths.items():
        scene, _ = dataset.read(scene_id)
        containers = {o.instance: dataset.annotation(o.asset_id).is_container for o in scene.objects if o.asset_id}
        found = {r.subject: (str(r.kind), r.target) for r in links(scene, {}, containers) if r.target != TABLE}
        moved = _shifted(truth)
        said = {n: (o["relation"], o["parent"]) for n, o in truth["objects"].items() if o["relation"] != "table"}
        for name in {o.instance for o in scene.objects} - moved:
            hits += name in found and found[name] == said.get(name)
            wrong += name in found and found[name] != said.get(name)
            missed += name in said and found.get(name) != said[name]
    assert 2 * hits / (2 * hits + wrong + missed) >= 0.95
