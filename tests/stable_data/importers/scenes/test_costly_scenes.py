"""Scene files of a few bytes that ask for much time or memory: each is refused soon, and the limit is named."""

from pathlib import Path
from typing import Any

import pytest

from stable_data.errors import StableDataError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.gltf_nodes import PHYSICS
from stable_data.importers.scenes.gltf_scenes import read_gltf_scene
from stable_data.importers.scenes.mjcf_scenes import read_mjcf_scene
from stable_data.importers.scenes.usd_scenes import _round_solid, read_usd_scene
from stable_data.limits import SETTING, FileLimits
from stable_data.scene import FloatArray
from tests.bounds import limit, little_memory, soon
from tests.scene_files import WEDGE, cuboid, gltf_parts, write_gltf


def named(limit: str) -> str:
    return rf"\({limit} in {SETTING}\)"


def test_colliders_that_all_name_one_large_tree_are_counted(tmp_path: Path) -> None:
    """Each once walked the whole tree: 3,000 colliders over 3,000 nodes took minutes and gigabytes."""
    count = 3000
    tree: list[dict[str, Any]] = [{"name": "free-rigid", "mesh": 0, "children": [1, *range(2, 2 + count)]}, {"children": []}]
    collider = {"extensions": {PHYSICS: {"collider": {"geometry": {"node": 0}}}}}
    write_gltf(tmp_path / "a.gltf", *gltf_parts([cuboid(1, 1, 1)], [*tree, *[collider] * count]), indent=None)
    with soon(8.0), pytest.raises(StableDataError, match=named(r"gltf_scene\.max_nodes")) as caught:
        read_gltf_scene(Boundary(tmp_path), "a.gltf")
    assert caught.value.code == "file_too_large"


@pytest.mark.sim
@pytest.mark.parametrize(
    ("body", "more", "name"),
    [
        ("".join(f"<body pos='{k} 0 1'><freejoint/><geom size='.1'/></body>" for k in range(8)), "", "max_free_bodies"),
        (
            "<body><freejoint/><geom size='.1'/></body>",
            "<keyframe>" + "".join(f"<key name='k{k}'/>" for k in range(8)) + "</keyframe>",
            "max_poses",
        ),
    ],
)
def test_bodies_and_keyframes_of_a_mujoco_scene_are_limited(
    body: str, more: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.xml").write_text(f"<mujoco><worldbody>{body}</worldbody>{more}</mujoco>")
    read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    limit(monkeypatch, "scene_file", **{name: 7})
    with pytest.raises(StableDataError, match=named(rf"scene_file\.{name}")) as caught:
        read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    assert caught.value.code == "file_too_large"


@pytest.mark.sim
def test_many_bodies_and_motors_are_looked_through_once(tmp_path: Path) -> None:
    """Each motor was once compared with each body: 8 s."""
    box = "<geom type='box' size='.1 .1 .1'/>"
    bodies = "".join(f"<body pos='{k} 0 1'><freejoint name='f{k}'/>{box}</body>" for k in range(200))
    arm = f"<body><joint name='j'/>{box}</body>"
    motors = "<motor joint='j'/>" * 8000
    (tmp_path / "scene.xml").write_text(f"<mujoco><worldbody>{bodies}{arm}</worldbody><actuator>{motors}</actuator></mujoco>")
    with soon(5.0):
        scene = read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    assert len(scene.free_bodies) == 200


FREE = "<body pos='0 0 9'><freejoint/><geom type='box' size='.1 .1 .1'/></body>"


@pytest.mark.sim
def test_shapes_of_copies_are_made_once_and_their_faces_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hull of each copy was once made anew: 100,000 spheres out of 500 bytes took 14 GB and a quarter of an hour."""
    (tmp_path / "wedge.obj").write_text(WEDGE)
    geoms = "<geom size='.1'/><geom type='box' size='.1 .1 .2'/><geom type='mesh' mesh='wedge'/>"
    asset = "<asset><mesh name='wedge' file='wedge.obj'/></asset>"
    body = f"<replicate count='100'>{geoms}</replicate>"
    (tmp_path / "scene.xml").write_text(f"<mujoco>{asset}<worldbody>{body}{FREE}</worldbody></mujoco>")
    made, hull_of = [], convex_solids.hull_of

    def made_hull(points: FloatArray) -> Mesh | None:
        made.append(points)
        return hull_of(points)

    monkeypatch.setattr(convex_solids, "hull_of", made_hull)
    scene = read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    assert ([len(one.parts) for one in scene.file.bodies], len(made)) == ([300, 1], 4)
    num_faces = sum(len(part.faces) for one in scene.file.bodies for part in one.parts)
    limit(monkeypatch, "model", max_faces=num_faces)
    read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    limit(monkeypatch, "model", max_faces=num_faces - 1)
    with pytest.raises(StableDataError, match=named(r"model\.max_faces")) as caught:
        read_mjcf_scene(Boundary(tmp_path), "scene.xml")
    assert caught.value.code == "mesh_too_large"


@pytest.mark.sim
def test_a_long_name_of_a_body_is_not_copied_for_each_of_its_shapes(tmp_path: Path) -> None:
    name = "A" * 100_000
    (tmp_path / "wedge.obj").write_text(WEDGE)
    asset = "<asset><mesh name='thread' file='wedge.obj' scale='1 1e-8 1e-8' inertia='shell'/></asset>"
    geoms = "<geom type='plane' size='1 1 1'/><geom type='mesh' mesh='thread'/>"
    body = f"<body name='{name}'><geom type='box' size='1 1 1'/><replicate count='300'>{geoms}</replicate></body>"
    (tmp_path / "scene.xml").write_text(f"<mujoco>{asset}<worldbody>{body}{FREE}</worldbody></mujoco>")
    boundary = Boundary(tmp_path, FileLimits(max_file_bytes=10**6))  # of which a buffer is reserved for each file
    with little_memory(6 * 10**6):
        file = read_mjcf_scene(boundary, "scene.xml").file
    assert ({ground.owner for ground in file.grounds}, len(file.grounds)) == ({name}, 300)
    assert [notice.code for notice in file.notices] == ["mesh_empty"]


def test_references_that_double_at_each_level_are_refused_before_usd_composes_them(tmp_path: Path) -> None:
    """Within a layer, and over files."""
    pytest.importorskip("pxr")
    for k in range(30):
        twice = "".join(f'def "{side}" (references = @l{k + 1}.usda@) {{}}\n' for side in "ab")
        (tmp_path / f"l{k}.usda").write_text(f'#usda 1.0\n(defaultPrim = "P")\ndef Xform "P" {{\n{twice}}}\n')
    (tmp_path / "l30.usda").write_text('#usda 1.0\n(defaultPrim = "P")\ndef Cube "P" {}\n')
    with soon(8.0), pytest.raises(StableDataError, match=named(r"model\.max_prims")) as caught:
        read_usd_scene(Boundary(tmp_path), "l0.usda")
    assert caught.value.code == "mesh_too_large"


def references(kind: str, content: str = "", levels: int = 3) -> str:
    """A layer of USD with a free body and a collider that is referred to 2 ** levels times."""
    doubled = "".join(
        f'class "L{k}" {{\ndef "a" (references = </L{k + 1}>) {{}}\ndef "b" (references = </L{k + 1}>) {{}}\n}}\n'
        for k in range(levels)
    )
    return (
        '#usda 1.0\n(defaultPrim = "W"\n metersPerUnit = 1\n upAxis = "Z")\n'
        'def Xform "W" {\ndef Cube "free" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"]) {}\n'
        'def "many" (references = </L0>) {}\n}\n'
        f'{doubled}class {kind} "L{levels}" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {{\n{content}\n}}\n'
    )


TETRAHEDRON = (
    "point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]\n"
    "int[] faceVertexCounts = [3, 3, 3, 3]\nint[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]"
)


@pytest.mark.parametrize(
    ("kind", "content", "most"),
    [("Sphere", "", 20_000), ("Mesh", TETRAHEDRON, 35)],
)
def test_shapes_of_a_usd_scene_count_as_often_as_they_are_referred_to(
    kind: str, content: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kilobyte of references once made 100,000 spheres: 14 GB."""
    pytest.importorskip("pxr")
    (tmp_path / "a.usda").write_text(references(kind, content))
    assert len(read_usd_scene(Boundary(tmp_path), "a.usda").file.bodies) == 1 + 8
    limit(monkeypatch, "model", max_faces=most)
    with pytest.raises(StableDataError, match=named(r"model\.max_faces")) as caught:
        read_usd_scene(Boundary(tmp_path), "a.usda")
    assert caught.value.code == "mesh_too_large"


def test_polygons_without_a_triangle_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They once made up for triangles of other polygons."""
    pytest.importorskip("pxr")
    content = TETRAHEDRON.replace("[3,", "[0, 0, 0, 0, 3,")
    (tmp_path / "a.usda").write_text(references("Mesh", content))
    limit(monkeypatch, "model", max_collider_faces=7)
    with pytest.raises(StableDataError, match=named(r"model\.max_collider_faces")):
        read_usd_scene(Boundary(tmp_path), "a.usda")


def test_equal_shapes_of_a_usd_scene_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr")
    _round_solid.cache_clear()
    made: list[str] = []

    def noted(name: str, function: Any) -> Any:
        def call(*arguments: Any) -> Any:
            made.append(name)
            return function(*arguments)

        return call

    monkeypatch.setattr(convex_solids, "ellipsoid", noted("ellipsoid", convex_solids.ellipsoid))
    monkeypatch.setattr("stable_data.importers.scenes.usd_scenes.repair_mesh", noted("repair", repair_mesh))
    (tmp_path / "a.usda").write_text(references("Sphere", "double radius = 0.0625123"))
    (tmp_path / "b.usda").write_text(references("Mesh", TETRAHEDRON))
    for name in ("a.usda", "b.usda"):
        bodies = read_usd_scene(Boundary(tmp_path), name).file.bodies
        assert len(bodies) == 1 + 8
        assert all(len(body.parts) == 1 for body in bodies)
    assert made == ["ellipsoid", "repair"]


def test_implicit_shapes_of_a_gltf_scene_count_as_often_as_they_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have no triangles in the file, but a ball becomes a mesh of thousands."""
    ball: dict[str, Any] = {"extensions": {PHYSICS: {"collider": {"geometry": {"shape": 0}}}}}
    root: dict[str, Any] = {"name": "free-rigid", "mesh": 0, "children": list(range(1, 9))}
    shapes = {"KHR_implicit_shapes": {"shapes": [{"type": "sphere", "sphere": {"radius": 0.1}}]}}
    write_gltf(tmp_path / "a.gltf", *gltf_parts([cuboid(1, 1, 1)], [root, *[ball] * 8], extensions=shapes))
    (body,) = read_gltf_scene(Boundary(tmp_path), "a.gltf").file.bodies
    assert len(body.parts) == 8
    limit(monkeypatch, "model", max_faces=20_000)
    with pytest.raises(StableDataError, match=named(r"model\.max_faces")) as caught:
        read_gltf_scene(Boundary(tmp_path), "a.gltf")
    assert caught.value.code == "mesh_too_large"


def test_joints_are_looked_up_in_time_that_grows_with_their_number(tmp_path: Path) -> None:
    """Each joint was once compared with all bodies."""
    pytest.importorskip("pxr")
    count = 900
    bodies = "".join(
        f'def Cube "b{k}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"])\n'
        f"{{ double size = 0.1\n double3 xformOp:translate = ({k}, 0, 1)\n uniform token[] xformOpOrder = ["
        '"xformOp:translate"]\n}\n'
        for k in range(count)
    )
    joints = "".join(
        f'def PhysicsFixedJoint "j{k}" {{ rel physics:body0 = </W/b{k}>\n rel physics:body1 = </W/b{k + 1}>\n}}\n'
        for k in range(1, count - 1)
    )
    (tmp_path / "a.usda").write_text(
        '#usda 1.0\n(defaultPrim = "W"\n metersPerUnit = 1\n upAxis = "Z")\ndef Xform "W" {\n' + bodies + joints + "}\n"
    )
    with soon(25.0):
        scene = read_usd_scene(Boundary(tmp_path), "a.usda")
    assert [body.name for body in scene.file.bodies if body.is_free] == ["/W/b0"]
