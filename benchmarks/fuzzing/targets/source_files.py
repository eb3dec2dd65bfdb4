"""Small honest files of other projects' formats, which targets change."""
# ruff: noqa: E501 - the texts of the files keep the lines that such files have

import io
import json
import struct
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.fuzzing.targets.meshes import picture
from stable_data.geometry.primitive_shapes import box_triangles

LICENCE = b"Creative Commons Zero (CC0-1.0). Made for tests.\n"

_CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
_SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]

OBJ = (
    "mtllib box.mtl\no box\n"
    + "".join(f"v {x * 0.1} {y * 0.1} {z * 0.1}\n" for x, y, z in _CORNERS)
    + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\ng side\nusemtl red\ns off\n"
    + "".join("f " + " ".join(f"{v + 1}/{k + 1}/1" for k, v in enumerate(side)) + "\n" for side in _SIDES[:4])
    + "usemtl drawn\n"
    + "".join("f " + " ".join(f"{v - 8}" for v in side) + "\n" for side in _SIDES[4:])
).encode()
MTL = b"newmtl red\nKd 0.8 0.1 0.1\nd 0.5\nnewmtl drawn\nKd 1 1 1\nTr 0.1\nmap_Kd -s 1 1 1 picture.png\n"


def stl_ascii() -> bytes:
    """A box, 0.1 m."""
    facets = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in corners)
        + "endloop\nendfacet\n"
        for corners in (0.1 * box_triangles()).tolist()
    ]
    return ("solid box\n" + "".join(facets) + "endsolid box\n").encode()


def stl_binary() -> bytes:
    """A box, 0.1 m."""
    soup = (0.1 * box_triangles()).astype("<f4")
    rows = b"".join(struct.pack("<3f", 0, 0, 0) + corners.tobytes() + b"\0\0" for corners in soup)
    return b"box".ljust(80) + struct.pack("<I", len(soup)) + rows


def ply(*, is_binary: bool) -> bytes:
    """A box with colours, 1 m."""
    form = "binary_little_endian" if is_binary else "ascii"
    head = (
        f"ply\nformat {form} 1.0\ncomment TextureFile picture.png\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if is_binary:
        rows = b"".join(struct.pack("<3f3B", *corner, 200, 10, 10) for corner in _CORNERS)
        return head + rows + b"".join(struct.pack("<B4i", 4, *side) for side in _SIDES)
    lines = [f"{x} {y} {z} 200 10 10" for x, y, z in _CORNERS] + ["4 " + " ".join(map(str, side)) for side in _SIDES]
    return head + ("\n".join(lines) + "\n").encode()


DAE = b"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><contributor><author>A</author><copyright>CC0</copyright></contributor><unit name="cm" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_images><image id="i"><init_from>picture.png</init_from></image></library_images>
<library_effects><effect id="e"><profile_COMMON>
<newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam>
<technique sid="t"><lambert><diffuse><texture texture="s" texcoord="UV"/></diffuse><transparency><float>0.5</float></transparency></lambert>
</technique></profile_COMMON></effect>
<effect id="e2"><profile_COMMON><technique sid="t"><phong><diffuse><color>1 0 0 1</color></diffuse></phong></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material><material id="m2"><instance_effect url="#e2"/></material></library_materials>
<library_geometries><geometry id="g" name="form"><mesh>
<source id="p"><float_array id="pa" count="15">0 0 0 2 0 0 2 1 0 0 1 0 1 0.5 2</float_array><technique_common>
<accessor source="#pa" count="5" stride="3"><param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>
</technique_common></source>
<source id="t"><float_array id="ta" count="8">0 0 1 0 1 1 0 1</float_array><technique_common>
<accessor source="#ta" count="4" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="1" material="a"><input semantic="VERTEX" source="#v" offset="0"/><input semantic="TEXCOORD" source="#t" offset="1" set="0"/>
<vcount>4</vcount><p>0 0 3 3 2 2 1 1</p></polylist>
<triangles count="4" material="b"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 4 1 2 4 2 3 4 3 0 4</p></triangles>
</mesh></geometry></library_geometries>
<library_nodes><node id="k" name="kept"><instance_geometry url="#g"/></node></library_nodes>
<library_visual_scenes><visual_scene id="sc"><node id="n" name="part"><translate>0 1 0</translate><rotate>0 0 1 30</rotate><scale>1 2 1</scale>
<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="a" target="#m"/>
<instance_material symbol="b" target="#m2"/></technique_common></bind_material></instance_geometry>
<node id="n2"><matrix>1 0 0 3 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_node url="#k"/></node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#sc"/></scene></COLLADA>
"""
URDF = b"""<robot name="mug">
<material name="blue"><color rgba="0.1 0.1 0.8 1"/></material><material name="drawn"><texture filename="picture.png"/></material>
<link name="base"><inertial><origin xyz="0 0 0.05" rpy="0 0 0"/><mass value="0.3"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>
<visual><origin xyz="0 0 0" rpy="0 0 1.57"/><geometry><mesh filename="package://mug/box.obj" scale="1 1 2"/></geometry><material name="blue"/></visual>
<collision><geometry><box size="0.1 0.1 0.2"/></geometry><contact><lateral_friction value="0.7"/></contact></collision></link>
<link name="lid"><visual><geometry><cylinder radius="0.05" length="0.02"/></geometry><material name="own"><color rgba="1 0 0 0.5"/></material></visual>
<collision><geometry><mesh filename="box.stl"/></geometry></collision><inertial><mass value="0.1"/></inertial></link>
<joint name="j" type="fixed"><parent link="base"/><child link="lid"/><origin xyz="0 0 0.1" rpy="0 0 0.1"/></joint>
<gazebo reference="base"><mu1>0.9</mu1></gazebo>
</robot>
"""
SDFORMAT = b"""<?xml version="1.0"?>
<sdf version="1.7"><model name="mug"><pose>0 0 0.1 0 0 0</pose><static>false</static>
<frame name="f" attached_to="base"><pose relative_to="base">0 0 0.1 0 0 0.5</pose></frame>
<link name="base"><inertial><pose>0 0 0.05 0 0 0</pose><mass>0.3</mass><inertia><ixx>0.001</ixx><iyy>0.001</iyy><izz>0.001</izz></inertia></inertial>
<visual name="v"><geometry><mesh><uri>model://mug/meshes/box.dae</uri><scale>1 1 1</scale><submesh><name>form</name><center>true</center></submesh></mesh></geometry>
<material><diffuse>0.5 0.2 0.2 1</diffuse><pbr><metal><albedo_map>meshes/picture.png</albedo_map></metal></pbr></material><transparency>0.2</transparency></visual>
<collision name="c"><pose>0 0 0.1 0 0 0</pose><geometry><box><size>0.1 0.1 0.2</size></box></geometry>
<surface><friction><ode><mu>0.6</mu><mu2>0.5</mu2></ode></friction></surface></collision></link>
<link name="lid"><pose relative_to="f">0 0 0.1 0 0 0</pose><visual name="v"><geometry><cylinder><radius>0.05</radius><length>0.02</length></cylinder></geometry></visual>
<collision name="c"><geometry><sphere><radius>0.03</radius></sphere></geometry></collision></link>
<joint name="j" type="fixed"><parent>base</parent><child>lid</child></joint>
<include><uri>model://knob</uri><name>k</name><pose>0 0 0.3 0 0 0</pose></include>
<joint name="j2" type="fixed"><parent>lid</parent><child>k::base</child></joint>
</model></sdf>
"""
KNOB = b"""<?xml version="1.0"?>
<sdf version="1.6"><model name="knob"><link name="base"><visual name="v"><geometry><capsule><radius>0.01</radius><length>0.02</length></capsule></geometry></visual>
<collision name="c"><geometry><ellipsoid><radii>0.01 0.02 0.01</radii></ellipsoid></geometry></collision></link></model></sdf>
"""
CONFIG = b"""<?xml version="1.0"?><model><name>Mug</name><version>1.0</version><sdf version="1.7">model.sdf</sdf>
<author><name>A</name><email>a@b.c</email></author><description>A mug. License: CC0</description></model>
"""
MJCF = b"""<mujoco model="mug">
<compiler angle="degree" meshdir="meshes" texturedir="textures" autolimits="true"/>
<include file="parts/defaults.xml"/>
<asset><mesh name="box" file="box.stl" scale="1 1 2"/><texture name="t" type="2d" file="picture.png"/><texture name="b" type="cube" builtin="checker" rgb1="1 0 0" rgb2="0 1 0" width="8" height="8"/>
<material name="m" texture="t" texrepeat="2 2" rgba="1 1 1 0.9"/><material name="n" rgba="0.2 0.2 0.8 1"/></asset>
<worldbody><body name="mug" pos="0 0 0.1" euler="0 0 30"><freejoint/><inertial pos="0 0 0" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
<geom name="seen" type="mesh" mesh="box" material="m" contype="0" conaffinity="0" group="1"/>
<geom class="solid" type="cylinder" size="0.04 0.05" friction="0.8 0.01 0.001"/>
<body name="handle" pos="0.05 0 0"><geom class="solid" type="capsule" fromto="0 0 -0.02 0 0 0.02" size="0.01" material="n"/>
<geom type="ellipsoid" size="0.01 0.01 0.02" mass="0.01"/><site name="s" pos="0 0 0"/></body></body></worldbody>
<custom><text name="license" data="CC0-1.0"/><text name="author" data="A"/></custom>
<option timestep="0.002"/><sensor/><keyframe/>
</mujoco>
"""
MJCF_DEFAULTS = b"""<mujocoinclude><default><default class="solid"><geom group="3" density="400" rgba="0 1 0 1"/></default></default></mujocoinclude>
"""
USDA = b"""#usda 1.0
(
    defaultPrim = "Thing"
    metersPerUnit = 0.01
    upAxis = "Z"
    subLayers = [@./colours.usda@]
)

def Xform "Thing" (
    kind = "component"
    prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
    variants = { string size = "big" }
    prepend variantSets = "size"
)
{
    float physics:mass = 0.5
    point3f physics:centerOfMass = (0, 0, 2)
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]

    def Mesh "Box" (
        prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI"]
    )
    {
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 2, 3, 1, 4, 5, 7, 6, 0, 1, 5, 4, 2, 6, 7, 3, 0, 4, 6, 2, 1, 3, 7, 5]
        point3f[] points = [(0, 0, 0), (4, 0, 0), (0, 4, 0), (4, 4, 0), (0, 0, 8), (4, 0, 8), (0, 4, 8), (4, 4, 8)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1), (1, 1), (0, 0), (1, 0), (0, 1), (1, 1)] (
            interpolation = "vertex"
        )
        color3f[] primvars:displayColor = [(0.2, 0.4, 0.6)]
        uniform token orientation = "rightHanded"
        uniform token subdivisionScheme = "none"
        uniform token physics:approximation = "convexHull"
        rel material:binding = </Thing/Looks/Red>

        def GeomSubset "Part"
        {
            uniform token elementType = "face"
            int[] indices = [0, 1]
            rel material:binding = </Thing/Looks/Plain>
        }
    }

    def Cylinder "Knob" (
        prepend references = @./knob.usda@</Knob>
    )
    {
        double3 xformOp:translate = (2, 2, 9)
        float3 xformOp:rotateXYZ = (0, 0, 45)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }

    def Sphere "Ball" (
        prepend apiSchemas = ["PhysicsCollisionAPI"]
    )
    {
        double radius = 1
        bool visibility = 1
    }

    def Scope "Looks"
    {
        def Material "Red"
        {
            token outputs:surface.connect = </Thing/Looks/Red/Shader.outputs:surface>

            def Shader "Shader"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor.connect = </Thing/Looks/Red/Image.outputs:rgb>
                float inputs:opacity = 0.9
                token outputs:surface
            }

            def Shader "Image"
            {
                uniform token info:id = "UsdUVTexture"
                asset inputs:file = @./picture.png@
                float2 inputs:st.connect = </Thing/Looks/Red/Reader.outputs:result>
                float3 outputs:rgb
            }

            def Shader "Reader"
            {
                uniform token info:id = "UsdPrimvarReader_float2"
                string inputs:varname = "st"
                float2 outputs:result
            }
        }

        def Material "Plain"
        {
            token outputs:surface.connect = </Thing/Looks/Plain/Shader.outputs:surface>

            def Shader "Shader"
            {
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (0.9, 0.1, 0.1)
                token outputs:surface
            }
        }
    }
    variantSet "size" = {
        "big" {
            over "Ball"
            {
                double radius = 2
            }
        }
        "small" {
            over "Ball"
            {
                double radius = 0.5
            }
        }
    }
}
"""
USDA_COLOURS = b"""#usda 1.0
over "Thing"
{
    over "Ball"
    {
        color3f[] primvars:displayColor = [(1, 0, 0)]
    }
}
"""
USDA_KNOB = b"""#usda 1.0
(
    defaultPrim = "Knob"
)
def Cylinder "Knob" (
    prepend apiSchemas = ["PhysicsCollisionAPI"]
)
{
    double height = 2
    double radius = 1
    uniform token axis = "Z"
}
"""
USD_WORDS = (
    *(
        "def",
        "over",
        "class",
        "Xform",
        "Mesh",
        "Cube",
        "Cylinder",
        "Cone",
        "Capsule",
        "Sphere",
        "PointInstancer",
        "Material",
        "Shader",
        "GeomSubset",
    ),
    *(
        "references",
        "payload",
        "subLayers",
        "inherits",
        "specializes",
        "variants",
        "variantSet",
        "instanceable = true",
        "relocates",
        "timeSamples",
    ),
    *(
        "@../outside/layer.usda@",
        "@/tmp/stable-data-fuzz/layer.usda@",
        "@./thing.usda@",
        "@./knob.usda@</Knob>",
        "@http://127.0.0.1:9/x.usda@",
        "@@",
    ),
    *(
        "</Thing>",
        "</Thing/Box>",
        "<../../..>",
        "None",
        "nan",
        "inf",
        "[]",
        "[(0, 0, 0)]",
        "(1, 2)",
        "{ }",
        "clips",
        "assetPaths",
        "@<UDIM>.png@",
    ),
    *(
        "metersPerUnit = 0",
        'upAxis = "Y"',
        "xformOp:transform",
        "!resetXformStack!",
        "xformOp:scale",
        "PhysicsJoint",
        "PhysicsFixedJoint",
    ),
    *(
        "physics:body0",
        "physics:density",
        "physics:mass",
        'purpose = "guide"',
        'visibility = "invisible"',
        "customData",
        "dictionary",
        "kind",
    ),
    *(
        "faceVertexIndices",
        "faceVertexCounts",
        "points",
        "extent",
        "holeIndices",
        "cornerIndices",
        "token",
        "int64[]",
        "matrix4d",
        "quatf",
        "asset",
    ),
)
XML_WORDS = (
    *(
        "mesh",
        "box",
        "cylinder",
        "sphere",
        "capsule",
        "plane",
        "link",
        "joint",
        "visual",
        "collision",
        "geometry",
        "inertial",
        "origin",
        "material",
    ),
    *(
        "filename",
        "scale",
        "size",
        "radius",
        "length",
        "xyz",
        "rpy",
        "value",
        "mass",
        "inertia",
        "ixx",
        "name",
        "type",
        "parent",
        "child",
        "color",
    ),
    *(
        "rgba",
        "texture",
        "fixed",
        "revolute",
        "floating",
        "include",
        "uri",
        "pose",
        "relative_to",
        "attached_to",
        "static",
        "submesh",
        "center",
    ),
    *(
        "model",
        "sdf",
        "frame",
        "polyline",
        "heightmap",
        "world",
        "geom",
        "body",
        "freejoint",
        "compiler",
        "default",
        "class",
        "file",
        "meshdir",
    ),
    *(
        "angle",
        "radian",
        "eulerseq",
        "euler",
        "quat",
        "axisangle",
        "fromto",
        "mocap",
        "composite",
        "replicate",
        "count",
        "plugin",
        "extension",
    ),
    *(
        "hfield",
        "skin",
        "flex",
        "attach",
        "keyframe",
        "key",
        "qpos",
        "option",
        "gravity",
        "size",
        "memory",
        "nconmax",
        "asset",
        "assetdir",
        "strippath",
    ),
    *(
        "childclass",
        "contype",
        "conaffinity",
        "group",
        "density",
        "friction",
        "solref",
        "inertiafromgeom",
        "balanceinertia",
        "boundmass",
        "settotalmass",
    ),
    *(
        "content_type",
        "refpos",
        "vertex",
        "face",
        "normal",
        "texcoord",
        "builtin",
        "checker",
        "maxhullvert",
        "smoothnormal",
        "shellinertia",
    ),
    *(
        "instance_geometry",
        "instance_node",
        "url",
        "source",
        "accessor",
        "stride",
        "count",
        "input",
        "semantic",
        "offset",
        "polylist",
        "triangles",
    ),
    *(
        "vcount",
        "p",
        "float_array",
        "node",
        "matrix",
        "rotate",
        "translate",
        "lookat",
        "skew",
        "unit",
        "meter",
        "up_axis",
        "Z_UP",
        "init_from",
        "#g",
    ),
    *(
        "xi:include",
        "href",
        "xacro:macro",
        "package://mug/box.obj",
        "model://mug/meshes/box.dae",
        "model://../x",
        "0 0 0",
        "1e999 0 0",
        "nan nan nan",
    ),
)


def gltf(*, is_embedded: bool = False) -> tuple[dict[str, Any], bytes]:
    """A glTF of a box with a texture, and its buffer."""
    corners = np.array(_CORNERS, "<f4")
    faces = np.array([[a, b, c] for a, b, c, _ in _SIDES] + [[a, c, d] for a, _, c, d in _SIDES], "<u2")
    uv = corners[:, :2].astype("<f4")
    content = corners.tobytes() + uv.tobytes() + faces.tobytes()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "copyright": "A, CC0", "extras": {"license": "CC0-1.0", "author": "A"}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "thing", "mesh": 0, "rotation": [0, 0, 0, 1], "scale": [0.1, 0.1, 0.1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 64},
            {"buffer": 0, "byteOffset": 160, "byteLength": 72},
        ],
        "buffers": [{"uri": "thing.bin", "byteLength": len(content)}],
        "images": [{"uri": "picture.png"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 0.5, 1]}}],
    }
    if is_embedded:
        import base64

        document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
        document["images"][0]["uri"] = "data:image/png;base64," + base64.b64encode(picture("PNG")).decode()
    return document, content


def usdc(text: bytes) -> bytes:
    """A layer of USD in its binary form."""
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(text.decode())
    with TemporaryDirectory() as folder:
        path = Path(folder, "x.usdc")
        layer.Export(str(path))
        return path.read_bytes()


def usdz(members: dict[str, bytes]) -> bytes:
    """A package of USD."""
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return sink.getvalue()


MJCF_SCENE = b"""<mujoco model="corner">
<include file="parts/things.xml"/>
<compiler angle="degree" meshdir="meshes"/>
<asset><mesh name="wedge" file="wedge.obj"/></asset>
<worldbody><geom name="floor" type="plane" size="3 3 .1" pos="0 0 -0.8"/>
<body name="table" pos="0.5 0 0" euler="0 0 20"><geom type="box" size=".5 .35 .02" pos="0 0 -0.02"/></body>
<body name="box_a" pos="0.55 0.1 0.045" quat="1 0 0 0"><freejoint/><geom type="box" size=".04 .05 .045"/></body>
<body name="wedge_1" pos="0.25 0.18 0"><freejoint/><geom type="mesh" mesh="wedge"/></body>
<body name="ball" pos="0.75 -0.15 0.03"><joint type="free"/><geom type="sphere" size=".03"/></body>
</worldbody>
<keyframe><key name="home" qpos="0.55 0.1 0.045 1 0 0 0 0.25 0.18 0 1 0 0 0 0.75 -0.15 0.03 1 0 0 0 0.4 0 0.05 1 0 0 0"/></keyframe>
</mujoco>
"""
MJCF_THINGS = b"""<mujoco><default><default class="mug"><geom type="box" size=".004 .03 .045" density="600"/></default></default>
<worldbody><body name="mug" pos="0.4 0 0.05" childclass="mug"><freejoint/><geom pos=".035 0 0"/><geom pos="-.035 0 0"/>
<geom size=".03 .03 .004" pos="0 0 -.041"/></body></worldbody></mujoco>
"""
WEDGE = (
    "v 0 0 0\nv .06 0 0\nv .06 .05 0\nv 0 .05 0\nv 0 0 .04\nv 0 .05 .04\n"
    + "".join(f"f {face}\n" for face in ("1 3 2", "1 4 3", "1 2 5", "3 4 6", "2 3 6", "2 6 5", "1 5 6", "1 6 4"))
).encode()
USDA_SCENE = b"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    def Cube "table" (
        prepend apiSchemas = ["PhysicsCollisionAPI"]
    )
    {
        double size = 1
        double3 xformOp:translate = (0.5, 0.2, 0.7)
        float3 xformOp:scale = (1, 0.6, 0.04)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }
    def Xform "box" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
    )
    {
        float physics:mass = 0.3
        double3 xformOp:translate = (0.3, 0.2, 0.76)
        quatf xformOp:orient = (1, 0, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]
        def Cube "geom" (
        prepend apiSchemas = ["PhysicsCollisionAPI"]
    )
        {
            double size = 1
            float3 xformOp:scale = (0.08, 0.08, 0.08)
            uniform token[] xformOpOrder = ["xformOp:scale"]
        }
    }
    def Xform "bottle" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI"]
        prepend references = @./bottle.usda@
    )
    {
        double3 xformOp:translate = (0.6, 0.3, 0.82)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""
USDA_BOTTLE = b"""#usda 1.0
(
    defaultPrim = "Bottle"
)
def Xform "Bottle"
{
    def Cylinder "geom" (
        prepend apiSchemas = ["PhysicsCollisionAPI"]
    )
    {
        double radius = 0.03
        double height = 0.2
    }
}
"""


def gltf_scene() -> tuple[dict[str, Any], bytes]:
    """A glTF scene with physics: a table and two free bodies, and its buffer."""
    document, content = gltf()
    shapes = [
        {"type": "box", "box": {"size": [1, 0.04, 0.6]}},
        {"type": "box", "box": {"size": [0.08, 0.08, 0.08]}},
        {"type": "cylinder", "cylinder": {"radiusTop": 0.03, "radiusBottom": 0.03, "height": 0.2}},
    ]

    def node(name: str, shape: int, at: list[float], motion: dict[str, Any] | None = None) -> dict[str, Any]:
        body: dict[str, Any] = {"collider": {"geometry": {"shape": shape}}}
        if motion is not None:
            body["motion"] = motion
        return {"name": name, "translation": at, "extensions": {"KHR_physics_rigid_bodies": body}}

    nodes = [
        node("table", 0, [0.5, 0.7, -0.3]),
        node("box", 1, [0.3, 0.76, -0.2], {"mass": 0.3}),
        node("bottle", 2, [0.6, 0.82, -0.3], {"mass": 0.2, "centerOfMass": [0, 0, 0]}),
        {"name": "thing-rigid", "mesh": 0, "translation": [0.8, 0.72, -0.4], "scale": [0.1, 0.1, 0.1]},
    ]
    document |= {
        "extensionsUsed": ["KHR_physics_rigid_bodies", "KHR_implicit_shapes"],
        "extensions": {"KHR_implicit_shapes": {"shapes": shapes}},
        "nodes": nodes,
        "scenes": [{"nodes": list(range(len(nodes)))}],
    }
    return document, content


def dumped(document: Any) -> bytes:
    """A JSON document, indented as its authors write it."""
    return json.dumps(document, indent=2).encode()
