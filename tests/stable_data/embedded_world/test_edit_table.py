"""Drafted edits: rows that say what changes and nothing else, true of every kind, and written shard by shard."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.embedded_world.drafting import DRAFTERS, KINDS, SceneEditor
from stable_data.embedded_world.edit_table import edit_rows, write_edits
from stable_data.embedded_world.edits import place_as_settled
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.embedded_world.groups.arrangement import GroupItem, GroupSampler
from stable_data.embedded_world.placing import PlacedObject
from stable_data.embedded_world.scenes import EmbeddedScene, graph_of
from stable_data.embedded_world.settling import audit, unclean_objects
from stable_data.errors import SceneError
from stable_data.instructions.naming import ObjectNamer
from stable_data.scene import Scene, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import arrow_table, object_from_row, scene_from_row
from tests.stable_data.embedded_world.edit_scenes import made_scenes, row_of

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def made() -> list[EmbeddedScene]:
    return made_scenes(2, 4, 5)


@pytest.fixture(scope="module")
def rows(made: list[EmbeddedScene]) -> list[Row]:
    return [row_of(one) for one in made]


@pytest.fixture(scope="module")
def drafted(rows: list[Row]) -> list[Row]:
    return [edit for row in rows for edit in edit_rows(row, 10)]


def after(edit: Row, scene: Scene) -> Scene:
    """The scene that a row of ``edits`` ends with."""
    new = {o["instance"]: object_from_row(o) for o in edit["objects_out"]}
    kept = [new.pop(o.instance, o) for o in scene.objects if o.instance not in edit["removed"]]
    return replace(scene, objects=(*kept, *new.values()))


def test_every_kind_is_drafted(drafted: list[Row]) -> None:
    assert {edit["kind"] for edit in drafted} == set(KINDS)
    assert len({edit["edit_id"] for edit in drafted}) == len(drafted)


def test_rows_fit_the_table(drafted: list[Row]) -> None:
    table = arrow_table("edits", drafted)
    assert table.num_rows == len(drafted)
    for edit, back in zip(drafted, table.to_pylist(), strict=True):
        for column in ("objects_in", "objects_out"):
            assert [object_from_row(o) for o in back[column]] == [object_from_row(o) for o in edit[column]]


def test_a_row_says_what_its_kind_does(drafted: list[Row]) -> None:
    for edit in drafted:
        before = {o["instance"]: object_from_row(o) for o in edit["objects_in"]}
        out = [object_from_row(o) for o in edit["objects_out"]]
        new = [o for o in out if o.instance not in before]
        changed = [o for o in out if o.instance in before]
        assert all(o != before[o.instance] for o in changed)
        assert set(edit["removed"]) <= set(before)
        counts = {"add": (1, 0, 0), "remove": (0, 0, 1), "replace": (1, 0, 1), "move": (0, 1, 0)}
        if edit["kind"] in counts:
            assert (len(new), len(changed), len(edit["removed"])) == counts[edit["kind"]]
        else:
            assert any(o.asset_id != before[o.instance].asset_id for o in changed)
        if edit["kind"] == "move":
            assert changed[0].asset_id == before[changed[0].instance].asset_id
        assert edit["instruction"][0].isupper()
        assert not set("[]{}|") & set(edit["instruction"])


@pytest.mark.slow
def test_what_is_drafted_is_mostly_clean_as_it_was_lowered(rows: list[Row], drafted: list[Row]) -> None:
    scenes = {row["scene_id"]: scene_from_row(row) for row in rows}
    keys = {asset(key).uid: key for key in KEYS}
    clean = []
    for edit in drafted[::4]:
        scene = after(edit, scenes[edit["scene_id"]])
        placed = [_placed(o.asset_id, o.scale, keys) for o in scene.objects]
        clean.append(not unclean_objects(audit(scene, placed)))
    assert np.mean(clean) > 0.8


def _placed(asset_id: str | None, scale: tuple[float, float, float] | None, keys: dict[str, str]) -> PlacedObject:
    assert asset_id is not None
    assert scale is not None
    key = keys[asset_id]
    x, y, z = (s / asset(key).unit for s in scale)
    return PlacedObject(GroupItem(key, scale=(x, y, z)))


def test_the_same_scene_has_the_same_edits_and_another_seed_others(rows: list[Row]) -> None:
    one, again, other = edit_rows(rows[0], 4), edit_rows(rows[0], 4), edit_rows(rows[0], 4, seed=1)
    assert one == again
    assert [edit["instruction"] for edit in one] != [edit["instruction"] for edit in other]
    assert edit_rows(rows[0], 2) == one[:2]


def test_a_scene_of_elsewhere_is_refused(rows: list[Row]) -> None:
    with pytest.raises(SceneError, match="use a scene that stable-data synth made") as caught:
        edit_rows(rows[0] | {"source_json": None})
    assert caught.value.code == "not_synth"
    with pytest.raises(SceneError, match="expected the assets of its"):
        edit_rows(rows[0] | {"objects": rows[0]["objects"][:-1]})


def test_a_table_without_room_ends_the_search(made: list[EmbeddedScene]) -> None:
    one = made[0]
    width, depth = one.scene.table.size_xy
    full = replace(one.scene, table=Tabletop(one.scene.table.table_type, (width, depth), (0.0, width, 0.0, depth)))
    things = {o.instance: place_as_settled(thing, o) for o, thing in zip(one.scene.objects, one.placed, strict=True)}
    graph = graph_of(one.scene, audit(one.scene, one.placed), one.placed)
    carriers = frozenset(things)  # nothing can be put on anything either
    desk = SceneEditor(full, things, ObjectNamer(full, graph), GroupSampler(np.random.default_rng(0)), carriers)
    assert list(DRAFTERS["add"](desk)) == []


def _run(root: Path, rows: list[Row]) -> RunFolder:
    folder = RunFolder(str(root))
    blank = dict.fromkeys(SCHEMAS["scenes"].names)
    for k, row in enumerate(rows):
        folder.write_shard("scenes", f"{k:016d}", [blank | row])
    return folder


def test_shards_that_are_there_are_left_alone(rows: list[Row], tmp_path: Path) -> None:
    run = _run(tmp_path / "run", rows[:2])
    out = RunFolder(str(tmp_path / "out"))
    first = list(write_edits(run, out, count=2))
    assert [(count, failed) for count, failed in first] == [(2, []), (2, [])]
    written = {path: Path(path).read_bytes() for path in out.files("edits")}
    Path(out.files("edits")[0]).unlink()
    assert sorted(count for count, _ in write_edits(run, out, count=2)) == [0, 2]
    assert {path: Path(path).read_bytes() for path in out.files("edits")} == written


def test_the_command_tells_of_scenes_that_have_no_edits(rows: list[Row], tmp_path: Path) -> None:
    run = _run(tmp_path / "run", [rows[0], rows[1] | {"source_json": None}])
    done = CliRunner().invoke(app, ["draft-edits", run.uri, "--per-scene", "2"])
    assert done.exit_code == 1
    assert "2 edits added, 1 scenes without edits; 2 rows in total" in done.output
    assert rows[1]["scene_id"] in done.output
