"""Assets of sources become rows of tables."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import load_paint
from stable_data.geometry.surface import Surface
from stable_data.importers.conversion import ConversionContext, ConversionSettings, ConvertedAsset, convert
from stable_data.importers.source import GivenInertial, GivenLicence, SourceAsset
from stable_data.storage.schemas import SCHEMAS
from tests.stable_data.importers.conversion.sources import BOTTLE, CUP, asset, box, revolved

pytest.importorskip("stable_data.assets.looks")

CONTEXT = ConversionContext()
PLAIN = ConversionSettings(decomposes=False, num_points=32)


class Steps:
    """Keeps the names of all steps."""

    def __init__(self) -> None:
        self.all: list[str] = []

    @property
    def step(self) -> str:
        return self.all[-1]

    @step.setter
    def step(self, name: str) -> None:
        self.all.append(name)


def converted(source: SourceAsset, settings: ConversionSettings = PLAIN) -> ConvertedAsset:
    return convert(source, settings, CONTEXT, Steps(), source_path="a/b.obj")


def codes(found: ConvertedAsset) -> list[str]:
    return [notice.code for notice in found.notices]


def test_a_cup_in_centimetres() -> None:
    cup = revolved(CUP)
    source = Mesh(cup.vertices * 100 + np.array([500.0, 0.0, 0.0]), cup.faces)
    found = converted(asset(source, "coffee_cup_01", unit_m=0.01, is_upright=True, author="A", url="https://b", source_set="C"))
    row = found.asset_row
    assert row["extents"] == pytest.approx([0.08, 0.08, 0.09])
    assert (row["category"], row["category_source"], row["description"]) == ("coffee_cup", "name", "coffee cup")
    assert (row["licence"], row["licence_where"], row["author"], row["source_url"], row["source"]) == (
        "CC0-1.0", "LICENSE.txt", "A", "https://b", "C",
    )  # fmt: skip
    assert (row["scale_source"], row["scale_inferred"], row["scale_confidence"]) == ("given", False, 1.0)
    assert row["size_low"] == row["size_high"] == pytest.approx(0.09)
    assert (row["is_container"], row["on_table"], row["is_static"], row["is_graspable"]) == (True, True, False, True)
    assert row["resting_tilts"][0]["tilt_quat_xyzw"] == (0, 0, 0, 1)
    assert (row["rest_source"], row["mass_source"], row["source_path"]) == ("up_axis", "category", "a/b.obj")
    mesh, _ = load_glb(found.mesh_row["glb"], "a")
    assert mesh.extents == pytest.approx([0.08, 0.08, 0.09], rel=1e-5)
    assert load_paint(found.mesh_row["glb"], "a", mesh)[0][0].startswith("#")
    assert found.mesh_row["parts"] is None
    assert codes(found) == []


def test_rows_fit_the_tables() -> None:
    found = converted(asset(revolved(CUP), "cup", unit_m=1.0, friction=(0.5, 0.01, 0.001), front=(0.0, -1.0, 0.0)))
    for name, row in (("assets", found.asset_row), ("meshes", found.mesh_row)):
        assert list(row) == SCHEMAS[name].names
        assert pa.Table.from_pylist([row], SCHEMAS[name]).num_rows == 1
    for name in ("author", "material", "inertia"):
        assert found.asset_row[name] is None
    assert found.asset_row["friction"] == [0.5, 0.01, 0.001]


def test_the_same_asset_gives_the_same_rows() -> None:
    one, other = (converted(asset(revolved(BOTTLE), "bottle", unit_m=1.0)) for _ in range(2))
    assert repr(one) == repr(other)


def test_given_masses_are_kept_and_moved_to_the_centre_of_the_box() -> None:
    solid = box(0.1, 0.2, 0.3, at=(1.0, 2.0, 3.0))
    true = mass_properties(solid, mass=2.0)
    given = GivenInertial(2.0, tuple(true.center_of_mass.tolist()), true.inertia)
    row = converted(asset(solid, "crate", unit_m=1.0, inertial=given)).asset_row
    assert (row["mass"], row["mass_source"]) == (2.0, "given")
    assert row["center_of_mass"] == pytest.approx([0, 0, 0], abs=1e-12)
    assert row["inertia"] == pytest.approx(true.inertia.ravel().tolist())
    assert row["inertia_per_mass"] == pytest.approx((true.inertia / 2).ravel().tolist())


def test_the_place_of_a_mass_has_no_meaning_without_a_unit() -> None:
    given = GivenInertial(0.3, (5.0, 5.0, 5.0), np.eye(3))
    found = converted(asset(revolved(CUP), "cup", inertial=given))
    assert (found.asset_row["mass"], found.asset_row["inertia"], codes(found)) == (0.3, None, ["scale_inferred"])


def test_given_colliders_are_used_if_they_follow_the_mesh() -> None:
    true, false = box(10, 20, 30, at=(7, 0, 0)), box(20, 20, 30, at=(7, 0, 0))
    source = asset(true, "crate", unit_m=0.01)
    found = converted(replace(source, colliders=(true,)))
    assert (found.mesh_row["parts_source"], found.mesh_row["parts_method"]) == ("given", "given")
    assert np.ptp(found.mesh_row["parts"][0]["vertices"].reshape(-1, 3), axis=0) == pytest.approx([0.1, 0.2, 0.3])
    assert converted(replace(source, colliders=(false,))).mesh_row["parts"] is None
    settings = replace(PLAIN, decomposes=True)
    assert converted(replace(source, colliders=(false,)), settings).mesh_row["parts_source"] == "computed"


def picture() -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 30, 30)).save(file, "PNG")
    return file.getvalue()


def test_textures_come_along_and_lie_on_the_mesh() -> None:
    cup = revolved(CUP)
    surface = Surface(cup.triangles + 3, (1.0, 1.0, 1.0), image=picture(), corner_uv=cup.triangles[..., :2] * 5)
    found = converted(replace(asset(cup, "cup", unit_m=1.0), surfaces=(surface,)))
    assert len(found.textures) == 1
    assert pa.Table.from_pylist(list(found.textures), SCHEMAS["textures"]).num_rows == 1
    assert found.mesh_row["look"] is not None
    assert found.asset_row["extents"] == pytest.approx([0.08, 0.08, 0.09])
    mesh, _ = load_glb(found.mesh_row["glb"], "a")
    assert load_paint(found.mesh_row["glb"], "a", mesh)[0][0].startswith("#c8")


def test_a_broken_texture_costs_the_colours_alone() -> None:
    cup = revolved(CUP)
    surface = Surface(cup.triangles, (1.0, 1.0, 1.0), image=b"no picture", corner_uv=cup.triangles[..., :2])
    found = converted(replace(asset(cup, "cup", unit_m=1.0), surfaces=(surface,)))
    assert "texture_invalid" in codes(found)
    assert found.textures == ()


def test_large_meshes_are_reduced_and_say_by_how_much() -> None:
    angle = np.linspace(0, np.pi, 60)
    ball = revolved(list(zip(0.04 * np.sin(angle), -0.04 * np.cos(angle), strict=True)), segments=60)
    found = converted(asset(ball, "ball", unit_m=1.0), replace(PLAIN, max_faces=1000))
    assert "mesh_reduced" in codes(found)
    assert found.mesh_row["source_faces"] == len(ball.faces)
    assert 0 < found.mesh_row["source_reduction"] < 1e-3
    assert found.asset_row["report"]["num_faces"] <= 1200
    assert found.asset_row["volume"] == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.02)


def test_open_meshes_are_used_and_warned() -> None:
    found = converted(asset(revolved(CUP[:3]), "cup", unit_m=1.0, is_upright=True))
    assert codes(found) == ["open_sheet"]
    assert found.asset_row["is_container"] is True


def test_copies_in_another_unit_and_place_have_one_hash() -> None:
    cup = revolved(CUP)
    turn = Rotation.from_euler("z", 0.3).as_matrix()
    copy = Mesh(cup.vertices @ turn.T * 1000 + np.array([5.0, 6.0, 7.0]), cup.faces[::-1])
    one, other = converted(asset(cup, "cup", unit_m=1.0)), converted(asset(copy, "b", unit_m=0.001))
    assert one.asset_row["geometry_hash"] == other.asset_row["geometry_hash"]


def test_furniture_is_no_thing_on_a_table() -> None:
    row = converted(asset(box(1.2, 0.6, 0.7), "desk", unit_m=1.0, is_static=True)).asset_row
    assert (row["is_static"], row["on_table"], row["is_graspable"]) == (True, False, False)


@pytest.mark.parametrize(
    ("given", "code", "step"),
    [
        ({"num_joints": 2}, "articulated", "licence"),
        ({"licences": ()}, "licence_unknown", "licence"),
        ({"licences": (GivenLicence("CC BY-NC 4.0", "manifest"),)}, "licence_refused", "licence"),
        ({"surfaces": (Surface(np.zeros((0, 3, 3))),)}, "mesh_empty", "mesh"),
        ({"surfaces": (Surface(np.full((2, 3, 3), np.nan)),)}, "mesh_not_finite", "mesh"),
        ({"unit_m": 1000.0}, "unit_implausible", "scale"),
        ({"unit_m": None, "name": "zorble"}, "scale_unknown", "scale"),
    ],
)
def test_what_cannot_be_used_says_why(given: dict[str, Any], code: str, step: str) -> None:
    progress = Steps()
    with pytest.raises(MeshError, match="asset cup") as error:
        convert(replace(asset(revolved(CUP), "cup", unit_m=1.0), **given), PLAIN, CONTEXT, progress)
    assert (error.value.code, progress.step) == (code, step)


def test_a_kit_without_a_unit_keeps_its_own_proportions() -> None:
    kit = [
        asset(Mesh(m.vertices * 7, m.faces), name) for m, name in ((revolved(CUP), "cup"), (revolved(BOTTLE), "water_bottle"))
    ]
    extents = [each.surfaces[0].triangles.reshape(-1, 3).max(axis=0) * 2 for each in kit]
    common = CONTEXT.set_scale([(each, size.tolist()) for each, size in zip(kit, extents, strict=True)])
    assert common is not None
    settings = replace(PLAIN, set_scale=common)
    cup, bottle = (converted(each, settings).asset_row for each in kit)
    assert (cup["scale_source"], bottle["scale_inferred"]) == ("set", True)
    assert max(bottle["extents"]) / max(cup["extents"]) == pytest.approx(0.25 / 0.09)
