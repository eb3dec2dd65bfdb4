"""The set on disk: read back as made, gone on with where it was stopped, refused where it is something else."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import DatasetCard

from pipelines.execution.ray_executor import WorkerPool
from pipelines.synth.job import synth
from stable_data.embedded_world import EmbeddedWorld, scenes, world, write_world
from stable_data.embedded_world.families.catalogue import KEYS, asset
from stable_data.embedded_world.scenes import make_scene, scene_id_of
from stable_data.embedded_world.statistics import SceneCounts, count_scene, scenes_with_duplicates
from stable_data.embedded_world.world import TABLE_UID
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.layout import read_layout

pytestmark = pytest.mark.sim

NUM_WRITTEN = 3
SMALL = EmbeddedWorld(seed=2, pictures=False, edits=True, whole_library=False)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("embedded")
    assert write_world(out, NUM_WRITTEN, SMALL) == []
    return out


def _content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_written_set_reads_back_as_made(written: Path) -> None:
    dataset = MesaTaskDataset(written)
    assert len(dataset.scene_ids) == NUM_WRITTEN
    for number in range(NUM_WRITTEN):
        made = make_scene(number, SMALL.seed).scene
        scene, notices = dataset.read(next(s for s in dataset.scene_ids if scene_id_of(number) in s))
        assert not notices
        assert scene.table.size_xy == pytest.approx(made.table.size_xy, abs=1e-12)
        assert (scene.table.restricted_zone or ()) == pytest.approx(made.table.restricted_zone or (), abs=1e-12)
        np.testing.assert_allclose(scene.poses(), made.poses(), atol=1e-12)
        assert [o.asset_id for o in scene.objects] == [o.asset_id for o in made.objects]
        assert scene.task is not None
        assert made.task is not None
        assert scene.task.task == made.task.task
        assert set(scene.task.task_objects) == set(made.task.task_objects)


def test_written_set_has_the_format_s_files(written: Path) -> None:
    annotations = json.loads((written / "Asset_annotation.json").read_text())
    assert annotations[TABLE_UID]["onTable"] is False
    assert {path.stem for path in (written / "Assets_library").iterdir()} == set(annotations)
    layout = json.loads((written / "Layout_info/bathroom_vanity/bathroom_vanity_00000/layout.json").read_text())
    assert len(layout["restricted_zone"]) == 4
    for entry, key in zip(layout["objects"], layout[scenes.RECORD]["keys"], strict=True):
        assert len(entry["original_size"]) == len(entry["scale_factor"]) == 3
        about = annotations[entry["retrieved_uid"]]
        assert about["isContainer"] is (asset(key).hollow is not None)
        assert len(about["captions"]) >= 3


def test_the_card_is_one_that_hugging_face_reads(written: Path) -> None:
    card = DatasetCard.load(written / "README.md")
    assert (card.data.license, card.data.size_categories, card.data.task_categories) == ("apache-2.0", ["n<1K"], ["robotics"])
    assert "objects per scene, mean" in card.text
    assert "## Limits" in card.text


def test_edits_change_what_they_say_and_nothing_else(written: Path) -> None:
    rows = [json.loads(line) for line in (written / "edits.jsonl").read_text().splitlines()]
    assert len(rows) == NUM_WRITTEN
    for row in rows:
        table_type = row["scene_id"].rsplit("_", 1)[0]
        before, after = (
            read_layout(json.loads((written / folder / table_type / name / "layout.json").read_text()), name, table_type)[0]
            for folder, name in (("Layout_info", row["scene_id"]), ("Edit_info", row["edited"]))
        )
        old, new = ({o.instance: o for o in scene.objects} for scene in (before, after))
        assert set(new) - set(old) == set(row["added"])
        assert set(old) - set(new) == set(row["removed"])
        changed = {name for name in set(old) & set(new) if replace(old[name], source=None) != replace(new[name], source=None)}
        assert changed == set(row["moved"])
        assert row["added"] or row["removed"] or row["moved"]


def test_second_run_leaves_what_is_there_and_adds_what_is_missing(written: Path) -> None:
    before = _content(written)
    missing = written / "Layout_info/coffee_table/coffee_table_00001"
    for path in missing.iterdir():
        path.unlink()
    kept = written / "Layout_info/bathroom_vanity/bathroom_vanity_00000/layout.json"
    stamp = kept.stat().st_mtime_ns
    done: list[int] = []
    assert write_world(written, NUM_WRITTEN, SMALL, progress=done.append) == []
    assert kept.stat().st_mtime_ns == stamp
    assert done == [1, 2, 3]
    assert _content(written) == before


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_many_workers_write_the_same(written: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    assert synth(tmp_path / "out", NUM_WRITTEN, SMALL, WorkerPool(2), lambda k, n: told.append((k, n))) == []
    assert _content(tmp_path / "out") == _content(written)
    assert told == [(NUM_WRITTEN, 0)]


def test_whole_library_is_every_asset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "KEYS", KEYS[:5])
    world.open_world(tmp_path, 1, EmbeddedWorld(whole_library=True))
    annotations = json.loads((tmp_path / "Asset_annotation.json").read_text())
    assert {asset(key).uid for key in KEYS[:5]} < set(annotations)
    assert len(annotations) == 7


@pytest.mark.parametrize(
    ("other", "change"), [(EmbeddedWorld(seed=3), "seed: 2 -> 3"), (replace(SMALL, edits=False), "edits: True -> False")]
)
def test_other_settings_in_the_same_folder_are_refused(written: Path, other: EmbeddedWorld, change: str) -> None:
    with pytest.raises(ConfigError, match=change) as caught:
        write_world(written, NUM_WRITTEN, other)
    assert caught.value.code == "config_changed"


def test_folder_that_holds_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("dear")
    with pytest.raises(ConfigError, match="contains other files") as caught:
        write_world(tmp_path, 1)
    assert caught.value.code == "not_a_world"
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("content", ["{", "[]"])
def test_manifest_that_is_none_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "synth.json").write_text(content)
    with pytest.raises(ConfigError, match="choose another folder"):
        write_world(tmp_path, 1)


def test_count_and_seed_below_the_least_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="number of scenes is 0"):
        write_world(tmp_path, 0)
    with pytest.raises(ConfigError, match="seed is -1"):
        EmbeddedWorld(seed=-1)
    with pytest.raises(ConfigError, match="table is 'bar'"):
        EmbeddedWorld(tables=("bar",))


def test_scene_that_fails_is_recorded_and_the_others_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = make_scene

    def first_fails(number, *rest):  # type: ignore[no-untyped-def]
        if number == 0:
            monkeypatch.setattr(scenes, "_ATTEMPTS", 0)
            try:
                return real(number, *rest)
            finally:
                monkeypatch.setattr(scenes, "_ATTEMPTS", 30)
        return real(number, *rest)

    monkeypatch.setattr(world, "make_scene", first_fails)
    failures = write_world(tmp_path, 2, SMALL)
    assert [error.code for error in failures] == ["synth_failed"]
    kept = json.loads((tmp_path / "synth_failures/bathroom_vanity_00000.json").read_text())
    assert "bathroom_vanity_00000" in kept["message"]
    assert len(MesaTaskDataset(tmp_path)) == 1


def test_near_duplicates_are_the_same_things_in_the_same_places(written: Path) -> None:
    dataset = MesaTaskDataset(written)
    found = [count_scene(dataset.read(scene_id)[0]) for scene_id in dataset.scene_ids]
    assert scenes_with_duplicates(found) == frozenset()
    one: SceneCounts = found[0]
    close = replace(one, scene_id="close", positions=one.positions + 0.01)
    far = replace(one, scene_id="far", positions=one.positions + np.array([0.03, 0.0, 0.0]))
    assert scenes_with_duplicates([one, close, far]) == {one.scene_id, "close"}
