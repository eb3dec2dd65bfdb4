"""Refined layouts are judged exactly: solved only if nothing is left to certify."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.physics_corrector.certify import CorrectionStatus, constants
from models.physics_corrector.certify.correction import SolvedBy
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import steadiness
from models.physics_corrector.corrector import PhysicsCorrector, Polish
from models.physics_corrector.refinement import refiner
from models.physics_corrector.refinement.layouts import LayoutToRefine, RefinedLayout
from models.physics_corrector.refinement.refiner import Refiner
from stable_data.assets.contact_grids import ContactGrids
from stable_data.geometry.mesh import Mesh
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.sampled_collision import num_sampled_collisions
from stable_data.scene import Relation, RelationKind, Scene
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from tests.models.physics_corrector.geometry.shapes import SHAPES, scene, store, thing
from tests.models.physics_corrector.refinement.layouts import shapes_of

GRIDS = ContactGrids()
REFINER = Refiner(store(), GRIDS)

CROWDED = scene(
    thing("plate", (0.4, 0.4, 0.03, 0.2), support="table"),
    thing("ball", (0.42, 0.4, 0.11, 0), support="plate"),
    thing("cube_0", (0.52, 0.42, 0.05, 0.4), support="table"),
    thing("cube_1", (0.55, 0.48, 0.05, 0), support="table"),
    thing("cup", (0.98, 0.1, 0.05, 0), support="table"),
)
CLEAN = scene(thing("cube_0", (0.2, 0.2, 0.05, 0.1), support="table"), thing("ball", (0.7, 0.5, 0.05, 0), support="table"))


def refined(of: Scene, **options: frozenset[str]) -> RefinedLayout:
    (found,) = REFINER.refine([LayoutToRefine(of, shapes_of(of), **options)])
    assert found is not None
    return found


def test_a_crowded_table_becomes_clean_and_everything_stays_where_it_belongs() -> None:
    assert audit_scene(CROWDED, shapes_of(CROWDED)).card().clean is False
    found = refined(CROWDED)
    assert found.is_solved
    assert found.audit.card().clean
    assert found.audit == audit_scene(found.scene, shapes_of(CROWDED))
    assert {o.instance: o.supports for o in found.audit.objects}["ball"] == ("plate",)
    moved = np.linalg.norm(found.scene.poses()[:, :2] - CROWDED.poses()[:, :2], axis=1)
    assert moved.max() < 0.08
    assert (found.scene.poses()[:, 3] == CROWDED.poses()[:, 3]).all()


def test_a_clean_scene_and_fixed_objects_stay_bit_by_bit() -> None:
    assert refined(CLEAN).scene == CLEAN
    found = refined(CROWDED, fixed=frozenset({"cube_0", "plate"}))
    assert found.scene["cube_0"] is CROWDED["cube_0"]
    assert found.scene["plate"] is CROWDED["plate"]


def test_what_rests_by_its_mesh_stays_whatever_its_grid_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids have errors: here each carried object counts as not at rest, and only the ball does float."""
    stack = scene(
        thing("plate", (0.4, 0.4, 0.005, 0.2), support="table"),
        thing("cube_0", (0.4, 0.4, 0.06, 0.0), support="plate"),
        thing("cube_1", (0.6, 0.4, 0.05, 0.0), support="table"),
        thing("ball", (0.61, 0.4, 0.17, 0.0), support="cube_1"),
    )
    monkeypatch.setattr(refiner, "unrested", lambda poses, problem, carried: carried)
    found = refined(stack)
    assert found.scene["cube_0"] is stack["cube_0"]
    assert found.scene["ball"].position[2] == pytest.approx(0.15, abs=5e-4)


def test_a_pen_in_the_wall_of_its_cup_leans_inside() -> None:
    tilt = (0.0, float(np.sin(np.radians(9))), 0.0, float(np.cos(np.radians(9))))  # 18 degrees about y
    cup = thing("cup", (0.4, 0.4, 0.05, 0.0), support="table")
    pen = thing("cube", (0.44, 0.4, 0.09, 0.0), scale=(0.08, 0.08, 1.6), tilt=tilt, support="cup")
    through = replace(scene(cup, pen), relations=(Relation("cube", RelationKind.IN, "cup"),))
    assert audit_scene(through, shapes_of(through)).card().clean is False
    found = refined(through)
    assert found.audit.card().clean
    supports = {o.instance: o.supports for o in found.audit.objects}
    assert "cup" in supports["cube"]
    moved = found.scene["cube"]
    assert moved.bottom < 0.05  # not on the rim
    assert np.abs(np.subtract(moved.position[:2], (0.4, 0.4))).max() < 0.05
    bodies = bodies_of(found.scene, shapes_of(found.scene), store())
    assert settle(bodies, found.scene.table).stable


def pens(seed: int, is_cup_first: bool = True) -> Scene:
    """A cup with two pens that go through its wall, and through each other."""
    rng = np.random.default_rng(seed)
    objects = [thing("cup", (0.4, 0.4, 0.05, 0.0), support="table")]
    for k in range(2):
        angle = np.radians(rng.uniform(6, 12))
        tilt = (0.0, float(np.sin(angle)), 0.0, float(np.cos(angle)))
        x, y = 0.4 + rng.uniform(-0.04, 0.04, 2)
        pose = (float(x), float(y), 0.085, float(rng.uniform(-3, 3)))
        objects.append(thing(f"cube_{k}", pose, scale=(0.08, 0.08, 1.5), tilt=tilt, support="cup"))
    relations = tuple(Relation(f"cube_{k}", RelationKind.IN, "cup") for k in range(2))
    return replace(scene(*(objects if is_cup_first else objects[::-1])), relations=relations)


def how_steady(of: Scene) -> float:
    """The steadiness of the pen that stays least, by statics with friction."""
    meshes, poses = MeshQueries([shape.as_mesh() for shape in shapes_of(of)]), of.poses()
    numbers = range(len(poses))
    found = [
        steadiness(meshes, k, poses[k], [j for j in numbers if j != k], poses)
        for k in numbers
        if of.objects[k].support != "table"
    ]
    return min(found)


def test_solved_pens_stay_by_statics_and_some_are_turned() -> None:
    layouts = [pens(seed) for seed in range(8)]
    found = REFINER.refine([LayoutToRefine(of, shapes_of(of)) for of in layouts])
    assert any(one is not None and one.is_solved for one in found)
    turned = 0
    for of, one in zip(layouts, found, strict=True):
        assert one is not None
        if one.is_solved:
            assert one.audit.card().clean
            assert how_steady(one.scene) >= constants.STEADY
            turned += bool(np.abs(one.scene.poses()[:, 3] - of.poses()[:, 3]).max() > 1e-3)
    assert turned


def test_the_order_of_objects_does_not_decide_what_leans() -> None:
    for seed in range(4):
        first, second = (refined(pens(seed, is_cup_first=is_first)) for is_first in (True, False))
        assert first.audit.card().clean == second.audit.card().clean


def test_what_tips_takes_what_it_carries_along() -> None:
    block = thing("cube_0", (0.4, 0.4, 0.05, 0.0), support="table")
    tray = thing("plate", (0.48, 0.4, 0.105, 0.0), support="cube_0")
    content = thing("cube_1", (0.5, 0.42, 0.135, 0.0), scale=(0.5, 0.5, 0.5), support="plate")
    before, found = scene(block, tray, content), refined(scene(block, tray, content))
    assert found.audit.card().clean
    assert how_steady(found.scene) >= constants.STEADY
    moved = np.abs(np.subtract(found.scene["plate"].position, before["plate"].position)).max()
    assert moved < 0.06
    apart = [np.subtract(of["cube_1"].position, of["plate"].position) for of in (before, found.scene)]
    assert np.abs(apart[0] - apart[1])[:2].max() < 0.015


@pytest.mark.parametrize("thickness", [0.02, 0.1])
def test_thin_mats_lie_on_each_other(thickness: float) -> None:
    """0.4 m wide, and 2 or 10 mm thick: nodes of a coarser grid would all be outside."""
    scale = (2.0, 2.0, 10 * thickness)
    height = SHAPES["plate"].size[2] * scale[2]
    mats = scene(
        thing("plate_0", (0.4, 0.4, height / 2, 0.0), scale=scale, support="table"),
        thing("plate_1", (0.42, 0.41, height / 2 + 0.02, 0.1), scale=scale, support="plate_0"),
    )
    found = refined(mats)
    assert found.is_solved
    assert found.scene["plate_1"].position[2] == pytest.approx(1.5 * height, abs=4e-4)


@pytest.mark.parametrize("height", [0.03, 0.07, 0.058])
def test_what_rests_does_not_collide_by_a_rule_without_a_tolerance(height: float) -> None:
    """Cubes that float on a plate or are in it end on it, and nearer than the audit's tolerance."""
    places = {"cube_0": (0.31, 0.4), "cube_1": (0.43, 0.4), "cube_2": (0.37, 0.52)}
    cubes = [thing(name, (x, y, height, 0.3), support="plate") for name, (x, y) in places.items()]
    found = refined(scene(thing("plate", (0.4, 0.45, 0.005, 0.2), scale=(2.0, 2.0, 1.0), support="table"), *cubes))
    assert found.is_solved
    assert found.audit.pairs == ()
    assert num_sampled_collisions(found.scene, shapes_of(found.scene)) == 0
    assert all(0 < found.scene[name].position[2] - 0.06 < 2e-4 for name in places)


def test_a_scene_is_refined_alone_as_among_others() -> None:
    layouts = [LayoutToRefine(of, shapes_of(of)) for of in (CLEAN, CROWDED, CLEAN)]
    among = REFINER.refine(layouts)[1]
    assert among is not None
    assert among.scene.poses() == pytest.approx(refined(CROWDED).scene.poses(), abs=1e-5)


def test_what_cannot_become_clean_is_not_solved() -> None:
    stuck = scene(*(thing(f"plate_{k}", (0.5, 0.4, 0.005, 0.1 * k), support="table") for k in range(3)))
    found = refined(stuck, fixed=frozenset({"plate_0", "plate_1", "plate_2"}))
    assert not found.is_solved
    assert found.audit.card().clean is False


@pytest.mark.slow
def test_an_overfull_table_is_left_to_certification() -> None:
    full = scene(*(thing(f"plate_{k}", (0.5, 0.4, 0.005, 0.1 * k), support="table") for k in range(40)))
    assert REFINER.refine([LayoutToRefine(full, shapes_of(full))]) == [None]
    (done,) = PhysicsCorrector(refiner=REFINER, polish="verify").correct([full], store())
    assert done.status is CorrectionStatus.UNCLEAN


def test_a_lost_carrier_is_not_solved() -> None:
    """The cube is clean on the table, but the scene says that it is on the plate; it cannot get there, because it is fixed."""
    apart = scene(thing("plate", (0.3, 0.3, 0.005, 0)), thing("cube", (0.7, 0.5, 0.05, 0)))
    asked = replace(apart, relations=(Relation("cube", RelationKind.ON, "plate"),))
    assert refined(apart).is_solved
    found = refined(asked, fixed=frozenset({"cube", "plate"}))
    assert found.audit.card().clean
    assert not found.is_solved


def test_what_would_tip_is_moved_or_not_solved() -> None:
    over = scene(thing("plate", (0.4, 0.4, 0.005, 0), support="table"), thing("cube", (0.51, 0.4, 0.06, 0), support="plate"))
    assert audit_scene(over, shapes_of(over)).card().clean
    assert not refined(over, steady=frozenset()).is_solved or refined(over).scene["cube"].position[0] < 0.5
    assert refined(over, steady=frozenset({"cube"})).is_solved  # a simulation has said that it stays


def test_an_unknown_mesh_is_never_clean() -> None:
    lost = replace(CLEAN, objects=(CLEAN.objects[0], replace(CLEAN.objects[1], asset_id=None)))
    found = refined(lost)
    assert found.audit.card().clean is None
    assert not found.is_solved


def test_an_empty_scene_is_not_refined() -> None:
    assert REFINER.refine([LayoutToRefine(scene(), [])]) == [None]


@pytest.mark.parametrize(
    ("polish", "status", "solved_by"),
    [
        ("off", CorrectionStatus.UNCLEAN, None),
        ("verify", CorrectionStatus.CERTIFIED, SolvedBy.REFINE),
        ("certify", CorrectionStatus.CERTIFIED, SolvedBy.REFINE),
    ],
)
def test_what_follows_the_flow(polish: Polish, status: CorrectionStatus, solved_by: SolvedBy | None) -> None:
    (done,) = PhysicsCorrector(refiner=REFINER, polish=polish).correct([CROWDED], store())
    assert (done.status, done.solved_by) == (status, solved_by)
    assert done.card_after is not None
    assert done.card_after.clean is (solved_by is not None)
    assert bool(done.reason) is (solved_by is None)


def test_what_the_refinement_leaves_is_certified() -> None:
    over = scene(thing("plate", (0.4, 0.4, 0.005, 0)), thing("cube", (0.42, 0.4, 0.3, 0)))
    asked = replace(over, relations=(Relation("cube", RelationKind.ON, "plate"),))
    by = {p: PhysicsCorrector(refiner=REFINER, polish=p).correct([asked, CLEAN], store()) for p in ("verify", "certify")}
    assert [done.solved_by for done in by["certify"]] == [SolvedBy.REFINE, SolvedBy.START]
    (without,) = PhysicsCorrector().correct([asked], store())
    assert without.solved_by is SolvedBy.CERTIFY
    assert without.certified is not None
    assert by["certify"][0].certified is not None
    assert by["certify"][0].certified["cube"].position == pytest.approx(without.certified["cube"].position, abs=1e-3)


def test_grids_are_read_from_their_files_and_built_again_if_these_are_broken(tmp_path: Path) -> None:
    mesh = Mesh(SHAPES["cup"].vertices, SHAPES["cup"].faces)
    first = ContactGrids(tmp_path).grid(mesh, (0, 0, 0), is_sheet=False)
    (file,) = tmp_path.iterdir()
    read = ContactGrids(tmp_path).grid(mesh, (0, 0, 0), is_sheet=False)
    assert np.array_equal(read.values, first.values)
    assert np.array_equal(read.origin, first.origin)
    assert (read.spacing, read.extent, read.max_error) == (first.spacing, first.extent, first.max_error)
    file.write_bytes(b"no grid")
    again = ContactGrids(tmp_path).grid(mesh, (0, 0, 0), is_sheet=False)
    assert np.array_equal(again.values, first.values)
    assert file.stat().st_size > 1000
    ContactGrids(tmp_path).grid(mesh, (1, 0, 0), is_sheet=False)
    assert len(list(tmp_path.iterdir())) == 2


def test_few_grids_stay_in_memory(tmp_path: Path) -> None:
    grids = ContactGrids(tmp_path, max_bytes=1)
    meshes = [Mesh(SHAPES[name].vertices, SHAPES[name].faces) for name in ("cup", "cube")]
    first = [grids.grid(mesh, (0, 0, 0), is_sheet=False) for mesh in meshes]
    assert len(grids._grids) == 1
    assert np.array_equal(grids.grid(meshes[0], (0, 0, 0), is_sheet=False).values, first[0].values)
