"""The scan of a model's files: what MuJoCo would read is known before, and nothing outside of the folder is read."""

from pathlib import Path

import pytest

from stable_data.errors import MeshError
from stable_data.importers.boundary import Boundary
from stable_data.importers.mjcf_files import collect_files, compile_model, load_spec, start_tags
from stable_data.importers.scenes.mjcf_scenes import read_mjcf_scene
from tests.bounds import soon
from tests.scene_files import write_corner, write_model


def test_all_files_are_found_and_the_model_compiles(tmp_path: Path) -> None:
    write_corner(tmp_path)
    files = collect_files(Boundary(tmp_path), "scene.xml")
    assert sorted(files.contents) == [
        "meshes/wedge.obj",
        "parts/common.xml",
        "parts/robot.xml",
        "parts/things.xml",
        "scene.xml",
    ]
    with load_spec(Boundary(tmp_path), "scene.xml") as spec:
        assert compile_model(spec, "scene.xml").nbody == 10


def test_included_elements_stand_where_mujoco_reads_them(tmp_path: Path) -> None:
    write_corner(tmp_path)
    elements = collect_files(Boundary(tmp_path), "scene.xml").elements
    names = [e.tag.attributes.get("name") for e in elements if e.tag.name == "body"]
    assert names == ["table", "base", "arm", "mug", "box_a", "box_b", "floating", "fine", "wedge_1"]
    mug = next(e for e in elements if e.tag.attributes.get("name") == "mug")
    assert mug.path == "parts/things.xml"
    assert elements[mug.parent].tag.name == "worldbody"


def test_an_include_of_an_include_is_sought_beside_the_main_file(tmp_path: Path) -> None:
    write_model(tmp_path, "", '<include file="parts/first.xml"/>')
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "first.xml").write_text('<mujoco><include file="second.xml"/></mujoco>')
    (tmp_path / "second.xml").write_text('<mujoco><option timestep="0.007"/></mujoco>')
    with load_spec(Boundary(tmp_path), "scene.xml") as spec:
        assert spec.option.timestep == 0.007


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        ('<include file="../secret.xml"/>', "path_outside"),
        ('<include file="/etc/hostname"/>', "path_outside"),
        ('<include file="missing.xml"/>', "include_missing"),
        ('<include file="scene.xml"/>', "cyclic_reference"),
        ('<include file="a.xml"/><include file="a.xml"/>', "cyclic_reference"),
        ('<asset><mesh name="m" file="/etc/hostname"/></asset>', "path_outside"),
        ('<asset><mesh name="m" file="../m.obj"/></asset>', "path_outside"),
        ('<compiler meshdir="/etc"/><asset><mesh name="m" file="hostname"/></asset>', "path_outside"),
        ('<asset><texture type="cube" fileup="../a.png"/></asset>', "path_outside"),
        ('<asset><model name="m" file="../other.xml"/></asset>', "path_outside"),
        ('<asset><mesh name="m" file="http://example.org/m.obj"/></asset>', "path_outside"),
        ('<asset><mesh name="m" file="no.obj"/></asset>', "file_missing"),
    ],
)
def test_files_outside_missing_or_in_circles_are_refused(tmp_path: Path, extra: str, code: str) -> None:
    folder = tmp_path / "inside"
    write_model(folder, "", extra)
    (folder / "a.xml").write_text("<mujoco/>")
    for name in ("secret.xml", "other.xml", "m.obj", "a.png"):
        (tmp_path / name).write_text("<mujoco/>")
    with pytest.raises(MeshError) as caught:
        collect_files(Boundary(folder), "scene.xml")
    assert caught.value.code == code
    assert "scene.xml" in str(caught.value)


def test_hostile_xml_is_refused() -> None:
    with pytest.raises(MeshError, match="declares the entity"):
        start_tags(b'<!DOCTYPE m [<!ENTITY a "aaaa">]><m>&a;</m>', "x.xml")
    with pytest.raises(MeshError, match="elements that nest deeper"):
        start_tags(b"<a>" * 100 + b"</a>" * 100, "x.xml")
    with pytest.raises(MeshError, match="is not XML"):
        start_tags(b"\x00\x01", "x.xml")


def test_bombs_of_copies_are_refused(tmp_path: Path) -> None:
    nested = '<replicate count="1000"><replicate count="1000"><geom size=".1"/></replicate></replicate>'
    write_model(tmp_path, nested)
    with pytest.raises(MeshError, match="makes 1000000 copies"):
        collect_files(Boundary(tmp_path), "scene.xml")


def test_attribute_values_keep_their_offsets() -> None:
    content = "<a><!-- é -->\n<b x='1'/></a>".encode()
    tag = start_tags(content, "x.xml")[1]
    assert content[tag.offset :].startswith(b"<b x=")


GREEDY = {
    "a texture": ('<asset><texture type="2d" builtin="flat" width="60000" height="60000"/></asset>', "3,600,000,000 pixels"),
    "a sky": ('<asset><texture type="skybox" builtin="flat" width="60000"/></asset>', "21,600,000,000 pixels"),
    "a height field": ('<asset><hfield name="h" nrow="46341" ncol="46341" size="1 1 1 1"/></asset>', "faces"),
    "a plate": ('<asset><mesh name="m" builtin="plate" params="20000 20000"/></asset>', "400,000,000 faces"),
    "a cone": ('<asset><mesh name="m" builtin="cone" params="100000000 .5"/></asset>', "faces"),
    "keyframes": ('<size nkey="20000000"/>', "20,000,000 poses"),
    "numbers of the user": ('<size nuser_body="500000000"/>', "refuses the model"),
    "data of the user": ('<size nuserdata="1000000000"/>', "needs more memory"),
    "contacts": ('<size nconmax="1000000000"/>', "needs more memory"),
    "memory": ('<size memory="100G"/>', "needs more memory"),
    "a sensor": ('<sensor><user dim="1000000000"/></sensor>', "needs more memory"),
}


@pytest.mark.parametrize("name", GREEDY)
def test_a_few_words_that_ask_for_very_much_are_refused_at_once(name: str, tmp_path: Path) -> None:
    words, what = GREEDY[name]
    (tmp_path / "a.xml").write_text(f'<mujoco>{words}<worldbody><geom size=".1"/></worldbody></mujoco>')
    with soon(), pytest.raises(MeshError, match=what):
        read_mjcf_scene(Boundary(tmp_path), "a.xml")


def test_a_picture_of_very_many_pixels_is_refused_before_mujoco_reads_it(tmp_path: Path) -> None:
    head = b"\x89PNG\r\n\x1a\n" + bytes([0, 0, 0, 13]) + b"IHDR" + (60_000).to_bytes(4, "big") * 2
    (tmp_path / "a.png").write_bytes(head + bytes(100))
    texture = '<asset><texture name="t" type="2d" file="a.png"/></asset>'
    (tmp_path / "a.xml").write_text(f'<mujoco>{texture}<worldbody><geom size=".1"/></worldbody></mujoco>')
    with pytest.raises(MeshError, match=r"'a.png' has more pixels, expected at most 134,217,728 pixels") as caught:
        read_mjcf_scene(Boundary(tmp_path), "a.xml")
    assert caught.value.code == "file_too_large"
