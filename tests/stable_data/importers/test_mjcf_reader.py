"""MuJoCo objects: what is seen, what collides, what a mass rests on; and nothing is read outside of the folder."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stable_data.assets.licences import normalise_licence
from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import is_closed, signed_volumes
from stable_data.geometry.mesh_colors import to_linear
from stable_data.importers.boundary import Boundary
from stable_data.importers.mjcf import MjcfReader
from stable_data.importers.mjcf.text import MjcfText
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.simulation.mujoco_import import mujoco

ROBOSUITE = Path(__file__).parents[2] / "data" / "import" / "robosuite"
PYRAMID = """
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
v 0 0 2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 3/3 2/2
f 1/1 4/4 3/3
f 1/1 2/2 5/3
f 2/2 3/3 5/4
f 3/3 4/4 5/1
f 4/4 1/1 5/2
"""


def found(folder: Path) -> list[SourceRef | Notice]:
    return list(MjcfReader().find(Boundary(folder), ReaderOptions()))


def read_all(folder: Path, **options: Any) -> dict[str, SourceAsset]:
    """Reads every model, and checks that all files that were opened had been planned."""
    assets = {}
    for ref in found(folder):
        assert isinstance(ref, SourceRef), ref
        boundary = Boundary(folder)
        assets[ref.asset_id] = MjcfReader().read(boundary, ref, ReaderOptions(**options))
        assert boundary.opened <= set(ref.files)
    return assets


def read_model(folder: Path, text: str, **options: Any) -> SourceAsset:
    (folder / "thing.xml").write_text(text)
    return MjcfReader().read(Boundary(folder), SourceRef("thing", "thing.xml", ("thing.xml",)), ReaderOptions(**options))


def model(body: str, assets: str = "", extra: str = "") -> str:
    return f"<mujoco>{extra}<asset>{assets}</asset><worldbody><body>{body}</body></worldbody></mujoco>"


def refusal(folder: Path, text: str, **options: Any) -> MeshError:
    with pytest.raises(MeshError) as caught:
        read_model(folder, text, **options)
    return caught.value


def box_of(asset: SourceAsset) -> np.ndarray[Any, Any]:
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in asset.surfaces])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def png(colour: tuple[int, int, int] = (200, 30, 10)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4), colour).save(buffer, "PNG")
    return buffer.getvalue()


def test_objects_of_robosuite_are_as_mujoco_sees_them() -> None:
    assets = read_all(ROBOSUITE)
    assert sorted(assets) == ["bread", "lemon", "round-nut"]
    for name, asset in assets.items():
        compiled = mujoco.MjModel.from_xml_path(str(ROBOSUITE / "objects" / f"{name}.xml"))
        data = mujoco.MjData(compiled)
        mujoco.mj_kinematics(compiled, data)
        corners = []
        for geom in range(compiled.ngeom):
            mesh = compiled.geom_dataid[geom]
            if mesh >= 0:
                first = compiled.mesh_vertadr[mesh]
                local = compiled.mesh_vert[first : first + compiled.mesh_vertnum[mesh]]
            else:
                local = compiled.geom_size[geom] * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
            corners.append(local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
        every = np.concatenate(corners)
        np.testing.assert_allclose(box_of(asset), [every.min(axis=0), every.max(axis=0)], atol=1e-9)
        assert asset.inertial is not None
        assert asset.inertial.mass == float(compiled.body_mass.sum())
        assert not asset.inertial.is_weighed, "it follows from a density"
        assert asset.unit_m == 1.0
        assert asset.friction == (0.95, 0.3, 0.1)
        assert (asset.num_joints, asset.is_static, asset.notices) == (0, False, ())
        assert [normalise_licence(licence.text) for licence in asset.licences] == ["MIT", "Apache-2.0"]
        assert {licence.where for licence in asset.licences} == {"LICENSE"}
        assert len(asset.colliders) == compiled.ngeom
        assert all(is_closed(collider) for collider in asset.colliders)
    texture = (ROBOSUITE / "textures" / "lemon.png").read_bytes()
    assert assets["lemon"].surfaces[0].image == texture
    assert assets["lemon"].surfaces[0].corner_uv is not None


def test_texture_coordinates_count_from_the_upper_left(tmp_path: Path) -> None:
    (tmp_path / "p.obj").write_text(PYRAMID)
    (tmp_path / "t.png").write_bytes(png())
    assets = '<texture name="t" type="2d" file="t.png"/><material name="m" texture="t"/><mesh name="p" file="p.obj" scale=".1 .1 .1"/>'
    (surface,) = read_model(tmp_path, model('<geom type="mesh" mesh="p" material="m"/>', assets)).surfaces
    assert surface.image == png()
    assert surface.colour == (1.0, 1.0, 1.0)
    assert surface.corner_uv is not None
    low = surface.triangles[..., 2] < 1e-6
    expected = np.stack([surface.triangles[..., 0] * 5 + 0.5, 0.5 - surface.triangles[..., 1] * 5], axis=-1)
    np.testing.assert_allclose(surface.corner_uv[:2], expected[:2], atol=1e-6)
    assert low[:2].all()


def test_a_texture_without_coordinates_is_projected_as_mujoco_does(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(png())
    assets = '<texture name="t" type="2d" file="t.png"/><material name="m" texture="t" texrepeat="10 20" texuniform="true"/>'
    (surface,) = read_model(tmp_path, model('<geom type="box" size=".1 .2 .3" material="m"/>', assets)).surfaces
    assert surface.corner_uv is not None
    np.testing.assert_allclose(surface.corner_uv, surface.triangles[..., :2] * (5, -10) - 0.5)
    cube = assets.replace('"2d"', '"cube"').replace('texuniform="true"', "")
    (surface,) = read_model(tmp_path, model('<geom type="box" size=".1 .2 .3" material="m"/>', cube)).surfaces
    assert surface.corner_uv is not None
    assert set(np.unique(surface.corner_uv.round(9))) == {0.0, 1.0}, "each face of the box shows the whole image"


def test_an_image_of_several_names_is_in_memory_once(tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(png())
    names = ["t.png", "./t.png", "T.PNG"]
    assets = "".join(
        f'<texture name="t{k}" type="2d" file="{name}"/><material name="m{k}" texture="t{k}"/>' for k, name in enumerate(names)
    )
    body = "".join(f'<geom type="box" size=".1 .2 .3" material="m{k}"/>' for k in range(len(names)))
    surfaces = read_model(tmp_path, model(body, assets)).surfaces
    assert [surface.image for surface in surfaces] == [png()] * 3
    assert len({id(surface.image) for surface in surfaces}) == 1


def test_colours_of_materials_and_geoms(tmp_path: Path) -> None:
    assets = (
        '<material name="m" rgba=".2 .4 .6 .5"/><texture name="t" type="2d" builtin="flat" rgb1="1 .5 0" width="9" height="9"/>'
    )
    assets += '<material name="flat" texture="t"/>'
    body = '<geom size=".1" material="m"/><geom size=".1" material="m" rgba="1 0 0 1"/><geom size=".1"/><geom size=".1" material="flat"/>'
    one, two, three, four = read_model(tmp_path, model(body, assets)).surfaces
    assert one.colour is not None
    np.testing.assert_allclose(one.colour, to_linear(np.array([0.2, 0.4, 0.6])), atol=1e-6)
    assert one.opacity == pytest.approx(0.5)
    assert two.colour == (1.0, 0.0, 0.0)
    assert three.colour is None
    assert four.colour is not None
    np.testing.assert_allclose(four.colour, to_linear(np.array([1.0, 0.5, 0.0])), atol=1e-6)


def test_scanned_objects_with_classes_for_what_is_seen_and_what_collides(tmp_path: Path) -> None:
    folder = tmp_path / "Coffee Mug"
    folder.mkdir()
    for name in ("model", "model_collision_0", "model_collision_1"):
        (folder / f"{name}.obj").write_text(PYRAMID)
    (folder / "texture.jpg").write_bytes(b"bytes of a JPEG")
    (folder / "model.xml").write_text(
        """<mujoco model="x"><default><default class="visual"><geom group="2" type="mesh" contype="0" conaffinity="0"/></default>
        <default class="collision"><geom group="3" type="mesh"/></default></default>
        <asset><texture type="2d" name="texture" file="texture.jpg"/><material name="m" texture="texture"/>
        <mesh file="model.obj" scale=".05 .05 .05"/><mesh file="model_collision_0.obj" scale=".05 .05 .05"/>
        <mesh file="model_collision_1.obj" scale=".05 .05 .05"/></asset>
        <worldbody><body quat="0 1 0 0"><freejoint/><geom material="m" mesh="model" class="visual"/>
        <geom mesh="model_collision_0" class="collision"/><geom mesh="model_collision_1" class="collision" pos="0 0 1"/></body>
        </worldbody></mujoco>"""
    )
    assets = read_all(tmp_path)
    assert list(assets) == ["Coffee_Mug"]
    asset = assets["Coffee_Mug"]
    assert asset.name == "Coffee Mug"
    assert len(asset.surfaces) == 1
    assert asset.surfaces[0].image == b"bytes of a JPEG", "MuJoCo could not decode it, and need not"
    np.testing.assert_allclose(box_of(asset), [[-0.05, -0.05, -0.1], [0.05, 0.05, 0]], atol=1e-7)
    assert [round(float(c.vertices[:, 2].min()), 6) for c in asset.colliders] == [-0.1, -1.1]
    assert asset.num_joints == 0
    assert asset.friction is None
    assert [notice.code for notice in asset.notices] == ["name_changed"]


def test_objects_of_robocasa_have_a_category_and_an_upright_pose(tmp_path: Path) -> None:
    folder = tmp_path / "objects" / "bell_pepper" / "bell_pepper_3"
    folder.mkdir(parents=True)
    (folder / "model.xml").write_text(
        model(
            '<geom size=".04" contype="0" conaffinity="0" group="1" mass="1e-8"/><geom size=".03" rgba=".8 .8 .8 0"/>'
            '<geom name="reg_bbox" type="box" size=".05 .05 .05" contype="0" conaffinity="0" rgba="0 1 0 .5" group="1"/>'
        )
    )
    (asset,) = read_all(tmp_path).values()
    assert (asset.name, asset.category, asset.is_upright) == ("bell_pepper_3", "bell pepper", True)
    assert len(asset.surfaces) == len(asset.colliders) == 1
    np.testing.assert_allclose(np.ptp(box_of(asset), axis=0), 0.08)


def test_groups_tell_a_seen_collider_from_the_others(tmp_path: Path) -> None:
    body = '<geom size=".1" contype="0" conaffinity="0" group="1"/><geom size=".2" group="1"/><geom size=".3" group="0"/>'
    asset = read_model(tmp_path, model(body))
    assert [round(float(np.ptp(surface.triangles[..., 2])), 6) for surface in asset.surfaces] == [0.2, 0.4]
    assert len(asset.colliders) == 2
    without_groups = body.replace('group="1"', 'group="0"')
    assert len(read_model(tmp_path, model(without_groups)).surfaces) == 1
    assert len(read_model(tmp_path, model('<geom size=".1"/><geom size=".2" group="3"/>')).surfaces) == 1
    assert len(read_model(tmp_path, model('<geom size=".2" group="3"/>')).surfaces) == 1, "nothing else is there"


@pytest.mark.parametrize(
    ("geom", "size", "volume"),
    [
        ('type="box" size=".1 .2 .3"', (0.2, 0.4, 0.6), 0.048),
        ('type="sphere" size=".1"', (0.2, 0.2, 0.2), 4 / 3 * math.pi * 1e-3),
        ('type="ellipsoid" size=".1 .2 .3"', (0.2, 0.4, 0.6), 4 / 3 * math.pi * 6e-3),
        ('type="cylinder" size=".1 .3"', (0.2, 0.2, 0.6), math.pi * 6e-3),
        ('type="capsule" size=".1 .3"', (0.2, 0.2, 0.8), math.pi * 6e-3 + 4 / 3 * math.pi * 1e-3),
        ('type="mesh" mesh="p"', (2, 2, 2), 8 / 3),
        ('type="mesh" mesh="mirrored"', (2, 2, 2), 8 / 3),
    ],
)
def test_shapes_are_closed_and_as_large_as_stated(tmp_path: Path, geom: str, size: tuple[float, ...], volume: float) -> None:
    (tmp_path / "p.obj").write_text(PYRAMID)
    assets = '<mesh name="p" file="p.obj"/><mesh name="mirrored" file="p.obj" scale="-1 1 1"/>'
    asset = read_model(tmp_path, model(f"<geom {geom}/>", assets))
    np.testing.assert_allclose(np.ptp(box_of(asset), axis=0), size, atol=1e-6)
    (collider,) = asset.colliders
    assert is_closed(collider)
    assert float(signed_volumes(collider.triangles).sum()) == pytest.approx(volume, rel=0.01)
    assert float(signed_volumes(asset.surfaces[0].triangles).sum()) == pytest.approx(volume, rel=0.01)


def test_a_stated_mass_with_its_centre_and_inertia(tmp_path: Path) -> None:
    inertial = (
        '<inertial pos=".1 0 0" quat=".7071067811865476 0 0 .7071067811865476" mass=".3" diaginertia="1e-3 2e-3 2.5e-3"/>'
    )
    body = f'{inertial}<geom size=".1"/><body pos="0 0 1"><inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body>'
    given = read_model(tmp_path, model(body)).inertial
    assert given is not None
    assert given.is_weighed
    assert given.mass == pytest.approx(0.4)
    np.testing.assert_allclose(given.center_of_mass, [0.075, 0, 0.25], atol=1e-12)  # type: ignore[arg-type]
    offset = np.array([0.1, 0, -1.0])  # of the two centres; the reduced mass is 0.3 * 0.1 / 0.4
    shifted = 0.075 * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    assert given.inertia is not None
    np.testing.assert_allclose(given.inertia, np.diag([2.1e-3, 1.1e-3, 2.6e-3]) + shifted, atol=1e-12)


@pytest.mark.parametrize(
    ("body", "extra", "mass", "is_weighed"),
    [
        ('<geom size=".1" mass=".2"/>', "", 0.2, True),
        ('<geom size=".1" mass=".2"/><geom size=".1" contype="0" conaffinity="0" mass="1e-8"/>', "", 0.2, True),
        ('<geom size=".1" mass=".2"/><geom size=".1" contype="0" conaffinity="0"/>', "", 4.38879, False),
        ('<geom size=".1"/>', "", 4.18879, False),
        ('<geom size=".1"/>', '<compiler settotalmass="2"/>', 2.0, True),
        (
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom size=".1"/>',
            '<compiler inertiafromgeom="true"/>',
            4.18879,
            False,
        ),
    ],
)
def test_what_a_mass_rests_on(tmp_path: Path, body: str, extra: str, mass: float, is_weighed: bool) -> None:
    given = read_model(tmp_path, model(body, extra=extra)).inertial
    assert given is not None
    assert given.mass == pytest.approx(mass, rel=1e-5)
    assert given.is_weighed is is_weighed
    assert (given.inertia is not None) is is_weighed


def test_a_mass_of_a_picture_alone_is_no_mass(tmp_path: Path) -> None:
    assert read_model(tmp_path, model('<geom size=".1" mass=".0001" contype="0" conaffinity="0"/>')).inertial is None


def test_friction_of_several_colliders_is_their_mean_by_surface(tmp_path: Path) -> None:
    body = '<geom type="box" size=".1 .1 .1" friction=".2"/><geom type="box" size=".2 .2 .2" friction=".7"/>'
    asset = read_model(tmp_path, model(body))
    assert asset.friction == pytest.approx((0.6, 0.005, 0.0001))
    assert [notice.code for notice in asset.notices] == ["friction_averaged"]


def test_joints_that_move_are_counted(tmp_path: Path) -> None:
    inner = '<body><joint type="ball"/><geom size=".1"/></body>'
    body = f'<freejoint/><geom size=".1"/><body><joint type="hinge"/><geom size=".1"/>{inner}</body>'
    assert read_model(tmp_path, model(body)).num_joints == 2


def test_a_flat_surface_that_is_only_seen_is_kept(tmp_path: Path) -> None:
    flat = '<mesh name="f" vertex="0 0 0 1 0 0 1 1 0 0 1 0" face="0 1 2 0 2 3"/>'
    asset = read_model(tmp_path, model('<geom type="mesh" mesh="f" contype="0" conaffinity="0"/><geom size=".1"/>', flat))
    assert len(asset.surfaces[0].triangles) == 2
    assert asset.inertial is None, "the mass of a shell is not that of the file"


def test_statements_of_the_section_custom(tmp_path: Path) -> None:
    texts = "".join(
        f'<text name="{name}" data="{data}"/>' for name, data in (("license", "CC0"), ("author", "A"), ("url", "B"))
    )
    asset = read_model(tmp_path, model('<geom size=".1"/>', extra=f"<custom>{texts}</custom>"), front="-y")
    assert [(licence.text, licence.where) for licence in asset.licences] == [("CC0", "thing.xml")]
    assert (asset.author, asset.url, asset.front) == ("A", "B", (0.0, -1.0, 0.0))


def test_includes_are_put_in_place_and_are_no_assets(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "p.obj").write_text(PYRAMID)
    (tmp_path / "parts" / "assets.xml").write_text(
        '<mujocoinclude><compiler meshdir="meshes"/><asset><mesh file="p.obj"/></asset><include file="more.xml"/></mujocoinclude>'
    )
    (tmp_path / "parts" / "more.xml").write_text('<mujoco><default><geom friction=".4"/></default></mujoco>')
    (tmp_path / "thing.xml").write_text(model('<geom type="mesh" mesh="p"/>', extra='<include file="parts/assets.xml"/>'))
    (tmp_path / "scene.xml").write_text(
        '<mujoco><include file="thing.xml"/><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
    (tmp_path / "other.xml").write_text("<robot/>")
    assets = read_all(tmp_path)
    assert list(assets) == ["thing"]
    assert assets["thing"].friction == pytest.approx((0.4, 0.005, 0.0001))


def test_two_models_of_one_name_get_different_identifiers(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cup.xml").write_text(model('<geom size=".1"/>'))
    assert list(read_all(tmp_path)) == ["cup", "b_cup"]


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ('<geom type="plane" size="1 1 1"/>', "composite"),
        ('<freejoint/><geom size=".1"/></body><body><freejoint/><geom size=".1"/>', "composite"),
        ('<geom size=".1"/></body><geom size=".2"/><body>', "composite"),
        ('<freejoint/><geom size=".1"/></body><body><geom size=".2"/>', "composite"),
        ('<geom size=".1" rgba="1 1 1 0"/>', "mesh_empty"),
        ('<geom size=".1" material="none"/>', "model_unreadable"),
        ('<geom size="nan"/>', "model_unreadable"),
        ('<replicate count="1000000000" offset="1 0 0"><geom size=".1"/></replicate>', "model_unsupported"),
        ('<composite type="cable" count="999 1 1"/>', "model_unsupported"),
        ('<plugin plugin="mujoco.sdf.torus"/>', "model_unsupported"),
        ('<attach model="m" body="b" prefix="p"/>', "model_unsupported"),
    ],
)
def test_what_is_no_rigid_object_is_refused(tmp_path: Path, body: str, code: str) -> None:
    error = refusal(tmp_path, model(body))
    assert error.code == code
    assert "\n" not in str(error)


def test_meshes_with_too_many_triangles_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p.obj").write_text(PYRAMID)
    assert (
        refusal(tmp_path, model('<geom type="mesh" mesh="p"/>', '<mesh file="p.obj"/>'), max_faces=5).code == "mesh_too_large"
    )


@pytest.fixture
def outside(tmp_path: Path) -> tuple[Path, Path]:
    """The source folder, and a folder beside it with files that must not be read."""
    inside, secret = tmp_path / "inside", tmp_path / "secret"
    inside.mkdir()
    secret.mkdir()
    (secret / "p.obj").write_text(PYRAMID)
    (secret / "t.png").write_bytes(png())
    (secret / "m.xml").write_text('<mujocoinclude><default><geom friction=".4"/></default></mujocoinclude>')
    (inside / "link.obj").symlink_to(secret / "p.obj")
    return inside, secret


@pytest.mark.parametrize(
    ("extra", "assets"),
    [
        ('<include file="../secret/m.xml"/>', ""),
        ('<include file="{secret}/m.xml"/>', ""),
        ("", '<mesh name="p" file="../secret/p.obj"/>'),
        ("", '<mesh name="p" file="{secret}/p.obj"/>'),
        ("", '<mesh name="p" file="..\\secret\\p.obj"/>'),
        ("", '<mesh name="p" file="https://example.org/p.obj"/>'),
        ("", '<mesh name="p" file="link.obj"/>'),
        ('<compiler meshdir="../secret"/>', '<mesh name="p" file="p.obj"/>'),
        ('<compiler meshdir="{secret}"/>', '<mesh name="p" file="p.obj"/>'),
        ('<compiler assetdir="{secret}"/>', '<mesh name="p" file="p.obj"/>'),
    ],
)
def test_no_file_outside_of_the_folder_is_read(outside: tuple[Path, Path], extra: str, assets: str) -> None:
    inside, secret = outside
    geom = '<geom type="mesh" mesh="p"/>' if assets else '<geom size=".1"/>'
    text = model(geom, assets.format(secret=secret), extra.format(secret=secret))
    assert refusal(inside, text).code == "path_outside"
    (ref,) = found(inside) if assets else (None,)
    assert ref is None or (isinstance(ref, SourceRef) and ref.files == ("thing.xml",))
    assert assets or [notice.code for notice in found(inside) if isinstance(notice, Notice)] == ["path_outside"]


@pytest.mark.parametrize(
    ("file", "code"),
    [("../secret/t.png", "texture_outside"), ("{secret}/t.png", "texture_outside"), ("none.png", "texture_missing")],
)
def test_a_texture_outside_of_the_folder_costs_the_texture_alone(outside: tuple[Path, Path], file: str, code: str) -> None:
    inside, secret = outside
    assets = f'<texture name="t" type="2d" file="{file.format(secret=secret)}"/><material name="m" texture="t" rgba="1 0 0 1"/>'
    asset = read_model(inside, model('<geom size=".1" material="m"/><geom size=".2" material="m"/>', assets))
    assert [(surface.image, surface.colour) for surface in asset.surfaces] == [(None, (1.0, 0.0, 0.0))] * 2
    assert [notice.code for notice in asset.notices] == [code]


def test_files_named_by_other_elements_are_refused(outside: tuple[Path, Path]) -> None:
    inside, secret = outside
    assert refusal(inside, model('<geom size=".1"/>', f'<model name="m" file="{secret}/m.xml"/>')).code == "model_unsupported"
    assert refusal(inside, model('<geom size=".1"/>', f'<hfield name="h" file="{secret}/t.png"/>')).code == "model_unsupported"


def test_the_compiled_text_names_no_file() -> None:
    text = MjcfText.load(Boundary(ROBOSUITE), "objects/bread.xml")
    assert text is not None
    isolated = text.isolated(Boundary(ROBOSUITE), 10**6)
    assert list(isolated.meshes) == ["0.stl"]
    assert isolated.text.count("file=") == isolated.text.count('file="0.stl"') == 1
    assert "/" not in isolated.text.replace("</", "").replace("/>", "").replace(" />", "")


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({"thing.xml": '<mujoco><include file="thing.xml"/></mujoco>'}, "cyclic_reference"),
        (
            {"thing.xml": '<mujoco><include file="a.xml"/></mujoco>', "a.xml": '<mujoco><include file="thing.xml"/></mujoco>'},
            "cyclic_reference",
        ),
        (
            {
                "thing.xml": '<mujoco><include file="i0.xml"/></mujoco>',
                **{f"i{k}.xml": f'<mujocoinclude><include file="i{k + 1}.xml"/></mujocoinclude>' for k in range(12)},
                "i12.xml": "<mujocoinclude/>",
            },
            "cyclic_reference",
        ),
        (
            {"thing.xml": '<!DOCTYPE a [<!ENTITY b "c">]><mujoco><worldbody><geom name="&b;"/></worldbody></mujoco>'},
            "model_unreadable",
        ),
        ({"thing.xml": "<mujoco>" + "<body>" * 100 + "</body>" * 100 + "</mujoco>"}, "model_unreadable"),
        ({"thing.xml": "<mujoco><worldbody>"}, "model_unreadable"),
        ({"thing.xml": '<mujoco><include file="none.xml"/></mujoco>'}, "file_missing"),
    ],
)
def test_hostile_text_is_refused_when_models_are_listed(tmp_path: Path, files: dict[str, str], code: str) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    notices = [notice for notice in found(tmp_path) if isinstance(notice, Notice)]
    assert code in {notice.code for notice in notices if notice.item_id == "thing"}
    assert refusal(tmp_path, files["thing.xml"]).code == code


def test_what_is_read_does_not_depend_on_the_order_or_the_time(tmp_path: Path) -> None:
    one, two = read_all(ROBOSUITE), read_all(ROBOSUITE)
    for a, b in zip(one.values(), two.values(), strict=True):
        for x, y in zip(a.surfaces, b.surfaces, strict=True):
            assert x.triangles.tobytes() == y.triangles.tobytes()
