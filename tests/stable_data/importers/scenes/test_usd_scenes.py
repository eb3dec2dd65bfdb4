"""USD scenes: bodies in metres and z up whatever the stage, and poses written as a layer over the original."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError, SceneError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.importers.scenes.scene_file import BodyPose, SceneBody
from stable_data.importers.scenes.supports import find_supports
from stable_data.importers.scenes.usd_scenes import read_usd_scene, write_overrides
from stable_data.rotations import quat_of
from tests.scene_files import write_stage

GOAL: BodyPose = ((0.4, 0.3, 0.9), quat_of(Rotation.from_euler("xyz", [0.1, 0.2, 0.3])))


@pytest.mark.parametrize(("is_y_up", "unit"), [(False, 1.0), (True, 0.01), (True, 1.0), (False, 0.001)])
def test_axes_and_units_of_the_stage_do_not_matter(tmp_path: Path, *, is_y_up: bool, unit: float) -> None:
    write_stage(tmp_path / "a.usda", is_y_up=is_y_up, unit=unit)
    file = read_usd_scene(Boundary(tmp_path), "a.usda").file
    bodies = {body.name: body for body in file.bodies}
    assert [name for name, body in bodies.items() if not body.is_free] == ["/World/table"]
    np.testing.assert_allclose(bodies["/World/floating"].position, (0.7, 0.1, 1.0), atol=1e-6)
    bottle = bodies["/World/bottle"]
    np.testing.assert_allclose(np.ptp(bottle.placed(bottle.parts[0]), axis=0), (0.2, 0.06, 0.06), atol=1e-4)
    assert bodies["/World/box_a"].mass == pytest.approx(0.3)
    up = Rotation.from_quat(bodies["/World/fine"].quat_xyzw).apply([0, 0, 1])
    np.testing.assert_allclose(up, (0, 0, 1), atol=1e-9)
    (surface,) = find_supports(file)
    assert surface.size_xy == pytest.approx((1.0, 0.6), abs=1e-3)
    assert surface.origin == pytest.approx((0.0, -0.1, 0.72), abs=1e-3)


@pytest.mark.parametrize("is_y_up", [False, True])
def test_overrides_leave_the_original_and_all_else_as_it_is(tmp_path: Path, *, is_y_up: bool) -> None:
    write_stage(tmp_path / "a.usda", is_y_up=is_y_up, unit=0.01 if is_y_up else 1.0)
    before = (tmp_path / "a.usda").read_bytes()
    scene = read_usd_scene(Boundary(tmp_path), "a.usda")
    (name, content), *rest = write_overrides(scene, {"/World/bottle": GOAL}).items()
    assert (name, rest) == ("a_repaired.usda", [])
    (tmp_path / name).write_bytes(content)
    assert (tmp_path / "a.usda").read_bytes() == before
    again = read_usd_scene(Boundary(tmp_path), name)
    assert (again.unit, again.is_y_up) == (scene.unit, scene.is_y_up)
    bodies, was = ({b.name: b for b in s.file.bodies} for s in (again, scene))
    np.testing.assert_allclose(bodies["/World/bottle"].position, GOAL[0], atol=1e-6)
    off = Rotation.from_quat(bodies["/World/bottle"].quat_xyzw) * Rotation.from_quat(GOAL[1]).inv()
    assert off.magnitude() < 1e-6
    assert all(bodies[n].position == was[n].position for n in was if n != "/World/bottle")
    assert Usd.Stage.Open(str(tmp_path / name)).GetDefaultPrim().GetName() == "World"
    assert write_overrides(scene, {"/World/bottle": GOAL})[name] == content


def test_layers_outside_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "inside").mkdir()
    write_stage(tmp_path / "other.usda")
    for reference in ("../other.usda", str(tmp_path / "other.usda")):
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.subLayerPaths.append(reference)
        (tmp_path / "inside" / "a.usda").write_text(layer.ExportToString())
        with pytest.raises(MeshError) as caught:
            read_usd_scene(Boundary(tmp_path / "inside"), "a.usda")
        assert caught.value.code == "path_outside"


def test_referenced_bodies_are_read_and_moved(tmp_path: Path) -> None:
    write_stage(tmp_path / "parts.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    holder = UsdGeom.Xform.Define(stage, "/Room")
    holder.AddTranslateOp().Set(Gf.Vec3d(1, 2, 0))
    holder.AddRotateZOp().Set(90)
    holder.GetPrim().GetReferences().AddReference("./parts.usda")
    stage.GetRootLayer().Save()
    scene = read_usd_scene(Boundary(tmp_path), "a.usda")
    assert scene.paths == ("a.usda", "parts.usda")
    write_overrides(scene, {"/Room/box_a": GOAL})


def test_joined_bodies_are_fixed_and_visible_shapes_serve(tmp_path: Path) -> None:
    write_stage(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    joint = UsdPhysics.FixedJoint.Define(stage, "/World/joint")
    joint.GetBody0Rel().AddTarget("/World/box_a")
    stage.GetPrimAtPath("/World/bottle/geom").RemoveAPI(UsdPhysics.CollisionAPI)
    stage.GetRootLayer().Save()
    file = read_usd_scene(Boundary(tmp_path), "a.usda").file
    assert not next(b for b in file.bodies if b.name == "/World/box_a").is_free
    assert next(b for b in file.bodies if b.name == "/World/bottle").parts
    assert sorted(n.code for n in file.notices) == ["body_held", "no_collider"]


def test_meshes_of_the_surroundings_keep_their_hollows(tmp_path: Path) -> None:
    """A table with a rim: the board inside the rim is found, not the hull over it."""
    write_stage(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    stage.RemovePrim("/World/table")
    outer, inner = [(0, -0.1), (1, -0.1), (1, 0.5), (0, 0.5)], [(0.02, -0.08), (0.98, -0.08), (0.98, 0.48), (0.02, 0.48)]
    points = [(x, y, z) for ring, z in ((outer, 0.6), (outer, 0.8), (inner, 0.8), (inner, 0.7)) for x, y in ring]
    steps = [(4 * level, k, (k + 1) % 4) for level in range(3) for k in range(4)]
    sides = [(low + k, low + after, low + 4 + after, low + 4 + k) for low, k, after in steps]
    mesh = UsdGeom.Mesh.Define(stage, "/World/tray")
    mesh.GetPointsAttr().Set([Gf.Vec3f(*p) for p in points])
    faces = [(3, 2, 1, 0), (12, 13, 14, 15), *sides]
    mesh.GetFaceVertexCountsAttr().Set([4] * len(faces))
    mesh.GetFaceVertexIndicesAttr().Set([c for face in faces for c in face])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).GetApproximationAttr().Set("none")
    stage.GetRootLayer().Save()
    surfaces = find_supports(read_usd_scene(Boundary(tmp_path), "a.usda").file)
    assert surfaces[0].origin[2] == pytest.approx(0.7, abs=2e-3)


def test_what_is_no_scene_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    with pytest.raises(SceneError) as caught:
        read_usd_scene(Boundary(tmp_path), "a.usda")
    assert caught.value.code == "no_free_body"
    (tmp_path / "a.usda").write_text("#usda 1.0\n(((")
    with pytest.raises(MeshError) as unreadable:
        read_usd_scene(Boundary(tmp_path), "a.usda")
    assert unreadable.value.code == "model_unreadable"


def bar_over_the_edge(path: Path) -> "Usd.Stage":
    """A table whose top is z = 0 and which ends at x = 0, and a bar of two cubes of which the right one has nothing below it."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    bar = UsdGeom.Xform.Define(stage, "/World/bar")
    bar.AddTranslateOp().Set((-1, 0, 5))
    UsdPhysics.RigidBodyAPI.Apply(bar.GetPrim())
    for name, at, size in (
        ("table", (-40, 0, -2), (80, 60, 4)),
        ("bar/left", (-5, 0, 0), (10, 10, 10)),
        ("bar/right", (5, 0, 0), (10,) * 3),
    ):
        cube = UsdGeom.Cube.Define(stage, f"/World/{name}")
        cube.GetSizeAttr().Set(1.0)
        cube.AddTranslateOp().Set(at)
        cube.AddScaleOp().Set(size)
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    return stage


def bar_of(stage: "Usd.Stage", folder: Path) -> tuple[SceneBody, bool, list[str]]:
    """The body of the bar, whether it stays where it is, and the codes of the notices."""
    stage.GetRootLayer().Save()
    scene = read_usd_scene(Boundary(folder), "a.usda")
    (body,) = (body for body in scene.file.bodies if body.is_free)
    return body, scene.watch()["/World/bar"].is_at_rest, [notice.code for notice in scene.file.notices]


def test_masses_that_colliders_state_count(tmp_path: Path) -> None:
    stage = bar_over_the_edge(tmp_path / "a.usda")
    left, right = (UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath(f"/World/bar/{side}")) for side in ("left", "right"))
    left.CreateMassAttr(100.0)
    right.CreateMassAttr(300.0)
    body, is_at_rest, _ = bar_of(stage, tmp_path)
    assert body.mass == pytest.approx(0.4)
    np.testing.assert_allclose(body.center_of_mass, (0.025, 0, 0), atol=1e-9)  # type: ignore[arg-type]
    own, apart = 0.01 / 6, 0.05**2 * 0.75  # kg m² for each kg: of a cube, and of 100 g and 300 g at 7.5 and 2.5 cm
    np.testing.assert_allclose(body.inertia, 0.4 * np.diag([own, own + apart, own + apart]), rtol=1e-6, atol=1e-9)  # type: ignore[arg-type]
    assert not is_at_rest
    left.GetMassAttr().Set(600.0)
    body, is_at_rest, _ = bar_of(stage, tmp_path)
    assert body.mass == pytest.approx(0.9)
    assert is_at_rest


def test_the_mass_of_a_body_wins_and_its_colliders_say_where_it_is(tmp_path: Path) -> None:
    stage = bar_over_the_edge(tmp_path / "a.usda")
    whole = UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/World/bar"))
    whole.CreateMassAttr(50.0)
    body, is_at_rest, _ = bar_of(stage, tmp_path)
    assert body.mass == pytest.approx(0.05)
    assert (body.center_of_mass, body.inertia) == (None, None)
    assert is_at_rest
    UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/World/bar/right")).CreateDensityAttr(3.0)  # the left one has 1 g/cm³
    body, is_at_rest, _ = bar_of(stage, tmp_path)
    assert body.mass == pytest.approx(0.05)
    np.testing.assert_allclose(body.center_of_mass, (0.025, 0, 0), atol=1e-6)  # type: ignore[arg-type]
    assert not is_at_rest
    whole.CreateCenterOfMassAttr((-4, 0, -2))
    body, is_at_rest, _ = bar_of(stage, tmp_path)
    np.testing.assert_allclose(body.center_of_mass, (-0.04, 0, -0.02), atol=1e-9)  # type: ignore[arg-type]
    assert (body.inertia, is_at_rest) == (None, True)


def test_an_inertia_that_no_body_can_have_is_replaced(tmp_path: Path) -> None:
    stage = bar_over_the_edge(tmp_path / "a.usda")
    whole = UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/World/bar"))
    whole.CreateMassAttr(50.0)
    whole.CreateDiagonalInertiaAttr((1, 1, 5))
    body, is_at_rest, codes = bar_of(stage, tmp_path)
    assert (body.inertia, is_at_rest, codes) == (None, True, ["inertia_replaced"])


def test_the_file_is_named_and_usd_itself_says_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    layer = """#usda 1.0
def Xform "W" {{
    def Cube "b" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]{more}) {{
        double size = {size}
    }}
}}
"""
    (tmp_path / "nan.usda").write_text(layer.format(size="nan", more=""))
    (tmp_path / "own.usda").write_text(layer.format(size="0.1", more="\n payload = @own.usda@"))
    with pytest.raises(SceneError, match=r"^nan\.usda: /W/b\.size: is nan"):
        read_scene_file(Boundary(tmp_path), "nan.usda")
    read_scene_file(Boundary(tmp_path), "own.usda")
    assert capfd.readouterr() == ("", "")
