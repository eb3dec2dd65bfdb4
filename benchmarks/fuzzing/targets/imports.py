"""Targets: source folders of assets in every format that is imported, and what an imported asset becomes."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.mutation.glb_edits import joined_glb
from benchmarks.fuzzing.targets import source_files as files
from benchmarks.fuzzing.targets.meshes import picture
from benchmarks.fuzzing.targets.results import check_finite, check_notices, check_surfaces
from stable_data.errors import MeshError, Notice
from stable_data.importers.boundary import Boundary
from stable_data.importers.conversion import ConversionContext, ConversionSettings, convert
from stable_data.importers.readers import reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.storage.table_rows import arrow_table

_SCAN = ("from stable_data.importers.usd.scan import answer_paths",)
_PICTURE = picture("PNG")


def _check_asset(asset: SourceAsset) -> None:
    check_notices(asset.notices)
    check_surfaces(asset.surfaces)
    check_finite("asset", asset.unit_m, asset.size_m, asset.front, *(part.vertices for part in asset.colliders))


def _reading(kind: str, of_base: Callable[[str], ReaderOptions] = lambda _: ReaderOptions()) -> Callable[[Path, str], bool]:
    """Finds the assets of a folder and reads them; a refusal of all of them is the last one's."""

    def read(folder: Path, base: str) -> bool:
        reader, options, refusal = reader_of(kind), of_base(base), None
        found = 0
        for item in reader.find(Boundary(folder), options):
            if isinstance(item, Notice):
                check_notices([item])
                continue
            try:
                _check_asset(reader.read(Boundary(folder), item, options))
                found += 1
            except MeshError as error:
                refusal = error
        if not found and refusal is not None:
            raise refusal
        return bool(found)

    return read


def _base(name: str, contents: Mapping[str, bytes], **weights: float) -> Base:
    """A base of whose files those with a suffix among the weights are changed, as often as these say."""
    changed = {path: weights.get(path.rpartition(".")[2], 0.0) for path in contents}
    return Base(name, contents, {path: weight for path, weight in changed.items() if weight})


def _meshes() -> list[Base]:
    document, buffer = files.gltf()
    embedded, _ = files.gltf(is_embedded=True)
    joined = json.loads(json.dumps(document))
    joined["buffers"][0].pop("uri")
    return [
        _base(
            "obj",
            {"box.obj": files.OBJ, "box.mtl": files.MTL, "picture.png": _PICTURE, "LICENSE.txt": files.LICENCE},
            obj=5,
            mtl=3,
            png=1,
            txt=0.3,
        ),
        _base("stl", {"box.stl": files.stl_ascii()}, stl=2),
        _base("stl_binary", {"box.stl": files.stl_binary()}, stl=2),
        _base("ply", {"box.ply": files.ply(is_binary=False), "picture.png": _PICTURE}, ply=3),
        _base("ply_binary", {"box.ply": files.ply(is_binary=True), "picture.png": _PICTURE}, ply=3),
        _base(
            "gltf", {"thing.gltf": files.dumped(document), "thing.bin": buffer, "picture.png": _PICTURE}, gltf=5, bin=2, png=1
        ),
        _base("gltf_embedded", {"thing.gltf": files.dumped(embedded)}, gltf=3),
        _base("glb", {"thing.glb": joined_glb(json.dumps(joined).encode(), buffer), "picture.png": _PICTURE}, glb=4),
    ]


def _collada() -> list[Base]:
    return [_base("dae", {"box.dae": files.DAE, "picture.png": _PICTURE}, dae=1)]


_ROWS = (
    {
        "file": "box.obj",
        "id": "a",
        "name": "Mug",
        "category": "mug",
        "tags": ["red"],
        "licence": "CC0-1.0",
        "unit_m": 1,
        "mass": 0.3,
        "up": "z",
        "front": "-y",
    },
    {"path": "box.stl", "id": "b", "size_cm": [10, 10, 10], "author": "A", "url": "https://a.b", "description": "A box."},
)
_CSV = b"""file,id,name,category,licence,size_cm,mass_kg,up,front,tags
box.obj,a,Mug,mug,CC0-1.0,"10 10 10",0.2,z,-y,"a;b"
box.stl,b,Box,box,CC-BY-4.0,,,,,
"""


def _manifests() -> list[Base]:
    meshes = {"box.obj": files.OBJ, "box.stl": files.stl_binary()}
    lines = "".join(json.dumps(row) + "\n" for row in _ROWS).encode()
    record = {
        "uid": {
            "name": "Mug",
            "license": "by",
            "user": {"displayName": "A"},
            "tags": [{"name": "cup"}],
            "categories": ["x"],
            "uri": "https://a.b",
        }
    }
    glb = _meshes()[-1].files["thing.glb"]
    catalogue = (
        b"id=x\nname=Set\nid#1=a\nname#1=Mug\nmodel#1=/box.obj\nwidth#1=10\ndepth#1=10\nheight#1=10\n"
        b"category#1=Kitchen\ncreator#1=A\\u00e9\n"
    )
    return [
        _base("jsonl", {**meshes, "rows.jsonl": lines}, jsonl=1),
        _base("csv", {**meshes, "rows.csv": _CSV}, csv=1),
        Base(
            "objaverse",
            {
                "glbs/000-000/uid.glb": glb,
                "annotations.json": json.dumps(record).encode(),
                "lvis-annotations.json": b'{"mug_1": ["uid"]}',
            },
            {"annotations.json": 2, "lvis-annotations.json": 1},
        ),
        Base(
            "graspnet_infinite",
            {"mug/uid.glb": glb, "mug/uid.json": json.dumps({"License": "CC0", "scaleToMeters": 0.1, "author": "A"}).encode()},
            {"mug/uid.json": 1},
        ),
        Base(
            "sweethome3d", {"PluginFurnitureCatalog.properties": catalogue, **meshes}, {"PluginFurnitureCatalog.properties": 1}
        ),
    ]


def _manifest_options(base: str) -> ReaderOptions:
    return ReaderOptions(manifest=f"rows.{base}") if base in ("jsonl", "csv") else ReaderOptions(preset=base)


def _urdf() -> list[Base]:
    contents = {
        "mug/mug.urdf": files.URDF,
        "mug/box.obj": files.OBJ,
        "mug/box.mtl": files.MTL,
        "mug/box.stl": files.stl_binary(),
        "mug/picture.png": _PICTURE,
    }
    return [_base("urdf", contents, urdf=8, obj=1, stl=1)]


def _sdformat() -> list[Base]:
    contents = {
        "mug/model.sdf": files.SDFORMAT,
        "mug/model.config": files.CONFIG,
        "mug/meshes/box.dae": files.DAE,
        "mug/meshes/picture.png": _PICTURE,
        "knob/model.sdf": files.KNOB,
        "knob/model.config": files.CONFIG,
    }
    return [
        Base("sdformat", contents, {"mug/model.sdf": 6, "mug/model.config": 1, "knob/model.sdf": 2, "mug/meshes/box.dae": 1})
    ]


def _mjcf() -> list[Base]:
    contents = {
        "mug.xml": files.MJCF,
        "parts/defaults.xml": files.MJCF_DEFAULTS,
        "meshes/box.stl": files.stl_binary(),
        "textures/picture.png": _PICTURE,
    }
    return [Base("mjcf", contents, {"mug.xml": 6, "parts/defaults.xml": 2, "meshes/box.stl": 1, "textures/picture.png": 0.5})]


def _usd() -> list[Base]:
    layers = {
        "thing.usda": files.USDA,
        "colours.usda": files.USDA_COLOURS,
        "knob.usda": files.USDA_KNOB,
        "picture.png": _PICTURE,
    }
    binary = {
        "thing.usdc": files.usdc(files.USDA),
        **{path: content for path, content in layers.items() if path != "thing.usda"},
    }
    return [
        Base("usda", layers, {"thing.usda": 6, "colours.usda": 1, "knob.usda": 1}),
        Base("usdc", binary, {"thing.usdc": 1}),
        Base("usdz", {"thing.usdz": files.usdz(layers)}, {"thing.usdz": 1}),
    ]


def _read_usd_alone(folder: Path, base: str) -> bool:
    """Reads the layers in this process, without the look at them that a process of its own takes first."""
    path = f"thing.{base}"
    _check_asset(reader_of("usd").read(Boundary(folder), SourceRef("thing", path, (path,)), ReaderOptions()))
    return True


@dataclass(slots=True)
class _Step:
    step: str = ""


def _converted() -> list[Base]:
    found = {base.name: base for base in (*_meshes(), *_urdf(), *_mjcf())}
    return [found[name] for name in ("obj", "gltf", "ply", "urdf", "mjcf")]


_SETTINGS = ConversionSettings(licence="CC0-1.0", decomposes=False, finds_poses=False, num_points=32, texture_side=16)


def _convert(folder: Path, base: str) -> bool:
    kind = base if base in ("urdf", "mjcf") else "mesh"
    reader, made, refusal = reader_of(kind), 0, None
    for item in reader.find(Boundary(folder), ReaderOptions()):
        if isinstance(item, Notice):
            continue
        try:
            asset = reader.read(Boundary(folder), item, ReaderOptions(up="z", unit_m=0.0 if kind != "mesh" else 0.1))
            row = convert(asset, _SETTINGS, _CONTEXT, _Step(), source_path=item.path)
        except MeshError as error:
            refusal = error
            continue
        check_notices(row.notices)
        arrow_table("assets", [row.asset_row])
        arrow_table("meshes", [row.mesh_row])
        check_finite(
            "asset", row.asset_row["extents"], row.asset_row["mass"], row.asset_row["inertia"], row.asset_row["center_of_mass"]
        )
        made += 1
    if not made and refusal is not None:
        raise refusal
    return bool(made)


_CONTEXT = ConversionContext()

TARGETS = (
    Target(
        "import_mesh",
        40,
        _meshes,
        _reading("mesh"),
        (*files.XML_WORDS[:20], "f", "v", "vt", "usemtl", "mtllib", "map_Kd", "element", "property", "list"),
    ),
    Target("import_dae", 8, _collada, _reading("mesh"), files.XML_WORDS),
    Target(
        "import_manifest",
        20,
        _manifests,
        _reading("mesh", _manifest_options),
        ("file", "path", "id", "size_m", "unit_m", "mass", "up", "-x", "tags"),
    ),
    Target("import_urdf", 8, _urdf, _reading("urdf"), files.XML_WORDS),
    Target("import_sdformat", 5, _sdformat, _reading("sdformat"), files.XML_WORDS),
    Target("import_mjcf", 5, _mjcf, _reading("mjcf"), files.XML_WORDS),
    Target("import_usd", 5, _usd, _read_usd_alone, files.USD_WORDS, block=100, starts=_SCAN, read_apart=_reading("usd")),
    Target("convert", 5, _converted, _convert, files.XML_WORDS, block=50),
)
"""The targets of this module."""
