"""Scenes of another system are found by the ids of the tasks, also by those that import-scenes makes of paths."""

import json
import shutil
from pathlib import Path

import pytest

from pipelines.sources.layout_files import LayoutFiles
from stable_data.errors import ConfigError, Notice
from stable_data.scene import Scene


@pytest.fixture
def theirs(real_data: Path, tmp_path: Path) -> Path:
    root = tmp_path / "theirs"
    shutil.copytree(real_data, root)
    folders = sorted(path.parent for path in root.glob("Layout_info/*/*/layout.json"))
    names = ("one", "two__scene", "two__scene__shelf_1", "three__shelf_1", "three__shelf_1__scene", "fourth")
    for folder, name in zip(folders, names, strict=False):
        folder.rename(folder.with_name(name))
    for folder in folders[len(names) :]:
        shutil.rmtree(folder)
    return root


def test_the_scene_of_a_task_has_its_id_or_that_of_its_file(theirs: Path) -> None:
    files = LayoutFiles(str(theirs))
    for task, scene_id in (("one", "one"), ("two", "two__scene"), ("fourth", "fourth")):
        found, _ = files.of_task(task)
        assert isinstance(found, Scene)
        assert found.scene_id == scene_id
        assert found.objects


@pytest.mark.parametrize("task", ["three", "four", "two__scene__shelf"])
def test_the_scene_of_another_task_is_not_taken(theirs: Path, task: str) -> None:
    found, _ = LayoutFiles(str(theirs)).of_task(task)
    assert isinstance(found, Notice)
    assert (found.item_id, found.code) == (task, "layout_missing")
    assert found.message.startswith(f"{task}: ")


def test_what_the_reader_remarks_is_told(theirs: Path) -> None:
    layout = next(theirs.glob("Layout_info/*/fourth/layout.json"))
    content = json.loads(layout.read_text())
    content["objects"][0]["rotation"] = [0.0, 0.0, 0.0, 2.0]
    layout.write_text(json.dumps(content))
    found, remarks = LayoutFiles(str(theirs)).of_task("fourth")
    assert isinstance(found, Scene)
    assert {(remark.item_id, remark.code) for remark in remarks} >= {("fourth", "rotation_not_unit")}


def test_a_changed_layout_changes_the_fingerprint(theirs: Path) -> None:
    before = LayoutFiles(str(theirs)).fingerprint
    assert LayoutFiles(str(theirs)).fingerprint == before
    layout = next(theirs.glob("Layout_info/*/fourth/layout.json"))
    layout.write_text(layout.read_text().replace('"size"', '"size" ', 1))
    assert LayoutFiles(str(theirs)).fingerprint != before


def test_what_has_no_scenes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        LayoutFiles(str(tmp_path))
