"""Layers of USD assets: no layer outside of the folder is composed, and what is hostile is refused."""

import io
import math
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
from pxr import Sdf, UsdGeom, UsdUtils

from stable_data.errors import MeshError, Notice
from stable_data.importers.boundary import Boundary
from stable_data.importers.source import SourceRef
from stable_data.importers.usd.scan import LayerScanner
from stable_data.limits import SETTING
from tests.bounds import limit
from tests.stable_data.importers.usd.stages import add_box, add_material, bind, found, read, read_all, refusal, save, stage_at


def test_layers_in_other_folders_with_their_textures(tmp_path: Path) -> None:
    (tmp_path / "parts" / "maps").mkdir(parents=True)
    (tmp_path / "parts" / "maps" / "t.png").write_bytes(b"image")
    stage = stage_at(tmp_path / "parts" / "look.usdc")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0, 0)] * 8)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/m", "maps/t.png"))
    save(stage)
    stage = stage_at(tmp_path / "thing.usda")
    stage.GetDefaultPrim().GetPayloads().AddPayload("./parts/look.usdc")
    save(stage)
    (ref,) = found(tmp_path)
    assert isinstance(ref, SourceRef)
    assert ref.files == ("thing.usda", "parts/look.usdc", "parts/maps/t.png")
    (asset,) = read_all(tmp_path).values()
    assert asset.surfaces[0].image == b"image"


def test_packages(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "maps").mkdir(parents=True)
    (source / "maps" / "t.png").write_bytes(b"image")
    stage = stage_at(source / "look.usda")
    mesh = add_box(stage, "/Thing/box")
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0, 0)] * 8)
    bind(mesh.GetPrim(), add_material(stage, "/Thing/m", "maps/t.png"))
    save(stage)
    folder = tmp_path / "folder"
    folder.mkdir()
    assert UsdUtils.CreateNewUsdzPackage(str(source / "look.usda"), str(folder / "mug.usdz"))
    assert read(folder, "mug.usdz").surfaces[0].image == b"image"
    stage = stage_at(folder / "with.usda")
    stage.OverridePrim("/Thing/part").GetReferences().AddReference("mug.usdz")
    save(stage)
    assets = read_all(folder)
    assert list(assets) == ["with"]
    assert assets["with"].surfaces[0].image == b"image"


def archive(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (archive({"a.usda": b"#usda 1.0\n" + b" " * 2**20}, zipfile.ZIP_DEFLATED), "archive_bomb"),
        (archive({}), "model_unreadable"),
        (archive({"a.txt": b"x"}), "model_unreadable"),
        (archive({f"{k}.usda": b"" for k in range(2001)}), "model_unreadable"),
        (b"PK but no archive", "model_unreadable"),
    ],
)
def test_packages_that_are_none(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "thing.usdz").write_bytes(content)
    assert refusal(tmp_path, "thing.usdz").code == code
    assert [notice.code for notice in found(tmp_path) if isinstance(notice, Notice)] == [code]


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """The source folder; beside it is a layer that must not be read."""
    folder = tmp_path / "inside"
    folder.mkdir()
    stage = stage_at(tmp_path / "secret.usda")
    add_box(stage, "/Thing/secret")
    save(stage)
    (folder / "link.usda").symlink_to(tmp_path / "secret.usda")
    return folder


@pytest.mark.parametrize(
    "name", ["../secret.usda", "{parent}/secret.usda", "https://example.org/a.usda", "link.usda", "file:{parent}/secret.usda"]
)
@pytest.mark.parametrize("arc", ["references", "payload", "subLayers"])
def test_no_layer_outside_of_the_folder_is_composed(outside: Path, name: str, arc: str) -> None:
    name = name.format(parent=outside.parent)
    layers = f"subLayers = [@{name}@]" if arc == "subLayers" else ""
    arcs = "" if layers else f"(prepend {arc} = @{name}@)"
    text = f'#usda 1.0\n(defaultPrim = "T"\n{layers})\ndef Xform "T" {arcs}\n{{\ndef Cube "c" {{}}\n}}\n'
    (outside / "thing.usda").write_text(text)
    assert refusal(outside).code == "path_outside"
    if arc == "payload":
        (ref,) = found(outside)
        assert isinstance(ref, SourceRef)
        assert ref.files == ("thing.usda",)


def test_a_package_does_not_lead_outside(outside: Path) -> None:
    layer = b'#usda 1.0\n(defaultPrim = "T")\ndef "T" (references = @%s@) {\ndef Cube "c" {}\n}\n'
    for name in (b"../secret.usda", b"../../secret.usda", str(outside.parent / "secret.usda").encode()):
        (outside / "thing.usdz").write_bytes(archive({"a.usda": layer % name}))
        assert refusal(outside, "thing.usdz").code == "path_outside"


def test_clips_and_computed_names_are_not_followed(outside: Path) -> None:
    secret = outside.parent / "secret.usda"
    clips = f'clips = {{ dictionary default = {{ string templateAssetPath = "{secret}.###.usd"\nasset[] assetPaths = [@{secret}@] }} }}'
    (outside / "thing.usda").write_text(f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" ({clips}) {{\ndef Cube "c" {{}}\n}}\n')
    assert len(read(outside).surfaces) == 1
    computed = '#usda 1.0\n(defaultPrim = "T"\nexpressionVariables = { string A = "../secret" })\n'
    (outside / "thing.usda").write_text(computed + 'def "T" (references = @`"${A}.usda"`@) {\ndef Cube "c" {}\n}\n')
    assert refusal(outside).code == "path_outside"
    (outside / "thing.usda").write_text((outside / "thing.usda").read_text().replace("../secret", "./part"))
    stage = stage_at(outside / "part.usda")
    add_box(stage, "/Thing/box")
    save(stage)
    assert len(read(outside).surfaces) == 2, "the layer's own variables count"


@pytest.mark.parametrize(
    "files",
    [
        {"thing.usda": "thing.usda"},
        {"thing.usda": "b.usda", "b.usda": "thing.usda"},
        {"a.usda": "b.usda", "b.usda": "a.usda", "thing.usda": "a.usda"},
    ],
)
def test_layers_that_are_part_of_themselves(tmp_path: Path, files: dict[str, str]) -> None:
    for name, part in files.items():
        text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" (references = @{part}@</T>) {{\ndef Cube "c" {{}}\n}}\n'
        (tmp_path / name).write_text(text)
    assert refusal(tmp_path).code == "cyclic_reference"
    assert len(found(tmp_path)) == 1, "one failure for all of them"


@pytest.mark.parametrize(("target", "code"), [("/T", "cyclic_reference"), ("/None", "composition_incomplete")])
def test_references_within_a_layer_that_lead_nowhere(tmp_path: Path, target: str, code: str) -> None:
    text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T"\n{{\ndef Cube "c" (references = <{target}>) {{}}\n}}\n'
    (tmp_path / "thing.usda").write_text(text)
    if code == "cyclic_reference":
        assert refusal(tmp_path).code == code
    else:
        assert [notice.code for notice in read(tmp_path).notices] == [code]


def test_what_a_point_instancer_copies_is_left_out(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box")
    UsdGeom.PointInstancer.Define(stage, "/Thing/many")
    add_box(stage, "/Thing/many/proto").AddTranslateOp().Set((9, 9, 9))
    save(stage)
    asset = read(tmp_path)
    assert len(asset.surfaces) == 1
    assert [notice.code for notice in asset.notices] == ["prim_left_out"]


def test_few_words_that_ask_for_many_prims(tmp_path: Path) -> None:
    levels = "".join(
        f'class "L{k}" {{ ' + "".join(f'def "c{i}" (references = </L{k + 1}>) {{}}\n' for i in range(10)) + "}\n"
        for k in range(12)
    )
    text = f'#usda 1.0\n(defaultPrim = "T")\ndef Xform "T" (references = </L0>) {{}}\n{levels}class "L12" {{}}\n'
    (tmp_path / "thing.usda").write_text(text)
    assert refusal(tmp_path).code == "mesh_too_large"
    hidden = text.replace("references = </L1>", "references = </Wrap/part>") + 'class "Wrap" (references = </Deep>) {}\n'
    (tmp_path / "thing.usda").write_text(hidden + 'class "Deep" {\ndef "part" (references = </L1>) {}\n}\n')
    assert refusal(tmp_path).code == "mesh_too_large"


def test_sublayers_that_multiply(tmp_path: Path) -> None:
    for k in range(12):
        names = ", ".join(f"@l{k + 1}{side}.usda@" for side in "ab")
        for side in "ab":
            (tmp_path / f"l{k}{side}.usda").write_text(f"#usda 1.0\n(subLayers = [{names}])\n" if k < 11 else "#usda 1.0\n")
    (tmp_path / "thing.usda").write_text(
        '#usda 1.0\n(defaultPrim = "T"\nsubLayers = [@l0a.usda@, @l0b.usda@])\ndef Cube "T" {}\n'
    )
    assert refusal(tmp_path).code == "mesh_too_large"


def test_meshes_with_too_many_triangles_are_refused(tmp_path: Path) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box")
    save(stage)
    assert refusal(tmp_path, max_faces=11).code == "mesh_too_large"
    assert len(read(tmp_path, max_faces=12).surfaces) == 1
    empty = UsdGeom.Mesh.Define(stage, "/Thing/empty")
    empty.CreateFaceVertexCountsAttr([0] * 100)
    empty.CreateFaceVertexIndicesAttr([])
    save(stage)
    assert refusal(tmp_path, max_faces=11).code == "mesh_too_large"  # faces without corners do not make up for others


@pytest.mark.parametrize(
    ("attribute", "value", "code"),
    [
        ("faceVertexCounts", [4] * 7, "model_unreadable"),
        ("faceVertexCounts", [4] * 5 + [-4], "model_unreadable"),
        ("faceVertexIndices", [99] * 24, "model_unreadable"),
        ("faceVertexIndices", [-1] * 24, "model_unreadable"),
        ("points", [(math.nan, 0, 0)] * 8, "mesh_not_finite"),
        ("points", [], "model_unreadable"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path: Path, attribute: str, value: Any, code: str) -> None:
    stage = stage_at(tmp_path / "thing.usda")
    add_box(stage, "/Thing/box").GetPrim().GetAttribute(attribute).Set(value)
    save(stage)
    assert refusal(tmp_path).code == code


def test_layers_without_an_asset(tmp_path: Path) -> None:
    (tmp_path / "thing.usda").write_text('#usda 1.0\ndef Cube "a" {}\ndef Cube "b" {}\n')
    (tmp_path / "broken.usda").write_text("#usda 1.0\ndef Cube {")
    (tmp_path / "overs.usda").write_text('#usda 1.0\nover "a" {}\n')
    (tmp_path / "single.usda").write_text('#usda 1.0\ndef Cube "a" {}\n')
    (tmp_path / "empty.usda").write_text('#usda 1.0\n(defaultPrim = "a")\ndef "a" {}\n')
    codes = {ref.item_id: ref.code for ref in found(tmp_path) if isinstance(ref, Notice)}
    assert codes == {"thing": "default_prim_missing", "broken": "model_unreadable"}
    assert [ref.asset_id for ref in found(tmp_path) if isinstance(ref, SourceRef)] == ["empty", "single"]
    assert refusal(tmp_path, "empty.usda").code == "mesh_empty"
    assert len(read(tmp_path, "single.usda").surfaces) == 1


def test_modules_in_the_current_folder_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(stage_at(tmp_path / "thing.usda"))
    for name in ("json.py", "stable_data.py", "pxr.py"):
        (tmp_path / name).write_text(f"open({str(tmp_path / 'run')!r}, 'w')\nraise SystemExit\n")
    monkeypatch.chdir(tmp_path)
    with LayerScanner(Boundary(tmp_path)) as scan:
        assert scan("thing.usda").has_default
    assert not (tmp_path / "run").exists()


def test_a_layer_that_ends_the_parser_costs_that_layer_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "good.usda").write_text('#usda 1.0\n(defaultPrim = "a")\ndef Cube "a" {}\n')
    with LayerScanner(Boundary(tmp_path)) as scan:
        assert scan("good.usda").has_default
        process = scan._process
        assert process is not None
        process.kill()
        process.wait()
        with pytest.raises(MeshError, match="ends the process"):
            scan("good.usda")
        assert scan("good.usda").has_default, "the next one is read by a new process"
    for num_bytes in (2**23, 2**26):  # with so little USD ends the process, with a little more it raises an error
        with monkeypatch.context() as patch, LayerScanner(Boundary(tmp_path)) as scan:
            patch.setenv(SETTING, f"item.max_memory_bytes={num_bytes}")
            limit(patch, "item", max_memory_bytes=num_bytes)
            with pytest.raises(MeshError, match=r"more memory.*item\.max_memory_bytes in STABLE_DATA_LIMITS"):
                scan("good.usda")
    limit(monkeypatch, "item", max_scan_seconds=0)
    with LayerScanner(Boundary(tmp_path)) as scan, pytest.raises(MeshError, match="was not read"):
        scan("good.usda")


def test_a_small_layer_that_states_many_sections_takes_little_memory(tmp_path: Path) -> None:
    """USD makes room for all sections, and fills it, before it looks whether the file has them: here 3.7 GB for 116,983,803."""
    path = tmp_path / "thing.usdc"
    save(stage_at(path))
    content = bytearray(path.read_bytes())
    (contents,) = struct.unpack_from("<Q", content, 16)
    struct.pack_into("<Q", content, contents, 116_983_803)
    path.write_bytes(content)
    with (
        LayerScanner(Boundary(tmp_path)) as scan,
        pytest.raises(MeshError, match=r"more memory.*item\.max_scan_memory_bytes in STABLE_DATA_LIMITS\) and 64") as error,
    ):
        scan("thing.usdc")
    assert error.value.code == "file_too_large"
