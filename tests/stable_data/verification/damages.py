"""The ways in which a run is damaged: name -> what is done, where it is found, and what the finding says."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from stable_data.storage.checksums import CHECKSUMS
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from tests.stable_data.verification.editing import (
    Change,
    Damage,
    columns,
    copied_shard,
    files_of,
    flip,
    hide,
    manifest,
    recount,
    rows,
)

OLDER_RUNS = Path(__file__).parents[2] / "data" / "run_v3"


# --- ways to change rows ------------------------------------------------------------------------------------------------------


def scene(change: Callable[[Row], None], *, recounts: bool = False) -> Damage:
    """Changes the first scene."""

    def of_first(found: list[Row]) -> None:
        change(found[0])

    return rows("scenes", of_first, recounts=recounts)


def setting(**values: object) -> Damage:
    """Sets columns of the first scene."""
    return scene(lambda row: row.update(values))


def moved(row: Row) -> None:
    row["objects"][0]["position"][0] += 0.15


def asset_exchanged(row: Row) -> None:
    row["objects"][0]["asset_id"] = row["objects"][1]["asset_id"]


def without_first(found: list[Row]) -> list[Row]:
    return found[1:]


def doubled(found: list[Row]) -> list[Row]:
    return [*found, found[0]]


def swapped(one: str, other: str) -> Callable[[Row], None]:
    """Exchanges the values of two columns."""

    def change(row: Row) -> None:
        row[one], row[other] = row[other], row[one]

    return change


def exchanged(*names: str) -> Change:
    """Exchanges columns between the first two rows."""

    def change(found: list[Row]) -> None:
        for name in names:
            found[0][name], found[1][name] = found[1][name], found[0][name]

    return change


def moved_everywhere(run: Path) -> None:
    """Moves an object in its scene and in the turn that placed it last, so that both still agree."""
    path = files_of(run, "scenes")[0]
    (name, was) = next(
        (row["scene_id"], row["objects"][0]) for row in RunFolder(str(run)).read_file("scenes", str(path)).to_pylist()
    )

    def in_turns(found: list[Row]) -> None:
        last = max((row for row in found if row["scene_id"] == name), key=lambda row: row["turn"])
        next(pose for pose in last["corrected"] if pose["instance"] == was["instance"])["position"][0] += 0.15

    rows("scenes", lambda found: moved(found[0]))(run)
    for number, file in enumerate(files_of(run, "turns")):
        if file.name == path.name:
            rows("turns", in_turns, number=number)(run)


def floating(row: Row) -> None:
    """Says that an object floats, with all that follows from it."""
    row["verdicts"][0] |= {"floats": True, "supports": []}
    row |= {"float_rate": 1 / 3, "clean": False}


def colliding(row: Row) -> None:
    names = [o["instance"] for o in row["objects"]]
    row["pairs"] = [{"first": names[0], "second": names[1], "penetration_mm": 3.0}]
    row |= {"num_collisions": 1, "max_penetration_mm": 3.0, "clean": False, "oc_10mm": 0.0}
    row |= dict.fromkeys(("oc", "oc_0mm", "oc_1mm"), 1 / 3)


def outside(row: Row) -> None:
    row["verdicts"][1] |= {"leaves_table": True}
    row |= {"out_of_bounds_rate": 1 / 3, "clean": False}


def sunk(row: Row) -> None:
    row["verdicts"][1] |= {"table_penetration_mm": 4.0}
    row |= {"table_penetration_mm": 4.0, "clean": False}


def unsteady(row: Row) -> None:
    row |= {"stable": False, "settle_move_max_mm": 35.0}


def unjudged(row: Row) -> None:
    """Says that nobody simulated a scene."""
    row |= dict.fromkeys(
        ("stable", "settle_move_max_mm", "settle_turn_max_deg", "drift_mm", "jitter_mm", "engine_penetration_mm")
    )


def unjudged_where_all_is_accepted(run: Path) -> None:
    scene(unjudged)(run)
    manifest(lambda document: document["settings"].update(accept=""))(run)


def of_turn(change: Callable[[Row], None]) -> Damage:
    """Changes the last turn with a correction of the first scene that has one."""

    def of_last(found: list[Row]) -> None:
        name = next(row["scene_id"] for row in found if row["corrected"])
        change(max((row for row in found if row["scene_id"] == name and row["corrected"]), key=lambda row: row["turn"]))

    return rows("turns", of_last)


def without_turns(found: list[Row]) -> list[Row]:
    """All but the rows of an accepted scene, whose turns have corrections."""
    name = next(row["scene_id"] for row in found if row["corrected"])
    return [row for row in found if row["scene_id"] != name]


def settled_pose(**values: list[float]) -> Damage:
    return rows("settled", lambda found: found[0]["poses"][0].update(values))


def renamed_shard(run: Path) -> None:
    path = files_of(run, "scenes")[0]
    path.rename(path.with_name("part-00000000000000aa.parquet"))
    hide(run)


def exchanged_shards(run: Path) -> None:
    one, other = files_of(run, "scenes")[:2]
    aside = one.with_name("aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    hide(run)


def untold(row: Row) -> None:
    """Leaves out that an object is on the table, and that it faces somewhere."""
    row["relations"] = [
        r for r in row["relations"] if not (r["kind"] == "face to" and r["subject"] == row["objects"][0]["instance"])
    ]


def other_mesh(found: list[Row]) -> None:
    """Gives an asset the mesh of another one, with its hash and its parts."""
    for name in ("glb", "sha256", "parts"):
        found[0][name] = found[1][name]


def other_image(found: list[Row]) -> None:
    found[0]["image"] = found[1]["image"]


def with_columns(change: Callable[[pa.Schema], pa.Schema]) -> Callable[[pa.Table], pa.Table]:
    def changed(table: pa.Table) -> pa.Table:
        return table.cast(change(table.schema))

    return changed


def of_version(number: str) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.replace_schema_metadata({**table.schema.metadata, b"stable_data.version": number.encode()})


def shorter(column: str) -> Callable[[Row], None]:
    return lambda row: row.update({column: row[column][:-1]})


def everywhere(table: str, change: Change) -> Damage:
    """Changes the rows of every file of a table, and makes the counts fit."""

    def damage(run: Path) -> None:
        for number in reversed(range(len(files_of(run, table)))):
            rows(table, change, number=number, recounts=True)(run)

    return damage


def each(change: Callable[[Row], None]) -> Change:
    """Changes every row."""

    def of_all(found: list[Row]) -> None:
        for row in found:
            change(row)

    return of_all


def larger_report(name: str) -> Change:
    """A larger entry of the report on the first asset."""
    return lambda found: found[0]["report"].update({name: 2 * found[0]["report"][name] + 1})


def restaged(run: Path) -> None:
    """Makes every object of the last stage of a scene one of the second, in the scene and in its samples."""
    name = RunFolder(str(run)).read_file("scenes", str(files_of(run, "scenes")[0])).to_pylist()[0]["scene_id"]

    def in_scene(row: Row) -> None:
        if row["scene_id"] == name:
            for o in row["objects"]:
                o["stage"] = "important" if o["stage"] == "secondary" else o["stage"]

    rows("scenes", each(in_scene))(run)


def rescaled(found: list[Row]) -> None:
    """Another usual scale of an asset, with the columns that follow from it."""
    row = next(r for r in found if r["typical_scale"])
    row["typical_scale"] = [2 * scale for scale in row["typical_scale"]]
    row["volume"] *= 8


def remove(name: str) -> Damage:
    return lambda run: (run / name).unlink()


def replaced_shard(table: str, make: Callable[[Path], None]) -> Damage:
    """Puts something that is no file in the place of a shard."""

    def damage(run: Path) -> None:
        path = files_of(run, table)[0]
        path.unlink()
        make(path)

    return damage


def write(name: str, content: bytes) -> Damage:
    def damage(run: Path) -> None:
        (run / name).write_bytes(content)

    return damage


def emptied(run: Path) -> None:
    files_of(run, "warnings", with_rows=False)[0].write_bytes(b"")


def regrouped(found: list[Row]) -> None:
    for row in found:
        row["duplicate_group"] = "0" * 16


def truncated(run: Path) -> None:
    path = files_of(run, "meshes")[0]
    path.write_bytes(path.read_bytes()[:-400])


def without_shard(table: str, *, hidden: bool, recounts: bool = False) -> Damage:
    def damage(run: Path) -> None:
        files_of(run, table)[0].unlink()
        if recounts:
            recount(run)
        if hidden:
            hide(run)

    return damage


def without_table(run: Path) -> None:
    shutil.rmtree(run / "meshes")
    hide(run)


def without_assets(run: Path) -> None:
    """Removes the assets and their meshes, as if there had never been any."""
    for table in ("assets", "meshes", "textures"):
        shutil.rmtree(run / table)

    def uncounted(document: dict[str, Any]) -> None:
        for table in ("assets", "meshes", "textures"):
            del document["counts"][table]

    manifest(uncounted)(run)


def of_another_run(run: Path) -> None:
    """Puts in the scenes of another run, whose ids are others."""
    shutil.copy(OLDER_RUNS / "generate" / "scenes" / "part-c29be8c9ba341752.parquet", files_of(run, "scenes")[0])
    hide(run)


def unlisted(run: Path) -> None:
    lines = (run / CHECKSUMS).read_text().splitlines(keepends=True)
    (run / CHECKSUMS).write_text("".join(lines[1:]))


def stages_exchanged(row: Row) -> None:
    one, other = row["objects"][:2]
    one["stage"], other["stage"] = other["stage"], one["stage"]


def dropped_for_ever(found: list[Row]) -> None:
    """Says that the first turn with a correction dropped all that it has, although the scene has it."""
    turn = next(row for row in found if row["corrected"])
    turn["dropped"] = [{"instance": pose["instance"], "reason": "no room"} for pose in turn["corrected"]]
    turn["corrected"] = []


def warning_of_nothing(run: Path) -> None:
    path = files_of(run, "scenes")[0]
    rows_of = {"id": "gone", "step": "mesh", "code": "glb_odd", "message": "gone: odd"}
    RunFolder(str(run)).write_file("warnings", path.name, pa.Table.from_pylist([rows_of], schema=SCHEMAS["warnings"]))
    recount(run)
    hide(run)


def stated_twice(run: Path) -> None:
    path = run / "manifest.json"
    path.write_text(path.read_text("utf-8").replace('"status"', '"status": "running", "status"', 1), "utf-8")


def larger_inertia(found: list[Row]) -> None:
    found[0]["inertia_per_mass"] = [1e4 * value for value in found[0]["inertia_per_mass"]]


def one_point(found: list[Row]) -> None:
    points = found[0]["points"]
    found[0]["points"] = points[:3] * (len(points) // 3)


# --- the damages: name -> what is done, where it is found, and what the finding says -------------------------------------------

Damages: TypeAlias = dict[str, tuple[Damage, str, str]]

BY_CHECKSUM: Damages = {
    "a bit of a data page": (flip("scenes", 0.5), "scenes/", "SHA-256"),
    "a bit of a footer": (flip("assets", 0.97), "assets/", "SHA-256"),
    "the first byte": (flip("meshes", 0.0), "meshes/", "SHA-256"),
    "the last byte": (flip("turns", 1.0), "turns/", "SHA-256"),
    "a bit of a table without rows": (flip("grasps", 0.3), "grasps/", "SHA-256"),
    "a bit of the settled poses": (flip("settled", 0.4, 1), "settled/", "SHA-256"),
    "truncated": (truncated, "meshes/", "SHA-256"),
    "emptied": (emptied, "warnings/", "SHA-256"),
    "a missing shard": (without_shard("scenes", hidden=False), "scenes/", "is missing"),
    "a named pipe as a shard": (replaced_shard("scenes", os.mkfifo), "scenes/part-", "is no regular file"),
    "a named pipe as a shard of meshes": (replaced_shard("meshes", os.mkfifo), "meshes/part-", "is no regular file"),
    "a folder as a shard": (replaced_shard("turns", Path.mkdir), "turns/part-", "is no regular file"),
    "an extra shard": (copied_shard("turns", hidden=False), "turns/", f"is not in {CHECKSUMS}"),
    "another file among the shards": (write("scenes/extra.parquet", b"PAR1"), "scenes/extra", "readers of *.parquet see it"),
    "a row changed": (rows("turns", lambda found: found[0].update(reply="{}"), hidden=False), "turns/", "SHA-256"),
    "a checksum left out": (unlisted, "", CHECKSUMS),
    "no checksums": (remove(CHECKSUMS), CHECKSUMS, "is missing"),
    "odd checksums": (write(CHECKSUMS, b"nothing\n"), CHECKSUMS, "line 1"),
    "no manifest": (remove("manifest.json"), "manifest.json", "is missing"),
    "a manifest that is no JSON": (write("manifest.json", b"{"), "manifest.json", "no JSON"),
    "settings edited": (manifest(lambda m: m["settings"].update(seed=9), hidden=False), "manifest.json", "its digest"),
    "a key of the manifest twice": (stated_twice, "manifest.json", "gives key 'status' twice"),
    "counts edited, not the digest": (
        manifest(lambda m: m["counts"].update(scenes=4), hidden=False),
        "manifest.json",
        "its digest",
    ),
}
"""Damage of which the checksums and the digest are not made to fit."""

BY_CONTENT: Damages = {
    "a table is missing": (without_table, "meshes", "is missing, expected"),
    "a shard is missing": (without_shard("scenes", hidden=True, recounts=True), "scenes", "items are rows"),
    "all assets are missing": (without_shard("assets", hidden=True, recounts=True), "assets", "is missing, expected"),
    "all assets are missing and not counted": (without_assets, "scenes/", "the run has no table assets"),
    "a shard twice": (copied_shard("scenes"), "scenes/", "an earlier row has the same scene_id"),
    "the scenes of another run": (of_another_run, "scenes", "expected the 5 that were planned"),
    "a row twice in a shard": (rows("scenes", doubled, recounts=True), "scenes/", "an earlier row has the same scene_id"),
    "an asset twice": (rows("assets", doubled, recounts=True), "assets/", "an earlier row has the same asset_id"),
    "a turn twice": (rows("turns", doubled, recounts=True), "turns/", "an earlier row has the same scene_id, turn"),
    "a row removed": (rows("scenes", without_first, recounts=True), "scenes", "4 items are rows (2) or failures (2)"),
    "a turn removed": (rows("turns", without_first, recounts=True), "turns/", "expected 0: each turn once"),
    "a failure removed": (rows("failures", without_first, recounts=True), "scenes", "items are rows"),
    "a mesh removed": (rows("meshes", without_first, recounts=True), "assets", "are in no row of meshes"),
    "a scene renamed": (setting(scene_id="task_9"), "scenes", "one was renamed or exchanged"),
    "columns exchanged": (scene(swapped("distractor_rate", "float_rate")), "scenes/", "float_rate is"),
    "a pose edited": (scene(moved), "turns/", "after its last correction"),
    "an unknown asset": (scene(lambda row: row["objects"][0].update(asset_id="f" * 32)), "scenes/", "is in no row of assets"),
    "an asset exchanged": (
        scene(lambda row: row["objects"][0].update(asset_id=row["objects"][1]["asset_id"])),
        "scenes/",
        "duplicate_group is",
    ),
    "a scale edited": (scene(lambda row: row["objects"][0].update(scale=[0.5, 0.5, 0.5])), "scenes/", "its mesh at its scale"),
    "an unknown support": (scene(lambda row: row["objects"][0].update(support="shelf")), "scenes/", "support names shelf"),
    "an unknown task object": (
        scene(lambda row: row["task"].update(task_objects=["gone_0"])),
        "scenes/",
        "task_objects names gone_0",
    ),
    "a relation of nothing": (
        scene(lambda row: row["relations"].append({"subject": "gone_0", "kind": "on", "target": "table"})),
        "scenes/",
        "names gone_0",
    ),
    "meshes exchanged": (rows("meshes", other_mesh), "assets/", "as of its mesh"),
    "a mesh without its hash": (rows("meshes", exchanged("glb")), "meshes/", "does not have the hash"),
    "a hash edited": (rows("meshes", lambda found: found[0].update(sha256="0" * 64)), "meshes/", "does not have the hash"),
    "parts exchanged with nothing": (
        rows("meshes", lambda found: found[0]["parts"][0].update(faces=[0, 1, 999999])),
        "meshes/",
        "faces without vertices",
    ),
    "extents edited": (rows("assets", lambda found: found[0]["extents"].__setitem__(0, 9.0)), "assets/", "extents are"),
    "volume edited": (rows("assets", lambda found: found[0].update(volume=1.0)), "assets/", "volume is 1.0"),
    "points moved": (
        rows("assets", lambda found: found[0].update(points=[p + 1 for p in found[0]["points"]])),
        "assets/",
        "outside",
    ),
    "clean edited": (setting(clean=False), "scenes/", "clean is False, expected True"),
    "clean unknown": (setting(clean=None), "scenes/", "clean is None, expected True"),
    "a rate edited": (setting(oc=0.25), "scenes/", "oc is 0.25, expected 0.0"),
    "a number edited": (setting(num_objects=4), "scenes/", "num_objects is 4, expected 3"),
    "a verdict removed": (scene(lambda row: row["verdicts"].pop()), "scenes/", "verdicts are not on its objects"),
    "stable edited alone": (setting(stable=False), "scenes/", "stable is false, expected true"),
    "movements edited alone": (setting(settle_move_max_mm=12.0), "scenes/", "stable is true, expected false"),
    "a settled scene that is not there": (
        rows("settled", lambda found: found[0].update(scene_id="task_77")),
        "settled/",
        "in no row of",
    ),
    "a settled object that is not there": (
        rows("settled", lambda found: found[0]["poses"][0].update(instance="gone_0")),
        "settled/",
        "poses are of",
    ),
    "a turn of no scene": (rows("turns", lambda found: found[-1].update(scene_id="task_88")), "turns/", "in no row of"),
    "a wrong split": (setting(split="test"), "scenes/", "split is test, expected"),
    "no split": (setting(split=None), "scenes/", "split is None, expected"),
    "an unknown split": (setting(split="holdout"), "scenes/", "split is 'holdout'"),
    "an unknown stage": (scene(lambda row: row["objects"][0].update(stage="last")), "scenes/", "objects.stage is 'last'"),
    "another table version": (columns("scenes", of_version("2")), "scenes/", "is of table version 2"),
    "no table version": (columns("turns", lambda t: t.replace_schema_metadata(None)), "turns/", "is of table version none"),
    "a needed column dropped": (
        columns("scenes", lambda t: t.drop_columns(["objects"])),
        "scenes/",
        "column objects is missing",
    ),
    "a column dropped": (columns("scenes", lambda t: t.drop_columns(["aws"])), "scenes/", "column aws is missing"),
    "a column dropped in one shard": (
        columns("turns", lambda t: t.drop_columns(["cost"]), every=False),
        "turns/",
        "column cost is missing",
    ),
    "a column of another type": (
        columns("turns", with_columns(lambda s: s.set(s.get_field_index("tries"), pa.field("tries", pa.int32())))),
        "turns/",
        "column tries is int32",
    ),
    "a column added": (
        columns("failures", lambda t: t.append_column("more", pa.nulls(len(t), pa.string()))),
        "failures/",
        "a column more",
    ),
    "null where there is a value": (setting(table_type=None), "scenes/", "table_type is null"),
    "null in an object": (scene(lambda row: row["objects"][1].update(yaw=None)), "scenes/", "objects.yaw is null"),
    "null in a list": (
        scene(lambda row: row["objects"][1]["position"].__setitem__(2, None)),
        "scenes/",
        "an element that is null",
    ),
    "not a number": (scene(lambda row: row["objects"][1].update(yaw=float("nan"))), "scenes/", "objects.yaw is nan"),
    "infinite": (rows("assets", lambda found: found[0]["points"].__setitem__(0, np.inf)), "assets/", "points is inf"),
    "a short position": (scene(lambda row: row["objects"][1].update(position=[0.1, 0.2])), "scenes/", "has 2 elements"),
    "no rotation": (
        scene(lambda row: row["objects"][1].update(tilt_quat_xyzw=[0.0, 0.0, 0.0, 1.1])),
        "scenes/",
        "tilt_quat_xyzw has norm 1.1",
    ),
    "a share over one": (setting(awt_understood=1.5), "scenes/", "awt_understood is 1.5"),
    "a negative number": (setting(settle_turn_max_deg=-1.0), "scenes/", "settle_turn_max_deg is -1.0"),
    "counts edited": (manifest(lambda m: m["counts"].update(turns=99)), "turns", "expected 99 as the manifest counts"),
    "failed counts edited": (
        manifest(lambda m: m["counts"].update(failed_scenes=1)),
        "manifest.json",
        "failed_scenes is 1, expected 2",
    ),
    "counts by code edited": (
        manifest(lambda m: m["counts"]["failures_by_code"].update(reply_unusable=7)),
        "manifest.json",
        "failures_by_code is",
    ),
    "codes edited": (rows("failures", lambda found: found[0].update(code="other")), "manifest.json", "failures_by_code is"),
    "inputs edited": (manifest(lambda m: m["inputs"].update(tasks="0" * 16)), "manifest.json", "input_fingerprint is"),
    "the version edited": (manifest(lambda m: m.update(table_version=4)), "manifest.json", "table_version is 4"),
    "a scene that is not accepted": (scene(unsteady), "scenes/", "does not meet the rule 'clean and stable'"),
    "a verdict unknown": (scene(unjudged), "scenes/", "stable is None"),
    "the rule of acceptance edited": (
        manifest(lambda m: m["settings"].update(accept="clean and num_objects > 3")),
        "scenes/",
        "num_objects is 3",
    ),
    "no rule of acceptance": (manifest(lambda m: m["settings"].update(accept="clean and")), "manifest.json", "settings.accept"),
    "all turns of a scene removed": (rows("turns", without_turns, recounts=True), "turns", "1 scenes have no turn"),
    "settled poses removed": (rows("settled", without_first, recounts=True), "settled", "1 scenes have no row"),
    "a shard of scenes renamed": (renamed_shard, "turns/", "its scene is in another shard"),
    "two shards of scenes exchanged": (exchanged_shards, "settled/", "its scene is in another shard"),
    "settled poses moved": (settled_pose(position=[9.0, 9.0, 9.0]), "settled/", "as settle_move_max_mm of its scene"),
    "settled poses turned": (settled_pose(quat_xyzw=[1.0, 0.0, 0.0, 0.0]), "settled/", "as settle_turn_max_deg of its scene"),
    "the card of a turn edited": (of_turn(lambda row: row["card_after"].update(oc=1.0)), "turns/", "card_after.oc is 1.0"),
    "a pose of nothing proposed": (of_turn(lambda row: row["coarse"][0].update(instance="gone_0")), "turns/", "poses of"),
    "movements exchanged": (setting(move_mean_mm=9.0, move_max_mm=1.0), "scenes/", "move_mean_mm is 9.0, expected at most"),
    "a category edited": (rows("assets", lambda found: found[0].update(category="banana")), "scenes/", "is of category"),
    "a centre of mass outside": (
        rows("assets", lambda found: found[0].update(center_of_mass=[5.0, 0.0, 0.0])),
        "assets/",
        "center_of_mass is",
    ),
    "a negative inertia": (
        rows("assets", lambda found: found[0].update(inertia_per_mass=[-x for x in found[0]["inertia_per_mass"]])),
        "assets/",
        "symmetric and positive",
    ),
    "a planned column that does not exist": (
        manifest(lambda m: m["planned"][0].update(column="objects.nothing")),
        "manifest.json",
        "holds no ids",
    ),
    "a planned number that is text": (manifest(lambda m: m["planned"][0].update(count="5")), "manifest.json", "another type"),
    "a verdict of a judge that was not asked": (setting(sapien_stable=True), "scenes/", "sapien_stable is True, expected null"),
    "a robust share of no repetition": (setting(stable_share=1.0), "scenes/", "robust_rest was not asked"),
    "a robot that was not asked": (setting(robot="panda", reach=[]), "scenes/", "robot is 'panda', expected null"),
    "a reply emptied": (
        of_turn(lambda row: row.update(reply='{"objects":[]}')),
        "turns/",
        "which no reply up to this turn proposes",
    ),
    "a reply of another object": (
        of_turn(lambda row: row.update(reply=row["reply"].replace('"objects":[', '"objects":[{"instance":"gone_0"},', 1))),
        "turns/",
        "coarse has no pose of gone_0",
    ),
    "a reply without objects": (
        of_turn(lambda row: row.update(reply="{}")),
        "turns/",
        "reply is no JSON with a list of objects",
    ),
    "a reply that is no JSON": (
        of_turn(lambda row: row.update(reply="yes")),
        "turns/",
        "reply is no JSON with a list of objects",
    ),
    "stages exchanged": (scene(stages_exchanged), "turns/", "as of the turn that proposed it"),
    "an object that is there dropped": (
        of_turn(lambda row: row["dropped"].append({"instance": row["corrected"][0]["instance"], "reason": "no room"})),
        "turns/",
        "which is in corrected",
    ),
    "an object that is there dropped early": (rows("turns", dropped_for_ever), "turns/", "which is in its scene"),
    "a proposed pose far away": (
        of_turn(lambda row: row["coarse"][0].update(position=[9.0, 9.0, 0.0])),
        "turns/",
        "off the table",
    ),
    "a negative friction": (rows("assets", lambda found: found[0].update(friction=[-1.0, 0.0, 0.0])), "assets/", "friction is"),
    "an inertia larger than its box": (rows("assets", larger_inertia), "assets/", "the squared diagonal of its box"),
    "a mass heavier than its volume": (
        rows("assets", lambda found: found[0].update(mass_source="category", mass=1e6)),
        "assets/",
        "by its volume",
    ),
    "points in one place": (rows("assets", one_point), "assets/", "all the same point"),
    "a warning of nothing": (warning_of_nothing, "warnings/", "id is 'gone', which is in no row of"),
    "a failure renamed": (rows("failures", lambda found: found[0].update(id="task_99")), "scenes", "was renamed or exchanged"),
    "planned items edited": (manifest(lambda m: m["planned"][0].update(count=6)), "scenes", "expected the 6 that were planned"),
}
"""Damage of which checksums and digest are made to fit."""

BY_VERDICT: Damages = {
    "floats": (scene(floating), "scenes/", "floats of"),
    "collides": (scene(colliding), "scenes/", "the penetration of"),
    "leaves the table": (scene(outside), "scenes/", "leaves_table of"),
    "is sunk": (scene(sunk), "scenes/", "table_penetration_mm of"),
    "is unsteady": (scene(unsteady), "scenes/", "stable is False, expected True"),
    "verdicts left out where all is accepted": (unjudged_where_all_is_accepted, "scenes/", "stable is null, expected True"),
    "jitters": (setting(jitter_mm=44.0), "scenes/", "jitter_mm is 44.0"),
    "turns": (setting(settle_turn_max_deg=3.5), "scenes/", "settle_turn_max_deg is 3.5"),
    "collides by samples": (setting(oc_sdf=1 / 3), "scenes/", "oc_sdf is"),
    "relations left out": (scene(untold), "scenes/", "face to"),
    "poses edited in all tables": (moved_everywhere, "scenes/", "expected otherwise"),
    "without a mesh": (
        scene(lambda row: (row["verdicts"][0].update(has_mesh=False), row.update(num_without_mesh=1, clean=None))[1]),
        "scenes/",
        "has_mesh of",
    ),
}
"""Damage of which all that follows from it is made to fit too: only a new verdict finds it."""

OF_TEXTURES: Damages = {
    "an image exchanged": (rows("textures", other_image), "textures/", "does not have the hash"),
    "an image exchanged with its hash": (
        rows("textures", exchanged("image", "width", "height")),
        "textures/",
        "does not have the hash",
    ),
    "a texture removed": (rows("textures", without_first, recounts=True), "meshes/", "names the texture"),
    "a texture twice": (rows("textures", doubled, recounts=True), "textures/", "an earlier row has the same sha256"),
    "a size edited": (rows("textures", lambda found: found[0].update(width=7)), "textures/", "pixels, expected 7"),
    "a look exchanged": (rows("meshes", exchanged("look", "look_distance")), "meshes/", "beside its mesh"),
    "an asset removed": (rows("assets", without_first, recounts=True), "assets", "expected the 12 that were planned"),
}

RELATION_OF_NOTHING = {"subject": "ghost_9", "kind": "on", "target": "table"}

OF_FEATURES: Damages = {
    "a feature gone": (rows("features", without_first, recounts=True), "features", "has no feature at the aspect"),
    "a feature of another aspect": (
        rows("features", lambda found: found[0].update(aspect=[1.0, 1.0, 0.2])),
        "features",
        "no scene uses it",
    ),
    "a feature of another size": (
        rows("features", lambda found: found[0].update(log_extents=[0.0, 0.0, 0.0])),
        "features",
        "log_extents at the aspect",
    ),
    "the samples of a further task cut": (
        rows("samples", lambda found: found[:-1], recounts=True),
        "samples/",
        "are of the stages task, important, expected",
    ),
    "a further task of a ghost": (
        rows("samples", lambda found: found[-1]["task"]["task_objects"].append("ghost_9")),
        "samples/",
        "task_objects names ghost_9",
    ),
    "a stage of a further task exchanged": (
        rows("samples", lambda found: found[-1]["objects_out"].clear()),
        "samples/",
        "lack or add",
    ),
}

OF_STAGES: Damages = {
    "an object in another stage": (
        restaged,
        "scenes/",
        "stage of",
    ),
    "a report of an open mesh": (
        rows("assets", each(lambda row: row["report"].update(num_boundary_edges=7))),
        "assets",
        "says num_boundary_edges 7",
    ),
}

OF_SAMPLES: Damages = {
    "a grid of no asset": (rows("sdf", lambda found: found[0].update(asset_id="0" * 32)), "sdf/", "in no row of assets"),
    "shares of splits edited": (
        manifest(lambda m: m["settings"].update(train_share=0.0, validation_share=0.0)),
        "scenes/",
        "split is",
    ),
    "shares of splits that are no numbers": (
        manifest(lambda m: m["settings"].update(seed="abc")),
        "manifest.json",
        "no numbers",
    ),
    "groups of near-duplicates edited": (rows("scenes", regrouped), "scenes/", "duplicate_group is"),
    "no samples": (everywhere("samples", lambda _: []), "samples", "scenes have no sample"),
    "the samples of a shard gone": (rows("samples", lambda _: [], recounts=True), "samples", "scenes have no sample"),
    "a sample gone": (
        rows("samples", without_first, recounts=True),
        "samples/",
        "are of the stages important, secondary, expected",
    ),
    "a sample doubled": (rows("samples", lambda found: [found[0], *found], recounts=True), "samples/", "samples of a task"),
    "a sample that adds nothing": (
        rows("samples", lambda found: next(r for r in found if r["objects_out"]).update(objects_out=[])),
        "samples/",
        "lack or add",
    ),
    "a sample that is given nothing": (
        rows("samples", lambda found: next(r for r in found if r["objects_in"]).update(objects_in=[])),
        "samples/",
        "objects_in is [], expected",
    ),
    "objects of a sample in another order": (
        rows("samples", lambda found: next(r for r in found if len(r["objects_in"]) > 1)["objects_in"].reverse()),
        "samples/",
        "in this order",
    ),
    "another instruction": (
        rows("samples", each(lambda row: row["task"].update(task="Juggle."))),
        "samples/",
        "no samples of its own task",
    ),
    "no grids": (everywhere("sdf", lambda _: []), "sdf", "has no grid at the aspect"),
    "a grid gone": (rows("sdf", without_first, recounts=True), "sdf", "has no grid at the aspect"),
}

TOGETHER: Damages = {
    "a sample edited": (
        rows("samples", lambda found: next(r for r in found if r["objects_out"])["objects_out"][0].update(yaw=0.123)),
        "samples/",
        "is not as in its scene",
    ),
    "a sample of another split": (
        rows("samples", lambda found: found[0].update(split="unseen")),
        "samples/",
        "split is unseen, expected",
    ),
    "a grid cut off": (rows("sdf", lambda found: shorter("values")(found[0])), "sdf/", "its grid has"),
    "a restricted zone edited": (setting(restricted_zone=[0.0, 0.02, 0.0, 0.02]), "scenes/", "restricted_zone is"),
    "a table made longer": (
        scene(lambda row: row.update(table_size=[2 * row["table_size"][0], row["table_size"][1]])),
        "scenes/",
        "table_size is",
    ),
    "a verdict although nobody simulates": (setting(stable=True, settle_move_max_mm=0.0), "scenes/", "mujoco was not asked"),
    "a sample on another table": (
        rows("samples", lambda found: found[0].update(table_size=[9.0, 9.0])),
        "samples/",
        "table_size is [9.0, 9.0], expected",
    ),
    "another goal of the same instruction": (
        rows("samples", lambda found: found[0]["task"].update(goal=["nothing"])),
        "samples/",
        "task.goal is not as in its scene",
    ),
    "a task object that is not there": (
        rows("samples", lambda found: found[0]["task"]["task_objects"].append("ghost_9")),
        "samples/",
        "task_objects names ghost_9",
    ),
    "a relation of what is not there": (
        rows("samples", lambda found: found[0]["task"]["relations"].append(RELATION_OF_NOTHING)),
        "samples/",
        "task names ghost_9",
    ),
    "a grid beside its mesh": (
        rows("sdf", lambda found: found[1].update(origin=[0.0, 0.0, 0.0])),
        "sdf/",
        "its mesh is in the middle",
    ),
    "a grid with other spacings": (
        rows("sdf", lambda found: found[2].update(spacing=2 * found[2]["spacing"])),
        "sdf/",
        "spacing is",
    ),
    "a grid of another unit": (rows("sdf", lambda found: found[3].update(extent=7.0)), "sdf/", "extent is 7.0"),
    **{
        f"a report of another {name}": (
            rows("assets", larger_report(name)),
            "assets/",
            f"its report says {name}",
        )
        for name in ("num_vertices", "area", "volume")
    },
    "a report of both kinds": (
        rows("assets", lambda found: found[0]["report"].update(is_sheet=True, is_solid=True)),
        "assets/",
        "expected one of them",
    ),
    "tilts counted otherwise": (
        rows("assets", lambda found: next(r for r in found if r["resting_tilts"])["resting_tilts"][0].update(count=99)),
        "assets/",
        "resting_tilts counts",
    ),
    "another usual scale": (
        rows("assets", rescaled),
        "assets/",
        "the median of its scales",
    ),
    "an object without its entry": (
        scene(lambda row: row["objects"][0].update(source_json=None)),
        "scenes/",
        "is no object of JSON",
    ),
    "scenes of another dataset": (setting(source="elsewhere"), "scenes/", "source is 'elsewhere'"),
}
"""Damage of a run of preprocess in different places, which is done and found together."""

OF_CORRECTIONS: Damages = {
    "fewer relations kept": (
        rows("corrections", lambda found: found[0].update(directional_kept=found[0]["directional_held"] - 1)),
        "corrections/",
        "relations_kept_directional of its scene is",
    ),
    "more relations kept than held": (
        rows("corrections", lambda found: found[0].update(on_in_kept=99)),
        "corrections/",
        "on_in_kept is 99, expected at most on_in_held",
    ),
    "more relations restored than broken": (
        rows("corrections", lambda found: found[0].update(asked_restored=99)),
        "corrections/",
        "asked_restored is 99",
    ),
    "a share of kept relations edited": (
        setting(relations_kept_directional=0.125),
        "corrections/",
        "relations_kept_directional of its scene is 0.125",
    ),
}
