"""Scene files in the style of benchmark suites, written where a test needs them."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.geometry.mesh import Mesh
from stable_data.importers.scenes.convex_solids import box, cylinder, hull_of

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<!-- A kitchen corner; café -->
<mujoco model="corner">
  <include file="parts/common.xml"/>
  <compiler angle="degree" meshdir="meshes"/>
  <asset><mesh name="wedge" file="wedge.obj"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" pos="0 0 -0.8"/>
    <body name="table" pos="0.5 0 0" euler="0 0 20">
      <geom type="box" size=".5 .35 .02" pos="0 0 -0.02"/>
      <geom type="box" size=".02 .02 .38" pos=".45 .3 -.42"/>
    </body>
    <include file="parts/robot.xml"/>
    <include file="parts/things.xml"/>
    <body name="box_a" pos="0.55 0.1 0.045" quat="1 0 0 0"><freejoint/><geom type="box" size=".04 .05 .045"/></body>
    <body   name='box_b'
            pos = '0.60 0.12 0.03'><joint type="free"/><geom type="box" size=".05 .03 .03" mass=".2"/></body>
    <body name="floating" pos="0.3 -0.2 0.2" euler="0 0 30"><freejoint/><geom type="cylinder" size=".03 .05"/></body>
    <body name="fine" pos="0.75 -0.15 0.03"><freejoint/><geom type="box" size=".03 .03 .03"/></body>
    <body name="wedge_1" pos="0.25 0.18 0"><freejoint/><geom type="mesh" mesh="wedge"/></body>
  </worldbody>
</mujoco>
"""
"""A robot, a mug that has fallen over, two boxes in each other, one body in the air, two that are fine."""

COMMON = """<mujoco><default><default class="mug"><geom type="box" size=".004 .03 .045" density="600"/></default></default>
<option timestep="0.002"/></mujoco>
"""
ROBOT = """<mujocoinclude><body name="base"><geom type="box" size=".05 .05 .45" pos="0 0 -.3"/>
<body name="arm" pos="0 0 0.15"><joint name="j" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 .3 0 .15"/></body></body>
</mujocoinclude>
"""
THINGS = """<mujocoinclude>
  <body name="mug" pos="0.45 -0.1 0.035" euler="90 0 10" childclass="mug"><freejoint/>
    <geom pos=".035 0 0"/><geom pos="-.035 0 0"/><geom pos="0 .035 0" euler="0 0 90"/><geom pos="0 -.035 0" euler="0 0 90"/>
    <geom size=".03 .03 .004" pos="0 0 -.041"/><geom size=".012 .005 .025" pos=".05 0 0"/>
  </body>
</mujocoinclude>
"""
WEDGE = "v 0 0 0\nv .06 0 0\nv .06 .05 0\nv 0 .05 0\nv 0 0 .04\nv 0 .05 .04\n" + "".join(
    f"f {face}\n" for face in ("1 3 2", "1 4 3", "1 2 5", "3 4 6", "2 3 6", "2 6 5", "1 5 6", "1 6 4")
)


def write_corner(folder: Path) -> Path:
    """Writes the scene with its parts to a folder, and returns its main file."""
    for name, text in (
        ("scene.xml", SCENE),
        ("parts/common.xml", COMMON),
        ("parts/robot.xml", ROBOT),
        ("parts/things.xml", THINGS),
    ):
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "meshes" / "wedge.obj").write_text(WEDGE)
    return folder / "scene.xml"


def write_model(folder: Path, body: str, extra: str = "", name: str = "scene.xml") -> Path:
    """Writes a MuJoCo file with a table whose top is z = 0 and the given content of its world."""
    folder.mkdir(parents=True, exist_ok=True)
    table = '<body name="table"><geom type="box" size=".5 .4 .02" pos="0 0 -.02"/></body>'
    (folder / name).write_text(f"<mujoco>{extra}<worldbody>{table}{body}</worldbody></mujoco>")
    return folder / name


def write_stage(path: Path, *, is_y_up: bool = False, unit: float = 1.0) -> Path:
    """Writes a USD scene: a table, two boxes in each other, a floating one, and a bottle that has fallen over."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    up = UsdGeom.Tokens.y if is_y_up else UsdGeom.Tokens.z

    def point(x: float, y: float, z: float) -> Gf.Vec3d:
        return Gf.Vec3d(*(np.array([x, z, -y] if is_y_up else [x, y, z]) / unit).tolist())

    def size(x: float, y: float, z: float) -> Gf.Vec3f:
        return Gf.Vec3f(*(np.array([x, z, y] if is_y_up else [x, y, z]) / unit).tolist())

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    table = UsdGeom.Cube.Define(stage, "/World/table")
    table.GetSizeAttr().Set(1.0)
    table.AddTranslateOp().Set(point(0.5, 0.2, 0.7))
    table.AddScaleOp().Set(size(1.0, 0.6, 0.04))
    UsdPhysics.CollisionAPI.Apply(table.GetPrim())

    def body(name: str, position: Gf.Vec3d) -> "UsdGeom.Xform":
        made = UsdGeom.Xform.Define(stage, f"/World/{name}")
        made.AddTranslateOp().Set(position)
        UsdPhysics.RigidBodyAPI.Apply(made.GetPrim())
        UsdPhysics.MassAPI.Apply(made.GetPrim()).GetMassAttr().Set(0.3)
        return made

    boxes = {"box_a": (0.3, 0.2, 0.76), "box_b": (0.35, 0.22, 0.76), "floating": (0.7, 0.1, 1.0), "fine": (0.8, 0.35, 0.76)}
    for name, position in boxes.items():
        body(name, point(*position))
        cube = UsdGeom.Cube.Define(stage, f"/World/{name}/geom")
        cube.GetSizeAttr().Set(1.0)
        cube.AddScaleOp().Set(size(0.08, 0.08, 0.08))
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    bottle = body("bottle", point(0.55, 0.35, 0.75))
    bottle.AddRotateXYZOp().Set(Gf.Vec3f(0, 0, 90) if is_y_up else Gf.Vec3f(0, 90, 0))
    shape = UsdGeom.Cylinder.Define(stage, "/World/bottle/geom")
    shape.GetRadiusAttr().Set(0.03 / unit)
    shape.GetHeightAttr().Set(0.2 / unit)
    shape.GetAxisAttr().Set(up)
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    stage.GetRootLayer().Save()
    return path


def solid(*points: tuple[float, float, float]) -> Mesh:
    """The convex hull of points."""
    found = hull_of(np.array(points))
    assert found is not None
    return found


def cuboid(x: float, y: float, z: float) -> Mesh:
    """A box of these extents, its centre at the origin."""
    return box(np.array([x, y, z]) / 2)


def basin(outer: float, wall: float) -> Mesh:
    """A cube without a lid, y up, as a closed mesh whose hollow reaches down to the wall; its centre at the origin."""
    o, i = outer / 2, outer / 2 - wall
    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    rings = [(o, -o), (o, o), (i, o), (i, wall - o)]  # half width and height of four squares, along the surface
    vertices = np.array([(x * half, y, z * half) for half, y in rings for x, z in ring])
    faces = [(0, 1, 2), (0, 2, 3), (12, 14, 13), (12, 15, 14)]
    for k in range(3):
        for a in range(4):
            b = (a + 1) % 4
            faces += [(4 * k + a, 4 * k + 4 + b, 4 * k + b), (4 * k + a, 4 * k + 4 + a, 4 * k + 4 + b)]
    return Mesh(vertices, np.array(faces))


def sheet(*corners: tuple[float, float, float]) -> Mesh:
    """A flat polygon around its first corner."""
    return Mesh(np.array(corners), np.array([(0, k, k + 1) for k in range(1, len(corners) - 1)]))


def gltf_parts(meshes: Sequence[Mesh], nodes: Sequence[dict[str, Any]], **entries: Any) -> tuple[dict[str, Any], bytes]:
    """A glTF document and its buffer; mesh k of it is ``meshes[k]``, y up, and the first node is the root of its scene."""
    content, views, accessors = b"", list[dict[str, Any]](), list[dict[str, Any]]()
    for mesh in meshes:
        for array, kind, shape in ((mesh.vertices.astype("<f4"), 5126, "VEC3"), (mesh.faces.astype("<u4"), 5125, "SCALAR")):
            accessor = {"bufferView": len(views), "componentType": kind, "type": shape}
            accessors.append(accessor | {"count": array.size if kind == 5125 else len(array)})
            views.append({"buffer": 0, "byteOffset": len(content), "byteLength": array.nbytes})
            content += array.tobytes()
        accessors[-2] |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": list(nodes),
        "meshes": [{"primitives": [{"attributes": {"POSITION": 2 * k}, "indices": 2 * k + 1}]} for k in range(len(meshes))],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    return document | entries, content


def write_gltf(path: Path, document: dict[str, Any], content: bytes, *, indent: int | None = 2) -> Path:
    """Writes a document and its buffer as ``.glb``, or as ``.gltf`` with a file ``NAME.bin`` beside it."""
    if path.suffix == ".gltf":
        document = document | {"buffers": [{"byteLength": len(content), "uri": f"{path.stem}.bin"}]}
        path.with_suffix(".bin").write_bytes(content)
        path.write_text(json.dumps(document, indent=indent))
        return path
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s4I", b"glTF", 2, 28 + len(text) + len(content), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<2I", len(content), 0x004E4942) + content)
    return path


def kitchen() -> tuple[dict[str, Any], bytes]:
    """A glTF scene with boxes in each other, one in the air, a bottle that has fallen over, and one that is fine.

    The scene is in centimetres below a node that turns and moves it; the table top, 100 x 60 at a height of 72, is a sheet, as is the
    floor. Centres of the bodies are multiples of centimetres.
    """
    size = 8.0
    meshes = [
        cuboid(1, 1, 1),
        sheet((-50, 0, -30), (-50, 0, 30), (50, 0, 30), (50, 0, -30)),
        sheet((-300, 0, -300), (-300, 0, 300), (300, 0, 300), (300, 0, -300)),
        cylinder_y(3.0, 20.0),
    ]
    turned = np.eye(4)
    turned[:3, :3] = size * Rotation.from_euler("y", 30, degrees=True).as_matrix()
    turned[:3, 3] = (10, 90, 12)
    lying = Rotation.from_euler("z", 90, degrees=True).as_quat().tolist()
    physics = {"motion": {"mass": 0.3, "centerOfMass": [0, -2, 0]}}
    nodes: list[dict[str, Any]] = [
        {"name": "root", "children": list(range(1, 10)), "scale": [0.01] * 3, "translation": [2, 0, 1], **_turned("y", 40)},
        {"name": "floor", "mesh": 2},
        {"name": "table", "mesh": 1, "translation": [0, 72, 0]},
        {"name": "box_a-rigid", "mesh": 0, "translation": [-20, 76.0, 1e0], "scale": [size] * 3},
        {"name": "box_b-rigid.001", "mesh": 0, "translation": [-15, 76, 3], "scale": [size, size, 6.0]},
        {"name": "floating_RIGID", "mesh": 0, "matrix": turned.T.ravel().tolist()},
        {"name": "fine-rigid", "children": [10], "translation": [35, 72, -15]},
        {
            "name": "bottle",
            "mesh": 3,
            "rotation": lying,
            "translation": [5, 75, -15],
            "extensions": {"KHR_physics_rigid_bodies": physics},
        },
        {"name": "sun-noimp", "mesh": 0, "translation": [35, 76, -15], "scale": [20, 20, 20]},
        {"name": "shelf", "mesh": 0, "translation": [0, 110, -28], "scale": [100, 2, 4]},
        {"name": "part of it", "mesh": 0, "translation": [0, 4, 0], "scale": [size] * 3},
    ]
    return gltf_parts(meshes, nodes, extensionsUsed=["KHR_physics_rigid_bodies"])


def cylinder_y(radius: float, height: float) -> Mesh:
    """A cylinder along y, its centre at the origin."""
    along_z = cylinder(radius, height / 2)
    return Mesh(np.roll(along_z.vertices, 2, axis=1), along_z.faces)


def _turned(axis: str, degrees: float) -> dict[str, Any]:
    return {"rotation": Rotation.from_euler(axis, degrees, degrees=True).as_quat().tolist()}
