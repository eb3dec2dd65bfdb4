"""Scene files in the style of benchmark suites, written where a test needs them."""

from pathlib import Path

import numpy as np

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
