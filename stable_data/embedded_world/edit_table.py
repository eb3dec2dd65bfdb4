"""The table ``edits``: edits of scenes that a run has read, to train on; drafts alone, neither settled nor judged.

What a reasoner writes is corrected afterwards, so an example needs no proof that it stays: hundreds of drafts are made in the
time that one proof takes. :mod:`stable_data.embedded_world.edits` makes the ones that are proved.
"""

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import networkx as nx
import numpy as np

from stable_data.content_id import content_id
from stable_data.embedded_world.drafting import KINDS, EditDraft, SceneEditor
from stable_data.embedded_world.edits import edited_objects, phrase_edit
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.embedded_world.groups.arrangement import GroupItem, GroupSampler
from stable_data.embedded_world.placing import PlacedObject
from stable_data.embedded_world.scenes import RECORD
from stable_data.errors import SceneError
from stable_data.instructions.naming import ObjectNamer
from stable_data.scene import TABLE, QuatXyzw, Scene, SceneObject, Vec3
from stable_data.scene_graph.relations import scene_graph, supports
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row, object_row, scene_from_row

_SAME_TILT = 1e-6  # a tilt that went through a file is taken for the catalogue's where no component differs by more
_DIGITS = 9  # of what is written: a millionth of a millimetre


def edit_rows(row: Row, count: int = 4, seed: int = 0) -> list[Row]:
    """Rows of ``edits`` for a scene of the embedded world.

    Args:
        row: The scene, a row of ``scenes``.
        count: How many edits; kinds take turns, and where one cannot be made, the next is.
        seed: Together with the scene's id, what the edits depend on.

    Returns:
        At most ``count`` rows, no two with the same words.

    Raises:
        SceneError: The scene is not of the embedded world as it was made (``not_synth``).
    """
    scene = scene_from_row(row)
    things = _things_of(scene)
    containers = _containers(things)
    graph = scene_graph(scene, {o.instance: (o.support,) for o in scene.objects if o.support}, containers=containers)
    namer, scene_hash = ObjectNamer(scene, graph), zlib.crc32(scene.scene_id.encode())
    carriers = frozenset(name for verdict in row["verdicts"] for name in verdict["supports"]) | {
        o.support for o in scene.objects if o.support is not None
    }
    rows: dict[str, Row] = {}
    for number in range(count):
        rng = np.random.default_rng([seed, scene_hash, number])
        desk = SceneEditor(scene, things, namer, GroupSampler(rng), carriers)
        first = (scene_hash + number) % len(KINDS)
        for kind, draft in _drafts(desk, (*KINDS[first:], *KINDS[:first])):
            after, text = _objects_after(scene, draft), phrase_edit(draft, rng)
            if after is not None and text not in rows:
                rows[text] = _row(row, f"{scene.scene_id}_{number}", kind, text, scene, _supported(scene, after, draft))
                break
    return list(rows.values())


def _drafts(desk: SceneEditor, kinds: tuple[str, ...]) -> Iterator[tuple[str, EditDraft]]:
    return ((kind, draft) for kind in kinds for draft in desk.drafts(kind))


def _things_of(scene: Scene) -> dict[str, PlacedObject]:
    """What the scene was made from, by instance; what carries each other is a group."""
    keys = (scene.source or {}).get(RECORD, {}).get("keys", ())
    if len(keys) != len(scene.objects) or any(
        key not in KEYS or asset(key).uid != o.asset_id for key, o in zip(keys, scene.objects, strict=True)
    ):
        raise SceneError(
            f"{scene.scene_id}: its record names {len(keys)} assets of the catalogue for {len(scene.objects)} objects, expected "
            "those that it shows; make edits of scenes of stable-data synth",
            "not_synth",
        )
    links = nx.Graph([(o.instance, o.support) for o in scene.objects if o.support not in (None, TABLE)])
    links.add_nodes_from(o.instance for o in scene.objects)
    group = {name: number for number, names in enumerate(nx.connected_components(links)) for name in names}
    return {o.instance: _thing(key, o, group[o.instance]) for key, o in zip(keys, scene.objects, strict=True)}


def _thing(key: str, o: SceneObject, group: int) -> PlacedObject:
    assert o.scale is not None  # the format has it
    x, y, z = o.position
    return PlacedObject(GroupItem(key, x, y, o.yaw, _planned(key, o.tilt_quat_xyzw), _over(o.scale, asset(key).unit)), z, group)


def _planned(key: str, tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """The catalogue's tilt, where this is one."""
    tilts = asset(key).tilts
    return next((tilt for tilt in tilts if np.allclose(tilt, tilt_quat_xyzw, rtol=0, atol=_SAME_TILT)), tilt_quat_xyzw)


def _over(scale: Vec3, unit: float) -> Vec3:
    x, y, z = (round(s / unit, _DIGITS) for s in scale)
    return x, y, z


def _containers(things: Mapping[str, PlacedObject]) -> dict[str, bool]:
    return {name: thing.asset.hollow is not None for name, thing in things.items()}


def _objects_after(scene: Scene, draft: EditDraft) -> tuple[SceneObject, ...] | None:
    """The objects of the edited scene as they were lowered."""
    found = [
        scene[name] if name is not None and name not in draft.changed else lower_object(thing) for name, thing in draft.things
    ]
    return edited_objects(scene, draft, found)


def lower_object(thing: PlacedObject) -> SceneObject:
    """A thing as an object where it was put, before anything has settled; its name is its key."""
    item, source = thing.item, thing.asset
    x, y, z = (round(v, _DIGITS) for v in (item.x, item.y, thing.z))
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


def _supported(scene: Scene, after: tuple[SceneObject, ...], draft: EditDraft) -> tuple[SceneObject, ...]:
    """The objects with what carries each, by their boxes where they are elsewhere than before."""
    kept = {o.instance: o.support for o in scene.objects if o in after}
    containers = {o.instance: thing.asset.hollow is not None for o, (_, thing) in zip(after, draft.things, strict=True)}
    names = {o.instance for o in after}
    contacts = {name: (support,) for name, support in kept.items() if support is not None and support in names | {TABLE}}
    carriers = supports(replace(scene, objects=after), contacts, containers=containers)
    return tuple(o if o.instance in kept else replace(o, support=carriers[o.instance]) for o in after)


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
    """Writes ``edits`` for the ``scenes`` of a run, a shard for each of its shards; those that are there are left alone.

    Args:
        run: A run over the embedded world, with its ``scenes``.
        out: Where to write, which may be the run itself.
        count: Edits a scene.
        seed: Which edits.

    Yields:
        After each shard how many edits it has got, 0 where it was there, and the scenes that have none.

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
