"""What certify brings to rest stays at rest: by statics with friction, and by an engine."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from models.physics_corrector.certify import certify
from models.physics_corrector.certify.constants import FALLS, STEADY
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import centre_of_mass, stands_alone, steadiness
from models.physics_corrector.certify.support_inference import is_hollow
from stable_data.geometry.convex_decomposition import convex_parts
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Scene
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, RigidBody, settle
from tests.models.physics_corrector.certify.things import ball, bowl, box, cylinder, laid, mesh_shape

TABLE_BOX, SAUCER = box(0.1, 0.1, 0.05), bowl(0.075, 0.015)
CUP = bowl(0.04, 0.1, 0.003)
LEAN = np.radians(20)


def pen() -> Shape:
    mesh = trimesh.creation.cylinder(0.005, 0.16, sections=16)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(LEAN, (0, 1, 0)))
    return mesh_shape(mesh)


def apple(radius: float) -> Shape:
    """A ball with a flat bottom: a faceted ball would roll on to its next facet anywhere."""
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.vertices[:, 2] = np.maximum(mesh.vertices[:, 2], -0.9 * radius)
    return mesh_shape(mesh)


def how_steady(shapes: list[Shape], *places: tuple[float, float, float]) -> float:
    """Of the last of some things with their bottoms at places (x, y, z)."""
    poses = np.array([(x, y, z + float(s.size[2]) / 2, 0.0) for s, (x, y, z) in zip(shapes, places, strict=True)])
    k = len(shapes) - 1
    return steadiness(MeshQueries(shapes), k, poses[k], range(k), poses)


def bodies(scene: Scene, shapes: list[Shape]) -> list[RigidBody]:
    cut = {id(s): convex_parts(Mesh(s.vertices, s.faces)).parts for s in shapes}
    shape = dict(zip((o.instance for o in scene.objects), shapes, strict=True))
    return [RigidBody(o.instance, cut[id(shape[o.instance])], 0.2, o.position, o.yaw) for o in scene.objects]


def movers(scene: Scene, shapes: list[Shape]) -> list[str]:
    """What an engine moves."""
    result = settle(bodies(scene, shapes), scene.table)
    return [n for n, m, t in zip(result.names, result.moves, result.turns, strict=True) if m > MOVE_LIMIT or t > TURN_LIMIT]


def test_centre_of_mass_of_a_cone_is_at_a_quarter() -> None:
    cone = mesh_shape(trimesh.creation.cone(0.03, 0.08, sections=64))
    assert centre_of_mass(cone) == pytest.approx([0, 0, -0.02], abs=1e-4)


def test_a_slope_at_which_a_block_tips() -> None:
    # Its centre is 15 mm over the support and 20 mm inside the edge.
    assert how_steady([TABLE_BOX, box(0.06, 0.06, 0.03)], (0, 0, 0), (0.04, 0, 0.0501)) == pytest.approx(10 / 15, rel=0.05)
    assert how_steady([TABLE_BOX, box(0.06, 0.06, 0.03)], (0, 0, 0), (0.06, 0, 0.0501)) < FALLS


def test_a_block_tips_by_the_centre_of_mass_that_is_known_of_it() -> None:
    # Its centre is moved 6 mm towards the edge of the support, and 5 mm down.
    loaded = replace(box(0.06, 0.06, 0.03), center_of_mass=np.array([0.006, 0.0, -0.005]))
    assert how_steady([TABLE_BOX, loaded], (0, 0, 0), (0.04, 0, 0.0501)) == pytest.approx(4 / 10, rel=0.05)
    assert how_steady([TABLE_BOX, loaded], (0, 0, 0), (0.046, 0, 0.0501)) < FALLS


def test_a_tray_on_a_foot_stands_unless_its_mass_is_on_one_side() -> None:
    foot, tray = trimesh.creation.box((0.03, 0.03, 0.05)), trimesh.creation.box((0.2, 0.2, 0.01))
    tray.apply_translation((0, 0, 0.03))
    whole = mesh_shape(trimesh.util.concatenate([foot, tray]))
    assert stands_alone(whole)
    assert not stands_alone(replace(whole, center_of_mass=np.array([0.05, 0.0, 0.02])))


def test_a_ball_on_an_edge_falls_and_in_a_bowl_stays() -> None:
    assert how_steady([TABLE_BOX, ball(0.03)], (0, 0, 0), (0.055, 0, 0.0495)) < STEADY
    assert how_steady([bowl(), ball(0.03)], (0, 0, 0), (0, 0, 0.00405)) >= STEADY


def test_a_ball_between_three_others_stays_and_between_two_does_not() -> None:
    radius = 0.03
    around = [
        (1.02 * radius * 2 / np.sqrt(3) * np.cos(a), 1.02 * radius * 2 / np.sqrt(3) * np.sin(a), 0.0)
        for a in (0, 2.0944, 4.1888)
    ]
    height = float(np.sqrt((2 * radius) ** 2 - (1.02 * radius * 2 / np.sqrt(3)) ** 2))
    balls = [ball(radius)] * 4
    assert how_steady(balls, *around, (0, 0, height)) >= STEADY
    assert how_steady(balls[1:], *around[1:], (0, 0, height)) < STEADY


def test_a_pen_cannot_stand_but_leans_in_its_cup() -> None:
    assert not stands_alone(pen())
    assert stands_alone(CUP)
    scene, shapes = laid(("cup", CUP, 0.4, 0.3, 0.0), ("pen", pen(), 0.47, 0.31, 0.004), ("far", TABLE_BOX, 0.1, 0.1, 0.0))
    result = certify(scene, shapes)
    assert result.scene is not None
    assert result.audit is not None
    assert {o.instance: o.supports for o in result.audit.objects}["pen"] == ("cup",)
    assert movers(result.scene, shapes) == []


def test_a_pen_that_leans_moves_with_its_cup() -> None:
    torn, shapes = laid(("cup", CUP, 0.4, 0.3, 0.0), ("pen", pen(), 0.47, 0.31, 0.004))
    leaning = certify(torn, shapes).scene
    assert leaning is not None
    wall = laid(("wall", box(0.06, 0.2, 0.2), 0.35, 0.3, 0.0))
    both = Scene("pushed", leaning.table, (*leaning.objects, *wall[0].objects))
    pushed = certify(both, [*shapes, *wall[1]]).scene
    assert pushed is not None
    before, after = (np.subtract(s["pen"].position, s["cup"].position) for s in (leaning, pushed))
    assert np.linalg.norm(np.subtract(pushed["cup"].position, leaning["cup"].position)) > 0.005
    assert after == pytest.approx(before, abs=1e-9)


def test_a_cup_on_the_rim_of_its_saucer_goes_to_the_middle() -> None:
    narrow = cylinder(0.02, 0.08)
    scene, shapes = laid(("saucer", SAUCER, 0.4, 0.3, 0.0), ("cup", narrow, 0.465, 0.3, 0.0045))
    result = certify(scene, shapes)
    assert result.scene is not None
    assert np.hypot(*np.subtract(result.scene["cup"].position, result.scene["saucer"].position)[:2]) < 0.0525
    assert result.scene["cup"].position[2] < 0.05
    assert movers(result.scene, shapes) == []


def test_bowls_that_are_askew_nest_again() -> None:
    dish = mesh_shape(
        trimesh.creation.revolve(
            np.array([(0, 0), (0.04, 0), (0.08, 0.05), (0.076, 0.05), (0.038, 0.004), (0, 0.004)]), sections=32
        )
    )
    scene, shapes = laid(("low", dish, 0.4, 0.3, 0.0), ("high", dish, 0.415, 0.3, 0.006))
    result = certify(scene, shapes)
    assert result.scene is not None
    apart = np.subtract(result.scene["high"].position, result.scene["low"].position)
    assert np.hypot(*apart[:2]) < 2e-3
    assert apart[2] < 0.009
    assert movers(result.scene, shapes) == []


def test_thin_walls_make_a_hollow_and_bumps_do_not() -> None:
    assert is_hollow(bowl(0.04, 0.1, 0.001))
    square = trimesh.creation.box((0.08, 0.08, 0.1)).difference(
        trimesh.creation.box((0.077, 0.077, 0.1), trimesh.transformations.translation_matrix((0, 0, 0.004)))
    )
    assert is_hollow(mesh_shape(square))
    assert not is_hollow(cylinder(0.04, 0.1))
    channel = trimesh.creation.box((0.08, 0.08, 0.1)).difference(
        trimesh.creation.box((0.1, 0.06, 0.1), trimesh.transformations.translation_matrix((0, 0, 0.04)))
    )
    assert not is_hollow(mesh_shape(channel))


def drawn(seed: int) -> tuple[Scene, list[Shape]]:
    """Cups with pens, bowls with apples, plates with cups, all shaken."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for x, y in itertools.product((0.15, 0.4, 0.65), (0.15, 0.45))]
    kinds: list[list[tuple[str, Shape, FloatArray]]] = [
        [("cup", CUP, np.zeros(3)), ("pen", pen(), np.array([0.005, 0, 0.004]))],
        [
            ("bowl", bowl(), np.zeros(3)),
            ("apple", apple(0.025), np.array([0.03, 0, 0.005])),
            ("apple2", apple(0.03), np.array([-0.03, 0, 0.005])),
        ],
        [("plate", cylinder(0.09, 0.012), np.zeros(3)), ("mug", cylinder(0.04, 0.1), np.array([0, 0, 0.0125]))],
        [("block", TABLE_BOX, np.zeros(3)), ("on", box(0.05, 0.05, 0.05), np.array([0, 0, 0.051]))],
    ]
    things = []
    for n, (x, y) in enumerate(places):
        for name, shape, (dx, dy, dz) in kinds[int(rng.integers(len(kinds)))]:
            a, b = rng.normal(0, 0.02, 2)
            things.append((f"{name}_{n}", shape, x + dx + a, y + dy + b, float(dz)))
    yaws = {t[0]: float(rng.normal(0, 0.1)) for t in things}
    return laid(*things, yaws=yaws)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_whatever_was_moved_rests_in_the_engine(seed: int) -> None:
    scene, shapes = drawn(seed)
    result = certify(scene, shapes)
    assert result.scene is not None
    there = {o.instance for o in result.scene.objects}
    left = [s for o, s in zip(scene.objects, shapes, strict=True) if o.instance in there]
    assert movers(result.scene, left) == []
