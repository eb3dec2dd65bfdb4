"""Directions and cells that an edit asks for hold after the certification, and what it does not mention hardly moves."""

from dataclasses import replace

import numpy as np
import pytest

from models.physics_corrector.certify import CertifyOptions, certify
from models.physics_corrector.certify.asked_relations import AskedRelations
from models.physics_corrector.certify.layout_state import LayoutState
from models.physics_corrector.certify.support_inference import SupportEdge, known_carriers
from stable_data.scene import TABLE, Relation, RelationKind, Scene
from stable_data.scene_graph.relations import CELLS, cell_bounds, cell_of, direction_of
from tests.models.physics_corrector.certify.test_certify import moved
from tests.models.physics_corrector.certify.things import ball, bowl, box, cylinder, laid


def direction(scene: Scene, one: str, other: str) -> RelationKind | None:
    dx, dy, _ = np.subtract(scene[one].position, scene[other].position)
    return direction_of(dx, dy)


def test_the_bounds_of_a_cell_are_those_of_its_name() -> None:
    size = (0.9, 0.6)
    for cell in CELLS:
        low, high = cell_bounds(cell, size)
        assert cell_of(tuple(low + 1e-6), size) == cell_of(tuple(high - 1e-6), size) == cell
    assert np.allclose(cell_bounds("front_right", size), [[0.6, 0.0], [0.9, 0.2]])


def test_a_thing_goes_into_the_cell_that_is_asked_for_though_the_nearest_free_place_is_outside() -> None:
    # The vase is planned at the border of the cell, where the box leaves no room.
    scene, shapes = laid(("vase", cylinder(0.04, 0.2), 0.3, 0.3, 0), ("box", box(0.14, 0.3, 0.1), 0.34, 0.3, 0))
    asked = Relation("vase", RelationKind.IS_AT, "middle_middle")
    fixed = frozenset({"box"})
    assert cell_of(certify(scene, shapes, CertifyOptions(fixed=fixed)).scene["vase"].position, (0.8, 0.6)) == "middle_left"  # type: ignore[index]
    done = certify(scene, shapes, CertifyOptions(fixed=fixed, asked=frozenset({asked})))
    assert done.scene is not None
    assert cell_of(done.scene["vase"].position, (0.8, 0.6)) == "middle_middle"
    assert moved(scene, done.scene)["box"] == 0.0


def test_a_clean_layout_without_what_is_asked_is_not_enough() -> None:
    scene, shapes = laid(("cup", cylinder(0.04, 0.1), 0.2, 0.1, 0), ("plate", cylinder(0.1, 0.02), 0.5, 0.3, 0))
    for kind in (RelationKind.LEFT_OF, RelationKind.RIGHT_OF, RelationKind.IN_FRONT_OF, RelationKind.BEHIND):
        options = CertifyOptions(fixed=frozenset({"plate"}), asked=frozenset({Relation("cup", kind, "plate")}))
        done = certify(scene, shapes, options)
        assert done.scene is not None
        assert direction(done.scene, "cup", "plate") is kind
    assert certify(scene, shapes).scene is scene


def test_a_cell_without_room_is_infeasible() -> None:
    scene, shapes = laid(("cup", cylinder(0.04, 0.1), 0.4, 0.3, 0), zone=(0.2, 0.6, 0.15, 0.45))
    asked = frozenset({Relation("cup", RelationKind.IS_AT, "middle_middle")})
    assert certify(scene, shapes, CertifyOptions(when_full="infeasible", asked=asked)).scene is None
    assert certify(scene, shapes, CertifyOptions(when_full="infeasible")).scene is not None


@pytest.mark.parametrize("kind", [RelationKind.LEFT_OF, RelationKind.RIGHT_OF])
def test_a_side_on_a_common_carrier_is_found(kind: RelationKind) -> None:
    scene, shapes = laid(
        ("tray", box(0.3, 0.16, 0.01), 0.4, 0.3, 0),
        ("figure", box(0.05, 0.05, 0.1), 0.4, 0.3, 0.01),
        ("candle", cylinder(0.03, 0.04), 0.4, 0.33, 0.01),
        relations=(("candle", RelationKind.ON, "tray"),),
    )
    options = CertifyOptions(fixed=frozenset({"tray", "figure"}), asked=frozenset({Relation("candle", kind, "figure")}))
    done = certify(scene, shapes, options)
    assert done.scene is not None
    assert direction(done.scene, "candle", "figure") is kind
    assert done.scene["candle"].bottom == pytest.approx(0.01, abs=1e-3)


def test_where_a_thing_stood_beside_others_does_not_bind_what_is_asked_of_it() -> None:
    scene, shapes = laid(
        ("a", box(0.1, 0.1, 0.1), 0.2, 0.2, 0), ("b", box(0.1, 0.1, 0.1), 0.4, 0.2, 0), ("c", ball(0.04), 0.6, 0.2, 0)
    )
    layout = LayoutState(scene, shapes, [SupportEdge()] * 3, frozenset())
    asked = Relation("a", RelationKind.BEHIND, "c")
    old = [Relation("a", RelationKind.LEFT_OF, "b"), Relation("b", RelationKind.LEFT_OF, "c")]
    assert AskedRelations(layout, [asked]).with_others(old) == [asked, old[1]]
    assert AskedRelations(layout, []).with_others(old) == old


def test_a_still_thing_is_lowered_where_it_is_though_it_would_tip() -> None:
    # Its centre is 2 mm inside the edge of the block, and it hovers by 5 mm.
    scene, shapes = laid(("block", box(0.1, 0.1, 0.05), 0.4, 0.3, 0), ("carton", box(0.1, 0.1, 0.12), 0.448, 0.3, 0.055))
    assert moved(scene, certify(scene, shapes).scene or scene)["carton"] > 0.01
    still = certify(scene, shapes, CertifyOptions(fixed=frozenset({"block"}), still=frozenset({"carton"})))
    assert still.scene is not None
    assert still.scene["carton"].position[:2] == scene["carton"].position[:2]
    assert still.scene["carton"].bottom == pytest.approx(0.05, abs=1e-3)


def test_still_things_keep_the_carriers_that_the_scene_states() -> None:
    scene, shapes = laid(
        ("bowl", bowl(), 0.4, 0.3, 0),
        ("lemon", ball(0.02), 0.4, 0.3, 0.03),
        ("lid", box(0.2, 0.2, 0.01), 0.4, 0.3, 0.06),
        ("cup", ball(0.03), 0.6, 0.3, 0),
    )
    supports = {"bowl": TABLE, "lemon": "bowl", "lid": "bowl", "cup": None}
    scene = replace(scene, objects=tuple(replace(o, support=supports[o.instance]) for o in scene.objects))
    everything = frozenset(supports)
    assert known_carriers(scene, shapes, everything, {}) == {0: SupportEdge(), 1: SupportEdge(0, True), 2: SupportEdge(0)}
    assert known_carriers(scene, shapes, frozenset({"lemon"}), {}) == {1: SupportEdge(0, True)}
    wanted = {0: SupportEdge(1)}  # a carrier that closes a cycle is left out
    assert known_carriers(scene, shapes, frozenset({"bowl", "lemon"}), wanted) == wanted


def test_of_two_things_in_each_other_the_still_one_stays() -> None:
    scene, shapes = laid(("one", box(0.1, 0.1, 0.1), 0.4, 0.3, 0), ("other", box(0.1, 0.1, 0.1), 0.46, 0.3, 0))
    done = certify(scene, shapes, CertifyOptions(still=frozenset({"one"})))
    assert done.scene is not None
    assert moved(scene, done.scene)["one"] < 0.003
    assert moved(scene, done.scene)["other"] > 0.03
