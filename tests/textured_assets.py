"""A box with a picture on each side, and runs that have it: what is seen of it is known."""

import hashlib
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from stable_data.assets.looks import LookRows, look_rows, texture_rows
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface import Surface
from stable_data.metrics.card import MetricCard
from stable_data.scene import Scene, SceneObject, Tabletop, Vec3
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_row, scene_row
from tests.scenes import box

SIZE: Vec3 = (0.1, 0.08, 0.12)
COLOURS = ("#c02020", "#20a020", "#2040d0", "#d0c020", "#20c0c0", "#c020c0")
"""Colours of the sides: -x, +x, -y (the front, whose lower half is white), +y, -z, +z (the top)."""

CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)


def atlas() -> bytes:
    """Six fields of 32 pixels in a row; the lower half of the third is white."""
    image = Image.new("RGB", (6 * 32, 32))
    for k, colour in enumerate(COLOURS):
        image.paste(colour, (32 * k, 0, 32 * k + 32, 32))
    image.paste("#ffffff", (64, 16, 96, 32))
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def picture_box(image: bytes | None = None, **rest: object) -> Surface:
    """The box, metres, centred; each side has its field of the atlas, upright on the four that stand."""
    half, sides = np.array(SIZE) / 2, []
    for axis in range(3):
        for sign in (-1, 1):
            normal = sign * np.eye(3)[axis]
            right = np.array([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [1.0, 0.0, 0.0]][axis])
            up = np.cross(normal, right)
            sides.append([(normal + u * right + v * up) * half for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    corners = np.array(sides)  # (6, 4, 3)
    uv = np.array([[[(k + u) / 6, v] for u, v in ((0, 1), (1, 1), (1, 0), (0, 0))] for k in range(6)])
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    corner_uv = np.concatenate([uv[:, [0, 1, 2]], uv[:, [0, 2, 3]]])
    return Surface(triangles, None, None, image or atlas(), corner_uv, **rest)  # type: ignore[arg-type]


def rows_of(asset_id: str, look: LookRows, size: Vec3 = SIZE) -> tuple[Row, Row, list[Row]]:
    """Rows of ``assets``, ``meshes`` and ``textures`` of a box with a look."""
    shape = box(*size)
    glb = write_glb(Mesh(shape.vertices, shape.faces))
    asset = dict.fromkeys(SCHEMAS["assets"].names) | {
        "asset_id": asset_id,
        "category": "box",
        "extents": list(size),
        "resting_tilts": [],
        "on_table": True,
    }
    mesh = dict.fromkeys(SCHEMAS["meshes"].names) | {
        "asset_id": asset_id,
        "glb": glb,
        "sha256": hashlib.sha256(glb).hexdigest(),
        "parts": [{"vertices": shape.vertices.ravel(), "faces": shape.faces.ravel()}],
        "look": look.glb,
        "look_distance": look.distance,
    }
    return asset, mesh, texture_rows(look.textures)


def textured(asset_id: str, *surfaces: Surface) -> tuple[Row, Row, list[Row]]:
    """Rows of the box with these surfaces, or with the atlas."""
    return rows_of(asset_id, look_rows(surfaces or (picture_box(),), np.zeros(3), asset_id=asset_id))


def thing(instance: str, asset_id: str, x: float, y: float, yaw: float = 0.0, scale: float = 1.0) -> SceneObject:
    """The box on the table."""
    a, b, c = (scale * side for side in SIZE)
    return SceneObject(instance, "box", (x, y, c / 2), yaw, (a, b, c), asset_id, (scale, scale, scale), support="table")


def scene_of(*objects: SceneObject) -> Scene:
    return Scene("scene_0", Tabletop("office_table", (0.6, 0.4), None), objects)


def write_run(root: Path, assets: Sequence[tuple[Row, Row, list[Row]]], *scenes: Scene) -> RunFolder:
    """A run with assets and scenes."""
    run = RunFolder(str(root))
    run.write_shard("assets", "0" * 16, [asset for asset, _, _ in assets])
    run.write_shard("meshes", "0" * 16, [mesh for _, mesh, _ in assets])
    run.write_shard("textures", "0" * 16, list({row["sha256"]: row for _, _, rows in assets for row in rows}.values()))
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "split": "train", "pairs": [], "verdicts": []}
    run.write_shard("scenes", "0" * 16, [blank | card_row(CARD) | scene_row(scene) for scene in scenes])
    return run
