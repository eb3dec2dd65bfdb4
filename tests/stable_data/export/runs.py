"""A small run with meshes, parts, a scene that is at rest and one that is not: what an export is given."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.embedded_world.families.catalogue import asset
from stable_data.geometry.convex_decomposition import convex_parts
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.metrics.card import MetricCard
from stable_data.scene import QuatXyzw, Scene, SceneObject, Tabletop, TaskInfo, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_row, scene_row

KEYS = ("can/0", "cereal_box/0", "mug/0", "plate/0")
LYING: QuatXyzw = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
TABLE = Tabletop("dining_table", (1.2, 0.8), (0.9, 1.1, 0.5, 0.7))
CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)
ODD = 'odd/"scene" <é>'
ODD_INSTANCE = '1_mug #<&"_0'


def thing(key: str, name: str, x: float, y: float, z: float, yaw: float = 0.0, **rest: object) -> SceneObject:
    """An asset whose underside is at a height."""
    scale: Vec3 = rest.pop("scale", (1.0, 1.0, 1.0))  # type: ignore[assignment]
    tilt: QuatXyzw = rest.pop("tilt_quat_xyzw", (0.0, 0.0, 0.0, 1.0))  # type: ignore[assignment]
    a, b, c = Shape.from_mesh(asset(key).mesh, scale, tilt).size.tolist()
    return SceneObject(
        name, key.split("/")[0], (x, y, z + c / 2), yaw, (a, b, c), asset(key).uid, scale, tilt, "such a thing", support="table"
    )


def at_rest() -> Scene:
    """Six things: stacked, lying, stretched, two of one asset, and one without a mesh; a scene and instances with odd names."""
    box = thing("cereal_box/0", "3_cereal_box_0", 0.7, 0.4, 0.0, 0.4, tilt_quat_xyzw=LYING)
    objects = (
        thing("can/0", "0_can_0", 0.2, 0.3, 0.0, -2.5),
        thing("mug/0", ODD_INSTANCE, 0.4, 0.2, 0.0, 1.0, scale=(1.2, 1.1, 0.9)),
        thing("plate/0", "2_plate_0", 0.3, 0.6, 0.0),
        box,
        replace(thing("can/0", "4_can_1", 0.7, 0.4, box.size[2], 0.3), support=box.instance),
        SceneObject("5_thing_0", "thing", (1.0, 0.2, 0.05), 0.2, (0.1, 0.08, 0.1), support="table"),
    )
    return Scene(ODD, TABLE, objects, TaskInfo("A kitchen.", "Put the can on the plate.", task_objects=("0_can_0",)))


def falling() -> Scene:
    """A can in the air, turned so that it comes to lie, beside a mug that stands."""
    leaning: QuatXyzw = (0.3, 0.0, 0.0, 0.91**0.5)
    can = thing("can/0", "0_can_0", 0.5, 0.4, 0.003, 0.5, tilt_quat_xyzw=leaning)
    return Scene("falling", TABLE, (can, thing("mug/0", "1_mug_0", 0.2, 0.3, 0.0, 2.0)))


EMPTY = Scene("empty", Tabletop("dining_table", (1.0, 0.5)), ())
SCENES = (at_rest(), falling(), EMPTY)


def asset_rows(key: str) -> tuple[Row, Row]:
    """Rows of ``assets`` and ``meshes``."""
    mesh = asset(key).mesh
    found = convex_parts(mesh, given=asset(key).parts)
    glb = write_glb(mesh)
    parts = [{"vertices": p.vertices.ravel(), "faces": p.faces.ravel()} for p in found.parts]
    words = {"asset_id": asset(key).uid, "category": key.split("/")[0], "licence": "CC0", "source": "synth"}
    of_asset = dict.fromkeys(SCHEMAS["assets"].names) | words | {"extents": mesh.extents.tolist()}
    of_mesh = dict.fromkeys(SCHEMAS["meshes"].names) | {
        "asset_id": asset(key).uid,
        "glb": glb,
        "parts": parts,
        "sha256": hashlib.sha256(glb).hexdigest(),
    }
    return of_asset, of_mesh


def write_run(root: Path, scenes: Sequence[Scene] = SCENES) -> RunFolder:
    """A run with these scenes, in shards of two, and where the engine left them."""
    run = RunFolder(str(root))
    rows = [asset_rows(key) for key in KEYS]
    run.write_shard("assets", "0" * 16, [row for row, _ in rows])
    for number, (_, row) in enumerate(rows):
        run.write_shard("meshes", f"{number:016x}", [row])
    store = AssetStore(RunAssets(run, root.with_name(f"{root.name}-files")))
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "split": "train", "pairs": [], "verdicts": []}
    for start in range(0, len(scenes), 2):
        shard, part = f"{start:016x}", scenes[start : start + 2]
        run.write_shard(
            "scenes", shard, [blank | card_row(replace(CARD, num_objects=len(s.objects))) | scene_row(s) for s in part]
        )
        run.write_shard("settled", shard, [settled_row(s, store) for s in part])
    return run


def weighed(run: RunFolder, key: str, **columns: object) -> RunFolder:
    """The run with other columns of an asset; by default it is weighed, with its centre near its foot, and slippery."""
    tensor = [2e-4, 1e-5, 0, 1e-5, 3e-4, -1e-5, 0, -1e-5, 2.5e-4]
    known = {"mass_source": "given", "mass": 0.118, "center_of_mass": [0.004, -0.001, -0.02], "inertia": tensor}
    known |= {"typical_scale": [1.0, 1.0, 1.0], "friction": [0.25, 0.004, 0.0001]} | columns
    rows = [row | (known if row["asset_id"] == asset(key).uid else {}) for row in run.table("assets").to_pylist()]
    run.write_shard("assets", "0" * 16, rows)
    return run


def settled_row(scene: Scene, store: AssetStore) -> Row:
    """Where the engine left a scene."""
    rest = settle(SceneGeometry.of(scene, store).bodies, scene.table)
    poses = zip(rest.names, rest.positions.tolist(), rest.quats_xyzw.tolist(), strict=True)
    return {"scene_id": scene.scene_id, "poses": [{"instance": n, "position": p, "quat_xyzw": q} for n, p, q in poses]}


def posed(solid: SceneGeometry, instance: str) -> Mesh:
    """An object as triangles in the world."""
    k = [o.instance for o in solid.scene.objects].index(instance)
    return Mesh(solid.shapes[k].posed(solid.scene.poses()[k]), solid.shapes[k].faces)
