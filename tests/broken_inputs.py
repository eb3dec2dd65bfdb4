"""A dataset in which each scene is broken in one way, made of ``tests/data``, and what a loader does with each.

Every scene has a plate, a bowl, a jar and a tomato. A broken layout has its fault in the tomato or in the document; a broken
mesh is that of a fifth object.
"""

import hashlib
import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh

from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.gltf_writer import pack, write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.mesatask import AssetAnnotation, MesaTaskDataset, write_annotations, write_asset, write_layout
from stable_data.scene import Scene, SceneObject, Tabletop, Vec3

Action = Literal["keep", "keep_with_warning", "reject"]
Document = dict[str, Any]

TOMATO, FIFTH = "4_tomato_0", "5_object_0"
TABLE_TYPE = "office_table"
_TOMATO_UID = "9812df2562f7d3c88c96788a90544e5a"
# Instance, asset, position on the table in metres, yaw in radians, largest side in metres.
_OBJECTS = (
    ("1_small_plate_0", "77ccd3c23a304f58e0b2bb07c89f2234", (0.25, 0.20), 0.3, 0.169),
    ("2_bowl_0", "9571dc2e4428883f5b01fbc75df90a4f", (0.55, 0.35), -0.5, 0.141),
    ("3_small_jar_0", "fcd75f83075b287b7b514ba513064f64", (0.80, 0.20), 0.0, 0.113),
    (TOMATO, _TOMATO_UID, (0.30, 0.45), 1.0, 0.084),
)
_FIFTH_AT, _FIFTH_SIDE = (0.62, 0.12), 0.08


@dataclass(frozen=True, slots=True)
class BrokenInput:
    """One way in which a scene is broken.

    Attributes:
        name: Of the way; also the scene's id.
        action: What a loader does with the scene.
        layout_code: Of the error or notice that reading the layout gives; None where it gives none.
        mesh_code: Of the error or notice that loading and repairing the fifth object's mesh gives; None where it gives none.
        break_text: The layout as text to the bytes of the file.
        make_mesh: The file of the fifth object's mesh from the tomato's mesh; it returns None where no file is written.
            Without it there is no fifth object.
        is_mesh_usable: Whether the fifth object has a mesh; if not, a box of its size stands in.
    """

    name: str
    action: Action
    layout_code: str | None = None
    mesh_code: str | None = None
    break_text: Callable[[str], bytes] = str.encode
    make_mesh: Callable[[Mesh], bytes | None] | None = None
    is_mesh_usable: bool = True

    @property
    def asset_id(self) -> str:
        """Uid of the fifth object's asset."""
        return hashlib.md5(self.name.encode(), usedforsecurity=False).hexdigest()


def write_broken_inputs(root: Path, good: Path) -> None:
    """Writes a dataset with one scene for each of ``BROKEN_INPUTS``.

    Args:
        root: Where; an empty or new folder.
        good: The dataset that it is made of, ``tests/data``.
    """
    dataset = MesaTaskDataset(good)
    meshes, annotations = dict[str, Mesh](), dict[str, AssetAnnotation]()
    for _, uid, _, _, _ in _OBJECTS:
        path = dataset.asset_path(uid)
        assert path is not None
        meshes[uid] = load_glb(path, uid)[0]
        annotations[uid] = dataset.annotation(uid)
        write_asset(root, uid, path.read_bytes())
    tomato = meshes[_TOMATO_UID]
    for broken in BROKEN_INPUTS:
        objects = [_object(name, uid, meshes[uid], at, yaw, side) for name, uid, at, yaw, side in _OBJECTS]
        if broken.make_mesh is not None:
            file = broken.make_mesh(tomato)
            meshes[broken.asset_id] = load_glb(file, FIFTH)[0] if file and broken.action == "keep" else tomato
            objects.append(_object(FIFTH, broken.asset_id, meshes[broken.asset_id], _FIFTH_AT, 0.0, _FIFTH_SIDE))
            annotations[broken.asset_id] = replace(annotations[_TOMATO_UID], asset_id=broken.asset_id, raw={})
            if file is not None:
                write_asset(root, broken.asset_id, file)
        extents = {uid: _triple(mesh.extents) for uid, mesh in meshes.items()}
        layout = write_layout(Scene(broken.name, Tabletop(TABLE_TYPE, (1.0, 0.6)), tuple(objects)), extents=extents)
        folder = root / "Layout_info" / TABLE_TYPE / broken.name
        folder.mkdir(parents=True)
        (folder / "layout.json").write_bytes(broken.break_text(json.dumps(layout)))
    write_annotations(root, annotations)


def _object(name: str, uid: str, mesh: Mesh, at: tuple[float, float], yaw: float, side: float) -> SceneObject:
    """An upright object on the table whose largest side is given, metres."""
    factor = side / float(mesh.extents.max())
    size = _triple(mesh.extents * factor)
    return SceneObject(name, name.split("_", 1)[1][:-2], (*at, size[2] / 2), yaw, size, uid, (factor, factor, factor))


def _triple(values: npt.ArrayLike) -> Vec3:
    x, y, z = np.asarray(values, np.float64).tolist()
    return x, y, z


# --- layouts ---


def _edited(edit: Callable[[Document], object]) -> Callable[[str], bytes]:
    """A fault that the parsed layout can have."""

    def break_text(text: str) -> bytes:
        document: Document = json.loads(text)
        edit(document)
        return json.dumps(document).encode()

    return break_text


def _with_tomato(**changes: Any) -> Callable[[str], bytes]:
    """Other values of the tomato's entry; None takes the key away."""

    def edit(document: Document) -> None:
        entry = next(o for o in document["objects"] if o["instance"] == TOMATO)
        entry.update({key: value(entry[key]) if callable(value) else value for key, value in changes.items()})
        for key in [key for key, value in changes.items() if value is None]:
            del entry[key]

    return _edited(edit)


def _with_document(changes: Mapping[str, Any]) -> Callable[[str], bytes]:
    return _edited(lambda document: document.update(changes))


def _too_large_for_a_float(text: str) -> bytes:
    """A number that is valid JSON and reads as infinity."""
    return _with_tomato(position=[math.inf, 45.0, 3.9])(text).replace(b"Infinity", b"1e999")


def _first_named_as_tomato(document: Document) -> None:
    document["objects"][0]["instance"] = TOMATO


def _many_objects(document: Document) -> None:
    """5000 copies of the tomato on a grid of one centimetre."""
    tomato = document["objects"][3]
    copies = [
        tomato | {"instance": f"{k}_tomato_{k}", "position": [k % 100, k // 100, tomato["position"][2]]} for k in range(5000)
    ]
    document["objects"] = copies


# --- meshes ---


def _without_mesh(_: Mesh) -> bytes:
    """A valid file with a node and nothing to show."""
    return pack({"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"name": "asset"}]}, [])


def _with_nan(mesh: Mesh) -> bytes:
    """Every seventh vertex is NaN; :func:`write_glb` puts the vertices first in the binary chunk."""
    data = bytearray(write_glb(mesh))
    start = 12 + 8 + struct.unpack_from("<I", data, 12)[0] + 8
    vertices = np.frombuffer(data, "<f4", 3 * len(mesh.vertices), start).reshape(-1, 3)
    vertices[::7] = np.nan
    return bytes(data)


def _open_bowl(_: Mesh) -> bytes:
    """The lower half of a sphere, one wall, open at the top."""
    angles = np.linspace(0, math.pi / 2, 9)
    revolved = trimesh.creation.revolve(np.stack([np.sin(angles), -np.cos(angles)], axis=1), sections=24)
    return write_glb(Mesh(np.array(revolved.vertices), np.array(revolved.faces, np.int64)))


def _with_length(mesh: Mesh) -> bytes:
    """The header tells of 4 GB."""
    data = bytearray(write_glb(mesh))
    struct.pack_into("<I", data, 8, 4_294_967_280)
    return bytes(data)


def _truncated(mesh: Mesh) -> bytes:
    data = write_glb(mesh)
    return data[: int(0.6 * len(data))]


def _of_layout(name: str, action: Action, break_text: Callable[[str], bytes], code: str = "") -> BrokenInput:
    return BrokenInput(name, action, code or name, break_text=break_text)


def _refused_mesh(name: str, make_mesh: Callable[[Mesh], bytes]) -> BrokenInput:
    return BrokenInput(name, "keep_with_warning", mesh_code=name, make_mesh=make_mesh, is_mesh_usable=False)


def _noticed_mesh(name: str, make_mesh: Callable[[Mesh], bytes], code: str = "") -> BrokenInput:
    return BrokenInput(name, "keep_with_warning", mesh_code=code or name, make_mesh=make_mesh)


BROKEN_INPUTS = (
    BrokenInput("nothing_broken", "keep"),
    BrokenInput("glb_open_bowl", "keep", make_mesh=_open_bowl),
    BrokenInput("glb_missing", "keep_with_warning", "glb_missing", make_mesh=lambda _: None, is_mesh_usable=False),
    _refused_mesh("glb_truncated", _truncated),
    _refused_mesh("glb_zero_bytes", lambda _: b""),
    _refused_mesh("glb_nan_vertices", _with_nan),
    _refused_mesh("glb_no_faces", _without_mesh),
    _refused_mesh("glb_degenerate_only", lambda mesh: write_glb(Mesh(mesh.vertices, mesh.faces[:, [0, 0, 0]]))),
    _noticed_mesh("glb_inside_out", lambda mesh: write_glb(Mesh(mesh.vertices, mesh.faces[:, ::-1]))),
    _noticed_mesh("glb_length_4gb", _with_length, "glb_length_mismatch"),
    _of_layout("json_truncated", "reject", lambda text: text[: len(text) // 2].encode()),
    _of_layout("json_not_utf8", "reject", lambda text: text.replace(TOMATO, "4_tomat\xf6_0").encode("latin-1")),
    _of_layout("position_nan", "reject", _with_tomato(position=[30.0, math.nan, 3.9])),
    _of_layout("position_inf", "reject", _too_large_for_a_float),
    _of_layout("coordinates_huge", "reject", _with_tomato(position=[1e9, 45.0, 3.9])),
    _of_layout("zone_max_below_min", "reject", _with_document({"item_placement_zone": [100, 0, 60, 0]})),
    _of_layout("objects_empty", "reject", _with_document({"objects": []})),
    _of_layout("objects_5000", "reject", _edited(_many_objects), "too_many_objects"),
    _of_layout("uid_path_traversal", "reject", _with_tomato(retrieved_uid="../../x", selected_uid="../../x")),
    _of_layout("unknown_uid", "keep_with_warning", _with_tomato(retrieved_uid="f" * 32, selected_uid="f" * 32)),
    _of_layout("scale_zero", "keep_with_warning", _with_tomato(scale_factor=lambda scale: [0.0, *scale[1:]])),
    _of_layout("scale_negative", "keep_with_warning", _with_tomato(scale_factor=lambda scale: [-scale[0], *scale[1:]])),
    _of_layout("scale_factor_missing", "keep_with_warning", _with_tomato(scale_factor=None)),
    _of_layout("rotation_not_unit", "keep_with_warning", _with_tomato(rotation=lambda quat: [2 * q for q in quat])),
    _of_layout("rotation_wrong_length", "keep_with_warning", _with_tomato(rotation=lambda quat: quat[:3])),
    _of_layout("z_rotation_degrees", "keep_with_warning", _with_tomato(z_rotation=math.degrees), "z_rotation_disagrees"),
    _of_layout("duplicate_instance", "keep_with_warning", _edited(_first_named_as_tomato)),
)
