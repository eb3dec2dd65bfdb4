"""Manifests, presets and plain folders of meshes."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stable_data.errors import ConfigError, Notice
from stable_data.importers.asset_ids import AssetIds
from stable_data.importers.boundary import Boundary
from stable_data.importers.mesh_files import files_beside, joined_triangles
from stable_data.importers.readers import READERS, reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from tests.bounds import limit
from tests.stable_data.geometry.glb_files import document_of, glb_bytes, rebuilt
from tests.stable_data.importers.mesh_texts import CUBE_STL, SQUARE, dae
from tests.stable_data.importers.test_mesh_files import BOX

READER = reader_of("mesh")


def write(root: Path, files: dict[str, str | bytes]) -> Path:
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return root


def found(root: Path, **options: Any) -> list[SourceRef | Notice]:
    return list(READER.find(Boundary(root), ReaderOptions(**options)))


def assets(root: Path, **options: Any) -> dict[str, SourceAsset]:
    refs = [ref for ref in found(root, **options) if isinstance(ref, SourceRef)]
    json.dumps([ref.entry for ref in refs])
    read = {}
    for ref in refs:
        boundary = Boundary(root)
        read[ref.asset_id] = READER.read(boundary, ref, ReaderOptions(**options))
        assert boundary.opened <= set(ref.files)
    return read


def size_of(asset: SourceAsset) -> list[float]:
    return [round(side, 9) for side in np.ptp(joined_triangles(asset.surfaces).reshape(-1, 3), axis=0).tolist()]


# Every mesh file


def test_of_several_formats_of_one_name_the_best_is_taken(tmp_path: Path) -> None:
    obj = SQUARE + "f 1 2 3\n"
    files: dict[str, str | bytes] = {
        "pan.obj": obj,
        "pan.mtl": "",
        "pan.stl": CUBE_STL,
        "PAN.glb": glb_bytes(BOX),
        "cup.stl": CUBE_STL,
        "cup.ply": "ply",
        "texture.png": b"",
        "other/pan.obj": obj,
        "sofa/scene.gltf": "{}",
        "box/meshes/textured.obj": obj,
        "box/meshes/nontextured.stl": CUBE_STL,
    }
    refs = found(write(tmp_path, files))
    assert [(ref.asset_id, ref.path) for ref in refs if isinstance(ref, SourceRef)] == [
        ("PAN", "PAN.glb"),
        ("cup", "cup.ply"),
        ("box", "box/meshes/nontextured.stl"),
        ("box_textured", "box/meshes/textured.obj"),
        ("other_pan", "other/pan.obj"),
        ("sofa", "sofa/scene.gltf"),
    ]


def test_axes_and_units_are_those_that_something_states(tmp_path: Path) -> None:
    root = write(
        tmp_path,
        {
            "a.glb": glb_bytes(BOX),
            "b.obj": SQUARE + "f 1 2 3\n",
            "c.stl": CUBE_STL.replace("vertex 1 ", "vertex 2 "),
            "d.dae": dae(asset='<unit meter="0.01"/><up_axis>Y_UP</up_axis>'),
            "e.dae": dae(asset="<up_axis>Z_UP</up_axis>"),
            "f.dae": dae(),
        },
    )
    plain = assets(root)
    assert {name: (size_of(a), a.unit_m, a.is_upright) for name, a in plain.items()} == {
        "a": ([2, 1, 3], None, True),
        "b": ([2, 0, 1], None, False),
        "c": ([2, 1, 1], None, False),
        "d": ([2, 0, 1], 0.01, True),
        "e": ([2, 1, 0], None, True),
        "f": ([2, 0, 1], None, False),
    }
    told = assets(root, up="x", front="-y", unit_m=0.5)
    assert {name: (size_of(a), a.unit_m, a.is_upright) for name, a in told.items()}["c"] == ([1, 1, 2], 0.5, True)
    assert size_of(told["a"]) == [3, 1, 2]  # y up in its format, x up as the user says
    assert told["c"].front == (1.0, 0.0, 0.0)
    assert all(asset.front is None for asset in plain.values())
    with pytest.raises(ConfigError, match="one axis"):
        found(root, up="x", front="-x")


def test_licences_come_from_the_file_and_from_the_nearest_folder(tmp_path: Path) -> None:
    document, binary = document_of(glb_bytes(BOX))
    document["asset"]["extras"] = {"license": "CC-BY-4.0 (http://creativecommons.org/licenses/by/4.0/)", "author": "Ann"}
    stated = rebuilt(document, binary)
    document["asset"] = {"version": "2.0", "copyright": "2019 (c) Company"}
    root = write(
        tmp_path,
        {
            "kit/gltf/a.glb": stated,
            "kit/gltf/b.glb": rebuilt(document, binary),
            "kit/LICENSE.txt": "A kit\n\nLicense: (Creative Commons Zero, CC0)\n",
            "LICENSE": "MIT License",
            "c.glb": glb_bytes(BOX),
        },
    )
    found_ones = assets(root)
    assert [licence.where for licence in found_ones["a"].licences] == ["a.glb", "kit/LICENSE.txt"]
    assert [licence.text for licence in found_ones["b"].licences] == ["License: (Creative Commons Zero, CC0)"]
    assert [licence.text for licence in found_ones["c"].licences] == ["MIT License"]
    assert [found_ones[name].author for name in "abc"] == ["Ann", "Company", ""]


def test_a_licence_in_the_line_of_copyright_counts_beside_others(tmp_path: Path) -> None:
    document, binary = document_of(glb_bytes(BOX))
    document["asset"] |= {"copyright": "(c) 2019 Ann, CC BY-NC 4.0", "extras": {"license": "CC0"}}
    (asset,) = assets(write(tmp_path, {"a.glb": rebuilt(document, binary)})).values()
    assert [(licence.text, licence.where) for licence in asset.licences] == [
        ("CC0", "a.glb"),
        ("(c) 2019 Ann, CC BY-NC 4.0", "a.glb"),
    ]
    assert asset.author == "Ann"


def test_names_of_any_alphabet_have_identifiers(tmp_path: Path) -> None:
    for name in ("чашка.stl", "kávé csésze.stl", "a:b?.stl"):
        (tmp_path / name).write_text(CUBE_STL)
    read = assets(tmp_path)
    assert sorted(read) == ["a_b", "asset", "kave_csesze"]
    assert all([n.code for n in a.notices] == ["name_changed"] for a in read.values())
    assert read["asset"].name == "чашка"


def test_a_name_that_is_no_text_is_said(tmp_path: Path) -> None:
    try:
        (tmp_path / b"caf\xe9.stl".decode("utf-8", "surrogateescape")).write_text(CUBE_STL)
    except OSError:
        pytest.skip("the file system takes UTF-8 names only")
    (notice,) = found(tmp_path)
    assert isinstance(notice, Notice)
    assert notice.code == "name_not_unicode"
    notice.message.encode()


# Manifests


def test_a_csv_says_all_about_an_asset(tmp_path: Path) -> None:
    root = write(
        tmp_path,
        {
            "data/cup.stl": CUBE_STL,
            "data/list.csv": "\ufefffile,id,name,category,description,tags,license,author,url,scale,size_cm,mass,up,front,colour\n"
            '"cup.stl",cup-1,Cup No 1,cup,"A cup, with a handle.",red; tall,CC BY 4.0,Ann,https://a.org,0.1,10 x 12.5 8,0.25,y,-z,red\n',
        },
    )
    (cup,) = assets(root, manifest="data/list.csv").values()
    assert (cup.asset_id, cup.name, cup.category, cup.description) == ("cup-1", "Cup No 1", "cup", "A cup, with a handle.")
    assert (cup.tags, cup.author, cup.url, cup.unit_m, cup.size_m) == (
        ("red", "tall"),
        "Ann",
        "https://a.org",
        0.1,
        (0.1, 0.125, 0.08),
    )
    assert [(licence.text, licence.where) for licence in cup.licences] == [("CC BY 4.0", "list.csv")]
    assert cup.inertial is not None
    assert (cup.inertial.mass, cup.inertial.center_of_mass) == (0.25, None)
    assert (cup.is_upright, cup.front) == (True, (0.0, 1.0, 0.0))
    assert [n.code for n in cup.notices] == ["columns_ignored"]
    assert "colour" in cup.notices[0].message


def test_a_jsonl_says_the_same(tmp_path: Path) -> None:
    rows = [
        {"path": "a.stl", "unit_m": 0.5, "size_m": [1, 2, 3], "tags": ["x", "y"], "mass_kg": None},
        {"file": "b.stl", "category": ""},
    ]
    root = write(tmp_path, {"a.stl": CUBE_STL, "b.stl": CUBE_STL, "m.jsonl": "\n".join(map(json.dumps, rows)) + "\n\n"})
    a, b = assets(root, manifest="m.jsonl").values()
    assert (a.unit_m, a.size_m, a.tags, a.inertial, a.notices) == (0.5, (1.0, 2.0, 3.0), ("x", "y"), None, ())
    assert (b.asset_id, b.category, b.is_upright) == ("b", "", False)


def test_a_manifest_comes_before_the_options_and_these_before_a_preset(tmp_path: Path) -> None:
    root = write(tmp_path, {"gltf/a.glb": glb_bytes(BOX), "m.csv": "file,up,scale\ngltf/a.glb,z,2\n"})
    assert size_of(assets(root, manifest="m.csv", up="x", unit_m=3.0)["a"]) == [2, 3, 1]
    assert assets(root, manifest="m.csv", up="x", unit_m=3.0)["a"].unit_m == 2
    assert size_of(assets(root, preset="kaykit")["a"]) == [2, 1, 3]
    assert size_of(assets(root, preset="kaykit", up="z")["a"]) == [2, 3, 1]


@pytest.mark.parametrize(
    "row",
    [
        {},
        {"file": "none.stl"},
        {"file": "../secret.stl"},
        {"file": "/etc/passwd"},
        {"file": "a.blend"},
        {"file": "a.stl", "scale": -1},
        {"file": "a.stl", "scale": "many"},
        {"file": "a.stl", "scale": 1e999},
        {"file": "a.stl", "scale": True},
        {"file": "a.stl", "mass": 0},
        {"file": "a.stl", "size_m": "1 2"},
        {"file": "a.stl", "size_cm": [1, 2, "x"]},
        {"file": "a.stl", "size_cm": [1, 2, -3]},
        {"file": "a.stl", "up": "w"},
        {"file": "a.stl", "up": "y", "front": "-y"},
        {"file": 3},
        [1],
    ],
)
def test_a_bad_row_is_one_notice(tmp_path: Path, row: Any) -> None:
    good = {"file": "a.stl"}
    text = json.dumps(row).replace("Infinity", "1e999") + "\n" + json.dumps(good) + "\n"
    root = write(tmp_path / "in", {"a.stl": CUBE_STL, "a.blend": "", "m.jsonl": text})
    (tmp_path / "secret.stl").write_text(CUBE_STL)
    notice, ref = found(root, manifest="m.jsonl")
    assert isinstance(notice, Notice)
    assert isinstance(ref, SourceRef)
    assert notice.code == "manifest_row_invalid"
    assert notice.message.startswith("m.jsonl line 1: ")
    assert "\n" not in notice.message


def test_rows_that_are_no_rows_are_notices(tmp_path: Path) -> None:
    root = write(tmp_path, {"a.stl": CUBE_STL, "m.jsonl": '{"file": "a.stl"\nnot json\n{"file": "a.stl"}\n'})
    assert [n.code if isinstance(n, Notice) else n.asset_id for n in found(root, manifest="m.jsonl")] == [
        "manifest_row_invalid",
        "manifest_row_invalid",
        "a",
    ]
    write(root, {"m.csv": "file,name\na.stl,x,y,z\n\na.stl,x\n" + "a.stl," + "y" * 200_000 + "\n"})
    codes = [n.code if isinstance(n, Notice) else n.asset_id for n in found(root, manifest="m.csv")]
    assert codes[:2] == ["manifest_row_invalid", "x"]


def test_two_assets_of_one_identifier_are_said(tmp_path: Path) -> None:
    root = write(tmp_path, {"a.stl": CUBE_STL, "b.stl": CUBE_STL, "m.csv": "file,id\na.stl,x\nb.stl,X\n"})
    ref, notice = found(root, manifest="m.csv")
    assert isinstance(ref, SourceRef)
    assert isinstance(notice, Notice)
    assert (notice.item_id, notice.code) == ("X", "asset_duplicate")


def test_a_mesh_of_very_many_rows_is_looked_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each row once scanned the mesh again, and sought an identifier from the first number."""
    scans, claims = list[str](), list[str]()
    claim = AssetIds.claim

    def scanned(root: Boundary, path: str) -> tuple[str, ...]:
        scans.append(path)
        return files_beside(root, path)

    def claimed(self: AssetIds, asset_id: str) -> bool:
        claims.append(asset_id)
        return claim(self, asset_id)

    monkeypatch.setattr("stable_data.importers.mesh_reader.files_beside", scanned)
    monkeypatch.setattr(AssetIds, "claim", claimed)
    rows = "".join(f"a.obj,{'aA'[k % 2]}\n" for k in range(400))
    write(tmp_path, {"a.obj": f"mtllib a.mtl\n{SQUARE}f 1 2 3\n", "a.mtl": "", "LICENSE": "CC0", "m.csv": f"file,name\n{rows}"})
    refs = [ref for ref in found(tmp_path, manifest="m.csv") if isinstance(ref, SourceRef)]
    assert [ref.asset_id for ref in refs[:2]] == ["a", "A_a"]
    assert len({ref.asset_id.casefold() for ref in refs}) == 400
    assert {ref.files for ref in refs} == {("a.obj", "a.mtl", "LICENSE")}
    assert all(ref.entry["licence_file"] == "LICENSE" for ref in refs)
    assert scans == ["a.obj"]
    assert len(claims) <= 2_000
    assert len({id(ref.files) for ref in refs}) == 1


@pytest.mark.parametrize("content", [None, b"\xff\xfe", b"name,id\n1,2\n", b""])
def test_a_manifest_that_cannot_be_read_ends_the_run(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "m.csv").write_bytes(content)
    with pytest.raises(ConfigError, match=r"m\.csv") as caught:
        found(tmp_path, manifest="m.csv")
    assert caught.value.code == "manifest_unreadable"
    with pytest.raises(ConfigError):
        found(tmp_path, manifest="../m.csv")


# Presets


def test_objaverse_has_its_annotations(tmp_path: Path) -> None:
    record = {
        "name": "A Mug",
        "license": "by-nc",
        "tags": [{"name": "mug"}, {"name": "red"}],
        "categories": [{"name": "Food & Drink"}],
        "user": {"displayName": "Ann", "username": "ann"},
        "viewerUrl": "https://sketchfab.com/3d-models/u1",
        "description": "A\nmug.",
    }
    root = write(
        tmp_path,
        {
            "glbs/000-000/u1.glb": glb_bytes(BOX),
            "glbs/000-001/u2.glb": glb_bytes(BOX),
            "metadata/000-000.json.gz": gzip.compress(json.dumps({"u1": record}).encode()),
            "lvis-annotations.json": json.dumps({"coffee_mug": ["u1"]}),
        },
    )
    one, two = assets(root, preset="objaverse").values()
    assert (one.asset_id, one.name, one.category, one.tags) == ("u1", "A Mug", "coffee mug", ("mug", "red", "Food & Drink"))
    assert (one.author, one.url, one.description, one.source_set) == ("Ann", record["viewerUrl"], "A mug.", "Objaverse")
    assert [licence.text for licence in one.licences] == ["by-nc"]
    assert (one.unit_m, one.is_upright) == (None, True)
    assert (two.name, two.category, two.licences) == ("u2", "", ())
    (tmp_path / "metadata" / "000-000.json.gz").write_bytes(gzip.compress(b"{")[:-4])
    with pytest.raises(ConfigError, match="annotations"):
        found(root, preset="objaverse")


def test_annotations_that_unpack_to_too_much_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "file", max_metadata_bytes=1000)
    root = write(tmp_path, {"glbs/0/u.glb": b"", "metadata/0.json.gz": gzip.compress(b'{"u": "' + b"x" * 10**6 + b'"}')})
    with pytest.raises(ConfigError, match="at most 1,000 bytes"):
        found(root, preset="objaverse")


def test_graspnet_infinite_has_metric_scale(tmp_path: Path) -> None:
    record = {"uid": "u1", "lvis_category": "water_bottle", "license": "CC BY 4.0", "author": "Ann", "scale_to_meters": 0.05}
    root = write(
        tmp_path, {"bottle/u1.glb": glb_bytes(BOX), "bottle/u1.json": json.dumps(record), "cup/u2.glb": glb_bytes(BOX)}
    )
    one, two = assets(root, preset="graspnet_infinite").values()
    assert (one.category, one.unit_m, one.author, one.licences[0].text) == ("water bottle", 0.05, "Ann", "CC BY 4.0")
    assert (two.category, two.unit_m, two.licences) == ("cup", None, ())


def test_ycb_takes_the_best_scan(tmp_path: Path) -> None:
    obj = SQUARE + "f 1 2 3\n"
    files: dict[str, str | bytes] = {
        "002_master_chef_can/google_16k/textured.obj": obj,
        "002_master_chef_can/google_16k/textured.dae": dae(),
        "002_master_chef_can/google_16k/nontextured.stl": CUBE_STL,
        "002_master_chef_can/tsdf/textured.obj": obj,
        "073-a_lego_duplo/tsdf/textured.obj": obj,
        "073-a_lego_duplo/poisson/textured.obj": obj,
        "notes/other.obj": obj,
    }
    refs = [ref for ref in found(write(tmp_path, files), preset="ycb") if isinstance(ref, SourceRef)]
    assert [(ref.asset_id, ref.path) for ref in refs] == [
        ("002_master_chef_can", "002_master_chef_can/google_16k/textured.obj"),
        ("073-a_lego_duplo", "073-a_lego_duplo/tsdf/textured.obj"),
    ]
    can = assets(tmp_path, preset="ycb")["002_master_chef_can"]
    assert (can.category, can.unit_m, can.is_upright, can.source_set) == ("master chef can", 1.0, True, "YCB")


def test_graspnet_is_metric(tmp_path: Path) -> None:
    root = write(tmp_path, {"models/007/textured.obj": SQUARE + "f 1 2 3\n", "models/007/nontextured.ply": "", "x.obj": ""})
    (asset,) = assets(root, preset="graspnet").values()
    assert (asset.asset_id, asset.unit_m, asset.is_upright) == ("007", 1.0, True)


def test_sweet_home_states_sizes(tmp_path: Path) -> None:
    catalogue = (
        "# comment\nname=Set\nid#1=Set#cup\nname#1=Tasse \\u00e9\ncategory#1=Kitchen\ntags#1=Set, Cup\nmodel#1=/set/cup/cup.obj\n"
        "width#1=8\ndepth#1=9.5\nheight#1=10\ncreator#1=Ann\n"
        "id#2=Set#door\nname#2=Door\nmodel#2=/set/cup/cup.obj\ndoorOrWindow#2=true\n"
        "id#3=Set#out\nmodel#3=/../../secret.obj\nid#4=Set#turned\nname#4=Turned\nmodel#4=/set/b.obj\nmodelRotation#4=1 0 0\nwidth#4=1\n"
    )
    obj = SQUARE + "f 1 2 3\n"
    files: dict[str, str | bytes] = {
        "in/x/PluginFurnitureCatalog.properties": catalogue,
        "in/x/PluginFurnitureCatalog_fr.properties": catalogue,
        "in/x/set/cup/cup.obj": obj,
        "in/x/set/b.obj": obj,
        "in/x/LICENSE.TXT": "This file is under the Creative Commons Attribution 3.0 license",
        "secret.obj": obj,
    }
    read = assets(write(tmp_path, files) / "in", preset="sweethome3d")
    assert sorted(read) == ["Set_cup", "Set_turned"]
    cup = read["Set_cup"]
    assert (cup.name, cup.tags, cup.author, cup.source_set) == ("Tasse é", ("Kitchen", "Set", "Cup"), "Ann", "Set")
    assert cup.size_m == pytest.approx((0.08, 0.095, 0.1))
    assert [licence.where for licence in cup.licences] == ["x/LICENSE.TXT"]
    assert (read["Set_turned"].size_m, read["Set_turned"].is_upright) == (None, False)


def test_presets_that_do_not_fit_are_said(tmp_path: Path) -> None:
    for preset in ("none", "ycb", "objaverse", "kaykit"):
        with pytest.raises(ConfigError, match=preset):
            found(tmp_path, preset=preset)
    with pytest.raises(ConfigError, match="one of them"):
        found(tmp_path, preset="ycb", manifest="m.csv")


def test_kinds_have_readers() -> None:
    assert set(READERS) == {"mesh", "mjcf", "sdformat", "urdf", "usd"}
    for kind in ("mesh", "sdformat", "urdf"):
        assert hasattr(reader_of(kind), "find")
        assert hasattr(reader_of(kind), "read")
    with pytest.raises(ConfigError, match="expected one of mesh"):
        reader_of("fbx")


def test_finding_streams(tmp_path: Path) -> None:
    write(tmp_path, {f"{k:03}/a.stl": CUBE_STL for k in range(3)})
    items = READER.find(Boundary(tmp_path), ReaderOptions())
    first = next(items)
    (tmp_path / "002" / "b.stl").write_text(CUBE_STL)  # a folder that was not listed yet
    rest = list(items)
    assert isinstance(first, SourceRef)
    assert [ref.path for ref in rest if isinstance(ref, SourceRef)] == ["001/a.stl", "002/a.stl", "002/b.stl"]
