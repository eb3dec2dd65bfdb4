"""SDFormat and URDF: links, poses, masses and friction as the formats define them, and hostile or odd files."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import signed_volumes
from stable_data.importers.boundary import Boundary
from stable_data.importers.mesh_files import joined_triangles
from stable_data.importers.readers import reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from tests.stable_data.importers.mesh_texts import CUBE_STL, dae, png

BOX = "<geometry><box><size>2 1 3</size></box></geometry>"
SHAPES = f"<visual name='v'>{BOX}</visual><collision name='c'>{BOX}</collision>"
URDF_BOX = "<geometry><box size='2 1 3'/></geometry>"
URDF_SHAPES = f"<visual>{URDF_BOX}</visual><collision>{URDF_BOX}</collision>"


def sdf(body: str, name: str = "thing") -> str:
    return f"<?xml version='1.0'?><sdf version='1.9'><model name='{name}'>{body}</model></sdf>"


def link(body: str, name: str = "a") -> str:
    return f"<link name='{name}'>{body}</link>"


def found(root: Path, kind: str) -> list[SourceRef | Notice]:
    return list(reader_of(kind).find(Boundary(root), ReaderOptions()))


def read(root: Path, text: str, kind: str = "sdformat", **options: Any) -> SourceAsset:
    root.mkdir(exist_ok=True)
    (root / ("m.urdf" if kind == "urdf" else "m.sdf")).write_text(text)
    (ref,) = (item for item in found(root, kind) if isinstance(item, SourceRef) and item.asset_id == "m")
    boundary = Boundary(root)
    asset = reader_of(kind).read(boundary, ref, ReaderOptions(**options))
    assert boundary.opened <= set(ref.files)
    return asset


def code_of(root: Path, text: str, kind: str = "sdformat", **options: Any) -> str:
    with pytest.raises(MeshError) as caught:
        read(root, text, kind, **options)
    assert "\n" not in str(caught.value)
    return caught.value.code


def box_of(asset: SourceAsset) -> list[list[float]]:
    points = joined_triangles(asset.surfaces).reshape(-1, 3)
    return [np.round(points.min(axis=0), 9).tolist(), np.round(points.max(axis=0), 9).tolist()]


# Poses


def test_sdformat_poses_are_relative_to_what_they_name(tmp_path: Path) -> None:
    pose = "<pose relative_to='f'>0 0 1 0 0 0</pose>"
    body = link(
        "<pose>1 0 0 0 0 90</pose>".replace("<pose>", "<pose degrees='true'>") + f"<visual name='v'>{pose}{BOX}</visual>"
    )
    frames = "<frame name='f' attached_to='a'><pose>0 5 0 0 0 0</pose></frame>"
    # The frame lies 5 along the link's y, which is the model's -x; the visual is 1 above it and turned as the link.
    assert box_of(read(tmp_path, sdf(body + frames))) == [[-4.5, -1, -0.5], [-3.5, 1, 2.5]]
    quat = "<pose rotation_format='quat_xyzw'>0 0 0 0 0 0.7071067811865476 0.7071067811865476</pose>"
    assert box_of(read(tmp_path, sdf(link(f"{quat}{SHAPES}")))) == [[-0.5, -1, -1.5], [0.5, 1, 1.5]]


def test_rotations_are_those_of_urdf_and_sdformat(tmp_path: Path) -> None:
    angles = [0.3, -0.7, 2.1]
    rotation = Rotation.from_euler("xyz", angles).as_matrix()
    text = " ".join(map(str, angles))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-0.5, 0.5) for z in (-1.5, 1.5)]) @ rotation.T
    expected = [corners.min(axis=0), corners.max(axis=0)]
    for kind, content in (
        ("sdformat", sdf(link(f"<visual name='v'><pose>0 0 0 {text}</pose>{BOX}</visual>"))),
        ("urdf", f"<robot name='r'><link name='a'><visual><origin rpy='{text}'/>{URDF_BOX}</visual></link></robot>"),
    ):
        np.testing.assert_allclose(box_of(read(tmp_path, content, kind)), expected, atol=1e-8)


def test_urdf_joints_place_the_links(tmp_path: Path) -> None:
    links = "".join(f"<link name='{name}'>{URDF_SHAPES}</link>" for name in "cab")
    joints = (
        "<joint name='1' type='fixed'><parent link='a'/><child link='b'/><origin xyz='10 0 0' rpy='0 0 1.5707963267948966'/></joint>"
        "<joint name='2' type='fixed'><parent link='b'/><child link='c'/><origin xyz='5 0 0'/></joint>"
    )
    asset = read(tmp_path, f"<robot name='r'>{links}{joints}</robot>", "urdf")
    assert box_of(asset) == [[-1, -1, -1.5], [10.5, 6, 1.5]]
    assert (asset.num_joints, len(asset.colliders), asset.is_upright, asset.unit_m) == (0, 3, True, 1.0)


# Masses


def inertial(mass: float, pose: str, moments: str) -> str:
    values = "".join(f"<{name}>{value}</{name}>" for name, value in zip(("ixx", "iyy", "izz"), moments.split(), strict=True))
    return f"<inertial><mass>{mass}</mass><pose>{pose}</pose><inertia>{values}</inertia></inertial>"


def test_fixed_links_are_one_body_as_mujoco_sees_it(tmp_path: Path) -> None:
    links = (
        link(inertial(2.0, "0.1 0 0.2 0.3 0.4 0.5", "0.5 0.6 0.7") + SHAPES),
        link("<pose>1 2 3 0.5 -0.4 0.3</pose>" + inertial(3.0, "0 0.1 0 0 0 1", "0.2 0.3 0.4"), "b"),
    )
    joint = "<joint name='j' type='fixed'><parent>a</parent><child>b</child></joint>"
    asset = read(tmp_path, sdf("".join(links) + joint))

    def quat(*angles: float) -> str:
        return " ".join(map(str, Rotation.from_euler("xyz", angles).as_quat()[[3, 0, 1, 2]]))

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><freejoint/>
        <inertial pos="0.1 0 0.2" quat="{quat(0.3, 0.4, 0.5)}" mass="2" diaginertia="0.5 0.6 0.7"/>
        <body pos="1 2 3" quat="{quat(0.5, -0.4, 0.3)}">
        <inertial pos="0 0.1 0" quat="{quat(0, 0, 1)}" mass="3" diaginertia="0.2 0.3 0.4"/></body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((6, 6))
    mujoco.mj_fullM(model, data, full)
    given = asset.inertial
    assert given is not None
    assert given.mass == 5.0
    np.testing.assert_allclose(np.array(given.center_of_mass), data.subtree_com[1], atol=1e-12)
    assert given.inertia is not None
    arm = np.asarray(given.center_of_mass)
    about_origin = given.inertia + 5 * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    np.testing.assert_allclose(about_origin, full[3:, 3:], atol=1e-10)


def test_what_is_not_stated_of_a_mass_is_not_known(tmp_path: Path) -> None:
    plain = read(tmp_path, sdf(link(SHAPES)))
    assert plain.inertial is None
    no_pose = read(tmp_path, sdf(link(inertial(2, "", "1 1 1").replace("<pose></pose>", "") + SHAPES))).inertial
    assert no_pose is not None
    assert (no_pose.mass, no_pose.center_of_mass) == (2.0, None)
    np.testing.assert_array_equal(no_pose.inertia, np.eye(3))
    mass_only = read(tmp_path, sdf(link("<inertial><mass>2</mass></inertial>" + SHAPES))).inertial
    assert mass_only is not None
    assert (mass_only.mass, mass_only.inertia) == (2.0, None)
    for bad in ("0", "-1"):
        asset = read(tmp_path, sdf(link(f"<inertial><mass>{bad}</mass></inertial>{SHAPES}")))
        assert (asset.inertial, [n.code for n in asset.notices]) == (None, ["mass_implausible"])


# Joints and bodies


@pytest.mark.parametrize(
    ("joints", "expected"),
    [
        ("<joint name='j' type='fixed'><parent>a</parent><child>b</child></joint>", (0, False)),
        ("<joint name='j' type='revolute'><parent>a</parent><child>b</child></joint>", (1, False)),
        (
            "<joint name='j' type='revolute'><parent>a</parent><child>b</child><axis><limit><lower>0</lower><upper>0</upper></limit>"
            "</axis></joint>",
            (0, False),
        ),
        (
            "<joint name='j' type='fixed'><parent>world</parent><child>a</child></joint>"
            "<joint name='k' type='prismatic'><parent>a</parent><child>b</child></joint>",
            (1, True),
        ),
        ("<joint name='j' type='fixed'><parent>a</parent><child>b</child></joint><static>true</static>", (0, True)),
    ],
)
def test_joints_that_move_are_counted(tmp_path: Path, joints: str, expected: tuple[int, bool]) -> None:
    asset = read(tmp_path, sdf(link(SHAPES) + link(SHAPES, "b") + joints))
    assert (asset.num_joints, asset.is_static) == expected


def test_things_that_nothing_connects_are_composite(tmp_path: Path) -> None:
    assert code_of(tmp_path, sdf(link(SHAPES) + link(SHAPES, "b"))) == "composite"
    assert code_of(tmp_path, "<sdf><model name='a'/><model name='b'/></sdf>") == "composite"
    assert read(tmp_path, sdf(link(SHAPES) + link("", "frame"))).num_joints == 0
    free = "<joint name='j' type='floating'><parent link='w'/><child link='a'/></joint>"
    assert read(tmp_path, f"<robot><link name='w'/><link name='a'>{URDF_SHAPES}</link>{free}</robot>", "urdf").num_joints == 0


# Friction


def test_friction_is_the_least_that_is_stated(tmp_path: Path) -> None:
    def shape(name: str, mu: str) -> str:
        return f"<collision name='{name}'>{BOX}<surface><friction><ode><mu>{mu}</mu></ode></friction></surface></collision>"

    asset = read(tmp_path, sdf(link(shape("c", "0.7") + shape("d", "0.3"))))
    assert asset.friction == (0.3, 0.005, 0.0001)
    assert {n.code for n in asset.notices} == {"friction_differs", "visual_missing"}
    drake = "<drake:proximity_properties><drake:mu_static value='0.4'/></drake:proximity_properties>"
    for text, mu in (
        (f"<link name='a'><contact><lateral_friction value='0.9'/></contact>{URDF_SHAPES}</link>", 0.9),
        (f"<link name='a'><collision>{URDF_BOX}{drake}</collision></link>", 0.4),
        (f"<link name='a'>{URDF_SHAPES}</link><gazebo reference='a'><mu1>0.2</mu1></gazebo>", 0.2),
    ):
        assert read(tmp_path, f"<robot>{text}</robot>", "urdf").friction == (mu, 0.005, 0.0001)
    assert read(tmp_path, sdf(link(SHAPES))).friction is None


# Shapes and looks


@pytest.mark.parametrize(
    ("form", "size", "volume"),
    [
        ("<box><size>1 2 3</size></box>", (1, 2, 3), 6.0),
        ("<sphere><radius>0.5</radius></sphere>", (1, 1, 1), np.pi / 6),
        ("<cylinder><radius>0.5</radius><length>2</length></cylinder>", (1, 1, 2), np.pi / 2),
        ("<capsule><radius>0.5</radius><length>2</length></capsule>", (1, 1, 3), np.pi / 2 + np.pi / 6),
        ("<ellipsoid><radii>0.5 1 1.5</radii></ellipsoid>", (1, 2, 3), np.pi),
    ],
)
def test_forms_are_closed_and_of_their_size(tmp_path: Path, form: str, size: tuple[float, ...], volume: float) -> None:
    asset = read(tmp_path, sdf(link(f"<collision name='c'><geometry>{form}</geometry></collision>")))
    np.testing.assert_allclose(asset.colliders[0].extents, size, atol=1e-9)
    assert signed_volumes(joined_triangles(asset.surfaces)).sum() == pytest.approx(volume, rel=0.008)


def test_materials_count_where_a_mesh_has_none(tmp_path: Path) -> None:
    (tmp_path / "c.stl").write_text(CUBE_STL)
    (tmp_path / "c.dae").write_text(dae(asset="<up_axis>Z_UP</up_axis>"))
    (tmp_path / "t.png").write_bytes(png())
    material = "<material><diffuse>0 1 0 1</diffuse><pbr><metal><albedo_map>t.png</albedo_map></metal></pbr></material>"

    def visual(name: str, more: str = material) -> str:
        return f"<visual name='{name}'><geometry><mesh><uri>{name}</uri></mesh></geometry><transparency>0.5</transparency>{more}</visual>"

    asset = read(
        tmp_path, sdf(link(visual("c.stl") + visual("c.dae") + visual("c.dae", "").replace("name='c.dae'", "name='x'")))
    )
    assert [(s.colour, s.image, s.opacity) for s in asset.surfaces] == [
        ((0.0, 1.0, 0.0), None, 0.5),  # no texture coordinates
        ((1.0, 1.0, 1.0), png(), 0.5),
        ((1.0, 0.0, 0.0), None, 0.5),
    ]
    robot = (
        "<robot><material name='green'><color rgba='0 1 0 0.25'/></material><link name='a'><visual><geometry><mesh filename='c.stl'/>"
        "</geometry><material name='green'/></visual></link></robot>"
    )
    assert [(s.colour, s.opacity) for s in read(tmp_path, robot, "urdf").surfaces] == [((0.0, 1.0, 0.0), 0.25)]
    outside = sdf(link(visual("c.stl", material.replace("t.png", "../../t.png"))))
    assert [n.code for n in read(tmp_path, outside).notices] == ["texture_outside"]


def test_meshes_are_scaled_and_a_part_may_be_chosen(tmp_path: Path) -> None:
    parts = "".join(
        f'<node id="{name}" name="{name}"><translate>{x} 0 0</translate><instance_geometry url="#g"/></node>'
        for name, x in (("left", 10), ("right", 20))
    )
    (tmp_path / "p.dae").write_text(dae(asset='<unit meter="0.5"/><up_axis>Z_UP</up_axis>', nodes=parts))

    def model(more: str) -> str:
        return sdf(link(f"<visual name='v'><geometry><mesh><uri>p.dae</uri>{more}</mesh></geometry></visual>"))

    assert box_of(read(tmp_path, model(""))) == [[5, 0, 0], [11, 0.5, 0]]
    assert box_of(read(tmp_path, model("<scale>2 -1 1</scale>"))) == [[10, -0.5, 0], [22, 0, 0]]
    assert box_of(read(tmp_path, model("<submesh><name>right</name></submesh>"))) == [[10, 0, 0], [11, 0.5, 0]]
    centred = "<submesh><name>right</name><center>true</center></submesh>"
    assert box_of(read(tmp_path, model(centred))) == [[-0.5, -0.25, 0], [0.5, 0.25, 0]]
    assert code_of(tmp_path, model("<submesh><name>none</name></submesh>")) == "include_missing"
    assert code_of(tmp_path, model("<scale>0 1 1</scale>")) == "model_unreadable"


def test_the_upward_axis_of_a_dae_counts_only_where_it_fits_the_colliders(tmp_path: Path) -> None:
    tall = dae(asset="<up_axis>Y_UP</up_axis>", positions="0 0 0 2 0 0 2 1 0 0 1 5")  # 2 × 1 × 5, or 2 × 5 × 1 if it is turned
    (tmp_path / "t.dae").write_text(tall)

    def model(size: str) -> str:
        box = f"<collision name='c'><geometry><box><size>{size}</size></box></geometry></collision>"
        return sdf(link(f"<visual name='v'><geometry><mesh><uri>t.dae</uri></mesh></geometry></visual>{box}"))

    plain = read(tmp_path, model("2 1 5"))
    assert (np.ptp(box_of(plain), axis=0).tolist(), plain.notices) == ([2, 1, 5], ())
    turned = read(tmp_path, model("2 5 1"))
    assert (np.ptp(box_of(turned), axis=0).tolist(), [n.code for n in turned.notices]) == ([2, 5, 1], ["up_axis_ignored"])
    neither = read(tmp_path, model("9 9 9"))
    assert (np.ptp(box_of(neither), axis=0).tolist(), neither.notices) == ([2, 1, 5], ())


def test_open_collision_meshes_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "c.stl").write_text(CUBE_STL)
    (tmp_path / "o.stl").write_text(
        CUBE_STL.replace(CUBE_STL[CUBE_STL.rindex("facet normal") : CUBE_STL.index("endsolid")], "")
    )
    shapes = "".join(
        f"<collision name='{n}'><geometry><mesh><uri>{n}.stl</uri></mesh></geometry></collision>" for n in ("c", "o")
    )
    asset = read(tmp_path, sdf(link(shapes)))
    assert [len(mesh.faces) for mesh in asset.colliders] == [12]
    assert {n.code for n in asset.notices} == {"collider_refused", "visual_missing"}


# Model folders and includes


def model_folder(root: Path, name: str, body: str, config: str = "") -> None:
    (root / name).mkdir(parents=True)
    (root / name / "model.sdf").write_text(sdf(body, name))
    (root / name / "old.sdf").write_text(sdf("", name))
    text = config or "<sdf version='1.2'>old.sdf</sdf><sdf version='1.10'>model.sdf</sdf>"
    (root / name / "model.config").write_text(f"<model><name>{name}</name>{text}</model>")


def test_model_folders_state_name_author_and_licence(tmp_path: Path) -> None:
    more = (
        "<author><name>Ann</name></author><author><name>Bob</name></author><description>A cup. It is under CC BY 4.0 license. Nice."
        "</description><sdf version='1.2'>old.sdf</sdf><sdf version='1.10'>model.sdf</sdf>"
    )
    model_folder(tmp_path, "tasse_é", link(SHAPES), more)
    model_folder(tmp_path / "deep", "cup", link(SHAPES))
    model_folder(tmp_path / "other", "cup", link(SHAPES))
    (tmp_path / "loose.sdf").write_text(sdf(link(SHAPES)))
    (tmp_path / "other" / "LICENSE").write_text("MIT License\n\nPermission is hereby granted")
    refs = [ref for ref in found(tmp_path, "sdformat") if isinstance(ref, SourceRef)]
    assert [ref.asset_id for ref in refs] == ["loose", "cup", "other_cup", "tasse_e"]
    assets = {ref.asset_id: reader_of("sdformat").read(Boundary(tmp_path), ref, ReaderOptions()) for ref in refs}
    cup = assets["tasse_e"]
    assert (cup.name, cup.author, cup.description) == ("tasse_é", "Ann, Bob", "A cup. It is under CC BY 4.0 license. Nice.")
    assert [(licence.text, licence.where) for licence in cup.licences] == [("It is under CC BY 4.0 license.", "model.config")]
    assert [n.code for n in cup.notices] == ["name_changed"]
    assert [licence.where for licence in assets["other_cup"].licences] == ["other/LICENSE"]
    assert "other/LICENSE" in refs[2].files


def test_included_models_are_parts(tmp_path: Path) -> None:
    model_folder(tmp_path, "leg", link(SHAPES))
    model_folder(
        tmp_path,
        "table",
        link(SHAPES)
        + "<include><uri>model://leg</uri><name>one</name><pose>10 0 0 0 0 0</pose></include>"
        + "<joint name='j' type='fixed'><parent>a</parent><child>one::a</child></joint>",
    )
    ref = next(r for r in found(tmp_path, "sdformat") if isinstance(r, SourceRef) and r.asset_id == "table")
    boundary = Boundary(tmp_path)
    asset = reader_of("sdformat").read(boundary, ref, ReaderOptions())
    assert box_of(asset) == [[-1, -0.5, -1.5], [11, 0.5, 1.5]]
    assert boundary.opened <= set(ref.files)
    assert {"leg/model.config", "leg/model.sdf"} <= set(ref.files)


def test_files_of_a_model_are_found_in_an_order_of_their_own(tmp_path: Path) -> None:
    """Whatever the order of sets of words in a process: the order shapes the identifiers of shards."""
    for k in range(5):
        model_folder(tmp_path, f"leg{k}", link(SHAPES))
    parts = "".join(f"<include><uri>model://leg{k}</uri><name>l{k}</name></include>" for k in (3, 1, 4, 0, 2))
    (tmp_path / "m.sdf").write_text(sdf(link(SHAPES) + parts))
    (ref,) = (item for item in found(tmp_path, "sdformat") if isinstance(item, SourceRef) and item.asset_id == "m")
    assert ref.files == ("m.sdf", *(f"leg{k}/model.{end}" for k in range(5) for end in ("config", "sdf")))


def test_bad_includes_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "in"
    model_folder(tmp_path, "outside", link(SHAPES))

    def include(uri: str) -> str:
        return sdf(link(SHAPES) + f"<include><uri>{uri}</uri></include>")

    assert code_of(root, include("model://none")) == "include_missing"
    assert code_of(root, include("../outside")) == "path_outside"
    assert code_of(root, include(str(tmp_path / "outside"))) == "path_outside"
    assert code_of(root, include("https://fuel.example.org/a/models/b")) == "path_outside"
    assert code_of(root, include("m.sdf")) == "cyclic_reference"
    for k in range(12):
        (root / f"{k}.sdf").write_text(include(f"{k + 1}.sdf"))
    assert code_of(root, include("0.sdf")) == "cyclic_reference"
    for k in range(12):
        (root / f"{k}.sdf").unlink()


# Files that cannot be used


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "model_unreadable"),
        ("<robot/>", "model_unreadable"),
        ("<sdf/>", "mesh_empty"),
        (sdf(""), "mesh_empty"),
        (sdf(link("")), "mesh_empty"),
        (sdf(link(SHAPES) * 2), "model_unreadable"),
        (sdf(link(SHAPES.replace("2 1 3", "2 1"))), "model_unreadable"),
        (sdf(link(SHAPES.replace("2 1 3", "2 1 -3"))), "model_unreadable"),
        (sdf(link(SHAPES.replace("2 1 3", "2 1 nan"))), "model_unreadable"),
        (sdf(link(SHAPES.replace("2 1 3", "2 1 1e999"))), "model_unreadable"),
        (sdf(link("<visual name='v'><geometry><plane/></geometry></visual>")), "model_unreadable"),
        (sdf(link("<visual name='v'><geometry><heightmap/></geometry></visual>")), "model_unreadable"),
        (sdf(link("<visual name='v'><geometry/></visual>")), "model_unreadable"),
        (sdf(link(f"<pose>1 2 3</pose>{SHAPES}")), "model_unreadable"),
        (sdf(link(f"<pose relative_to='x'>0 0 0 0 0 0</pose>{SHAPES}")), "model_unreadable"),
        (sdf(link(f"<pose relative_to='a'>0 0 0 0 0 0</pose>{SHAPES}")), "cyclic_reference"),
        (sdf(link(f"<pose frame='a'>0 0 0 0 0 0</pose>{SHAPES}")), "model_unreadable"),
        (sdf(link(f"<pose rotation_format='quat_xyzw'>0 0 0 0 0 0 0</pose>{SHAPES}")), "model_unreadable"),
        (sdf(link(SHAPES) + "<joint name='j' type='fixed'><parent>a</parent><child>x</child></joint>"), "model_unreadable"),
        (sdf(link("<visual name='v'><geometry><mesh><uri>none.obj</uri></mesh></geometry></visual>")), "include_missing"),
        (sdf(link("<visual name='v'><geometry><mesh><uri>/etc/passwd</uri></mesh></geometry></visual>")), "path_outside"),
        (sdf(link("<visual name='v'><geometry><mesh/></geometry></visual>")), "include_missing"),
        (sdf(link(f"<visual name='v'>{BOX}</visual>" * 2001)), "mesh_too_large"),
        ('<!DOCTYPE a [<!ENTITY x "y">]>' + sdf(link(SHAPES)).removeprefix("<?xml version='1.0'?>"), "model_unreadable"),
        ("<sdf>" * 100 + "</sdf>" * 100, "model_unreadable"),
    ],
)
def test_bad_sdformat_is_refused(tmp_path: Path, text: str, code: str) -> None:
    assert code_of(tmp_path, text) == code


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("<sdf/>", "model_unreadable"),
        ("<robot><link/></robot>", "model_unreadable"),
        ("<robot><link name='a'/></robot>", "mesh_empty"),
        (f"<robot xmlns:xacro='x'><xacro:macro/><link name='a'>{URDF_SHAPES}</link></robot>", "model_unreadable"),
        (f"<robot><link name='a'>{URDF_SHAPES}</link><joint name='j' type='fixed'/></robot>", "model_unreadable"),
        (
            f"<robot><link name='a'>{URDF_SHAPES}</link><joint name='j' type='fixed'><parent link='a'/><child link='a'/></joint></robot>",
            "cyclic_reference",
        ),
        (f"<robot><link name='a'>{URDF_SHAPES}</link><link name='b'>{URDF_SHAPES}</link></robot>", "composite"),
        ("<robot><link name='a'><visual><geometry><plane/></geometry></visual></link></robot>", "model_unreadable"),
        (
            "<robot><link name='a'><visual><geometry><mesh filename='package://p/none.stl'/></geometry></visual></link></robot>",
            "include_missing",
        ),
        (
            "<robot><link name='a'><visual><geometry><mesh filename='file:///etc/passwd'/></geometry></visual></link></robot>",
            "path_outside",
        ),
        (
            "<robot><link name='a'><visual><geometry><mesh filename='../../x.stl'/></geometry></visual></link></robot>",
            "path_outside",
        ),
        ("<!DOCTYPE r SYSTEM 'file:///etc/passwd'><robot/>", "model_unreadable"),
    ],
)
def test_bad_urdf_is_refused(tmp_path: Path, text: str, code: str) -> None:
    assert code_of(tmp_path, text, "urdf") == code


def test_xacro_is_refused_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.urdf.xacro").write_text("<robot/>")
    (notice,) = found(tmp_path, "urdf")
    assert isinstance(notice, Notice)
    assert notice.code == "model_unreadable"
    assert "xacro FILE.xacro > FILE.urdf" in notice.message


def test_a_small_file_cannot_ask_for_endless_triangles(tmp_path: Path) -> None:
    (tmp_path / "c.stl").write_text(CUBE_STL)
    shape = "<visual name='v'><geometry><mesh><uri>c.stl</uri></mesh></geometry></visual>"
    assert code_of(tmp_path, sdf(link(shape * 500)), max_faces=1000) == "mesh_too_large"


def test_one_mesh_for_what_is_seen_and_what_collides_counts_once(tmp_path: Path) -> None:
    (tmp_path / "c.stl").write_text(CUBE_STL)
    geometry = "<geometry><mesh filename='c.stl'/></geometry>"
    both, more = f"<visual>{geometry}</visual><collision>{geometry}</collision>", f"<visual>{geometry}</visual>"
    asset = read(tmp_path, f"<robot name='r'><link name='a'>{both}</link></robot>", "urdf", max_faces=12)
    assert sum(len(surface.triangles) for surface in asset.surfaces) == 12
    assert (
        code_of(tmp_path, f"<robot name='r'><link name='a'>{both}{more}</link></robot>", "urdf", max_faces=12)
        == "mesh_too_large"
    )


def test_long_chains_end(tmp_path: Path) -> None:
    frames = "".join(f"<frame name='f{k}'><pose relative_to='f{k + 1}'>0 0 0 0 0 0</pose></frame>" for k in range(1500))
    far = f"<visual name='v'><pose relative_to='f0'>0 0 0 0 0 0</pose>{BOX}</visual>"
    assert code_of(tmp_path, sdf(link(far) + frames + "<frame name='f1500'/>")) == "cyclic_reference"
    links = "".join(f"<link name='{k}'/>" for k in range(3000))
    joints = "".join(
        f"<joint name='j{k}' type='fixed'><parent link='{k}'/><child link='{k + 1}'/></joint>" for k in range(2999)
    )
    assert code_of(tmp_path, f"<robot>{links}{joints}</robot>", "urdf") == "mesh_too_large"
    assert code_of(tmp_path, sdf("".join(link("", f"l{k}") for k in range(3000)))) == "mesh_too_large"


def test_package_paths_are_found_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "c.stl").write_text(CUBE_STL)
    mesh = "<geometry><mesh filename='package://my_robot/meshes/c.stl' scale='2'/></geometry>"
    asset = read(tmp_path, f"<robot><link name='a'><visual>{mesh}</visual></link></robot>", "urdf")
    assert box_of(asset) == [[0, 0, 0], [2, 2, 2]]
