"""The table ``edits``: drafts of edits for the scenes of a run, as training data; they are neither settled nor checked.

The reply of a reasoner is corrected afterwards, so a training example needs no proof that it is at rest. Hundreds of drafts take
the time of one proof. :mod:`stable_data.embedded_world.edits` makes proved edits.
"""

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import networkx as nx
import numpy as np

from stable_data.code_version import code_version
from stable_data.content_id import content_id
from stable_data.embedded_world.drafting import EditDraft, SceneEditor, kinds_in_turn
from stable_data.embedded_world.edits import edited_objects, phrase_edit
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.embedded_world.groups.arrangement import GroupItem, GroupSampler
from stable_data.embedded_world.placing import PlacedObject
from stable_data.embedded_world.scenes import RECORD
from stable_data.errors import SceneError
from stable_data.instructions.naming import ObjectNamer
from stable_data.scene import TABLE, QuatXyzw, Scene, SceneObject, Vec3
from stable_data.scene_graph.relations import scene_graph, supports
from stable_data.storage.checksums import save_checksums
from stable_data.storage.manifest import COMPLETE, PLANNED, read_manifest, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import TABLE_VERSION, Row
from stable_data.storage.table_rows import object_row, scene_from_row

_SAME_TILT = 1e-6  # largest difference per component of a tilt from a file and the equal tilt of the catalogue
_DIGITS = 9  # decimals of lengths in metres: a millionth of a millimetre


def edit_rows(row: Row, count: int = 4, seed: int = 0) -> list[Row]:
    """Makes rows of ``edits`` for a scene of the embedded world.

    Args:
        row: The scene, a row of ``scenes``.
        count: Number of edits; the kinds take turns, and the next kind replaces one that has no draft.
        seed: Determines the edits, together with the id of the scene.

    Returns:
        At most ``count`` rows, all with different instructions.

    Raises:
        SceneError: The scene is not an unchanged scene of the embedded world (``not_synth``).
    """
    scene = scene_from_row(row)
    placed = _placed_objects(scene)
    containers = {name: obj.asset.hollow is not None for name, obj in placed.items()}
    graph = scene_graph(scene, {o.instance: (o.support,) for o in scene.objects if o.support}, containers=containers)
    namer, scene_hash = ObjectNamer(scene, graph), zlib.crc32(scene.scene_id.encode())
    carriers = frozenset(name for verdict in row["verdicts"] for name in verdict["supports"]) | {
        o.support for o in scene.objects if o.support is not None
    }
    # Keyed by the instruction, so that no two rows have the same words.
    rows: dict[str, Row] = {}
    for number in range(count):
        # A stream per edit: an edit does not depend on the number of edits before it.
        rng = np.random.default_rng([seed, scene_hash, number])
        editor = SceneEditor(scene, placed, namer, GroupSampler(rng), carriers)
        kinds = kinds_in_turn(scene_hash + number)
        for kind, draft in ((each, draft) for each in kinds for draft in editor.drafts(each)):
            after, text = _objects_after(scene, draft), phrase_edit(draft, rng)
            if after is not None and text not in rows:
                rows[text] = _row(row, f"{scene.scene_id}_{number}", kind, text, scene, _with_supports(scene, after, draft))
                break
    return list(rows.values())


def _placed_objects(scene: Scene) -> dict[str, PlacedObject]:
    """The placed object of each instance; objects that support each other form a group."""
    keys = (scene.source or {}).get(RECORD, {}).get("keys", ())
    if len(keys) != len(scene.objects) or any(
        key not in KEYS or asset(key).uid != o.asset_id for key, o in zip(keys, scene.objects, strict=True)
    ):
        raise SceneError(
            f"{scene.scene_id}: its record lists {len(keys)} catalogue assets, expected the assets of its {len(scene.objects)} objects "
            "in order; use a scene that stable-data synth made",
            "not_synth",
        )
    # Objects that support each other move together, so they form a group.
    links = nx.Graph([(o.instance, o.support) for o in scene.objects if o.support not in (None, TABLE)])
    links.add_nodes_from(o.instance for o in scene.objects)
    group = {name: number for number, names in enumerate(nx.connected_components(links)) for name in names}
    return {o.instance: _placed_object(key, o, group[o.instance]) for key, o in zip(keys, scene.objects, strict=True)}


def _placed_object(key: str, o: SceneObject, group: int) -> PlacedObject:
    assert o.scale is not None  # the MesaTask format always states it
    x, y, z = o.position
    scale = _relative_scale(o.scale, asset(key).unit)
    return PlacedObject(GroupItem(key, x, y, o.yaw, _catalogue_tilt(key, o.tilt_quat_xyzw), scale), z, group)


def _catalogue_tilt(key: str, tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """The equal tilt of the catalogue, if there is one."""
    tilts = asset(key).tilts
    return next((tilt for tilt in tilts if np.allclose(tilt, tilt_quat_xyzw, rtol=0, atol=_SAME_TILT)), tilt_quat_xyzw)


def _relative_scale(scale: Vec3, unit: float) -> Vec3:
    x, y, z = (round(s / unit, _DIGITS) for s in scale)
    return x, y, z


def _objects_after(scene: Scene, draft: EditDraft) -> tuple[SceneObject, ...] | None:
    """The objects of the edited scene at their lowered poses."""
    found = [scene[name] if name is not None and name not in draft.changed else lower_object(obj) for name, obj in draft.placed]
    return edited_objects(scene, draft, found)


def lower_object(obj: PlacedObject) -> SceneObject:
    """Converts a placed object into a scene object at its unsettled pose, named by its asset key."""
    item, source = obj.item, obj.asset
    x, y, z = (round(v, _DIGITS) for v in (item.x, item.y, obj.z))
    width, depth, height = _box(item.key, item.scale, item.tilt_quat_xyzw)
    sx, sy, sz = (s * source.unit for s in item.scale)
    return SceneObject(
        item.key,
        source.category,
        (x, y, z),
        math.remainder(item.yaw, 2 * math.pi),
        (width, depth, height),
        source.uid,
        (sx, sy, sz),
        item.tilt_quat_xyzw,
        source.captions[0],
    )


@lru_cache(maxsize=4096)
def _box(key: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> Vec3:
    x, y, z = PlacedObject(GroupItem(key, scale=scale, tilt_quat_xyzw=tilt_quat_xyzw)).shape.size.tolist()
    return x, y, z


def _with_supports(scene: Scene, after: tuple[SceneObject, ...], draft: EditDraft) -> tuple[SceneObject, ...]:
    """The objects with their supports; the supports of changed objects are inferred from the boxes."""
    unchanged = {o.instance: o.support for o in scene.objects if o in after}
    containers = {o.instance: obj.asset.hollow is not None for o, (_, obj) in zip(after, draft.placed, strict=True)}
    names = {o.instance for o in after}
    contacts = {name: (support,) for name, support in unchanged.items() if support is not None and support in names | {TABLE}}
    carriers = supports(replace(scene, objects=after), contacts, containers=containers)
    return tuple(o if o.instance in unchanged else replace(o, support=carriers[o.instance]) for o in after)


def _row(row: Row, edit_id: str, kind: str, text: str, scene: Scene, after: tuple[SceneObject, ...]) -> Row:
    names = {o.instance for o in after}
    was = {o.instance: o for o in scene.objects}
    return {
        "edit_id": edit_id,
        **{name: row[name] for name in ("scene_id", "split", "table_type", "table_size", "restricted_zone")},
        "kind": kind,
        "instruction": text,
        "objects_in": [object_row(o, with_source=False) for o in scene.objects],
        "objects_out": [object_row(o, with_source=False) for o in after if was.get(o.instance) != o],
        "removed": [name for name in was if name not in names],
    }


def write_edits(run: RunFolder, out: RunFolder, count: int = 4, seed: int = 0) -> Iterator[tuple[int, list[SceneError]]]:
    """Writes ``edits`` for the ``scenes`` of a run, one shard per shard of scenes; existing shards are skipped.

    Args:
        run: A run over the embedded world, with its ``scenes``.
        out: The output folder, which may be the run itself.
        count: Edits per scene.
        seed: Seed of the edits.

    Yields:
        After each shard the number of new edits, 0 if the shard existed, and an error for each scene without edits.

    Raises:
        ConfigError: A folder cannot be read or written.
    """
    dataset = run.dataset("scenes")
    done = out.shard_ids("edits")
    for fragment in dataset.get_fragments():
        shard_id = content_id(Path(fragment.path).name, count, seed)
        if shard_id in done:
            yield 0, []
            continue
        rows: list[Row] = []
        failures: list[SceneError] = []
        for row in fragment.to_table(schema=dataset.schema).to_pylist():
            try:
                rows += edit_rows(row, count, seed)
            except SceneError as error:
                failures.append(error)
        out.write_shard("edits", shard_id, rows)
        yield len(rows), failures


def record_edits(run: RunFolder, out: RunFolder, count: int, seed: int) -> None:
    """Records the drafted edits in the manifest of their folder; a folder with edits alone gets one.

    An unfinished run gets the checksums alone: its job writes the manifest.

    Args:
        run: The run of the scenes.
        out: The folder with the edits.
        count: Edits per scene.
        seed: Seed of the edits.

    Raises:
        ConfigError: A folder cannot be read or written.
    """
    manifest = read_manifest(out)
    if manifest is None and out.tables() == ["edits"]:
        manifest = {
            "job": "draft-edits",
            "status": COMPLETE,
            "code_version": code_version(),
            "table_version": TABLE_VERSION,
            "dataset": Path(run.root).name,
            "inputs": {"scenes": content_id(sorted(run.shard_ids("scenes")))},
            "settings": {"per_scene": count, "seed": seed},
            PLANNED: [],
        }
    if manifest is None or manifest.get("status") != COMPLETE:
        save_checksums(out)
        return
    write_manifest(out, manifest | {"counts": {**manifest.get("counts", {}), "edits": out.num_rows("edits")}})
