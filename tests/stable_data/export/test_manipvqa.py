"""The detection task: boxes of handles in pictures of scenes, scored as a detector's answers are."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from stable_data.assets.store import AssetStore
from stable_data.cli import app
from stable_data.export.exporter import export_run
from stable_data.export.manipvqa import QUESTIONS_FILE, SIZE, handle_boxes, question_about
from stable_data.scene import Scene
from stable_data.scores.detection import DetectedBox, read_labels, score_detections
from stable_data.simulation.offscreen import can_render
from stable_data.simulation.run_reader import SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import EMPTY, TABLE, falling, thing

pytestmark = pytest.mark.skipif(not can_render(), reason="this machine cannot render")


def geometry(store: AssetStore, *objects: tuple[str, float, float, float]) -> SceneGeometry:
    made = tuple(thing(key, f"{k}_{key.split('/')[0]}_0", x, y, 0.0, yaw) for k, (key, x, y, yaw) in enumerate(objects))
    return SceneGeometry.of(Scene("s", TABLE, made), store)


def test_a_handle_that_faces_the_camera_is_seen_whole(store: AssetStore) -> None:
    [found] = handle_boxes(geometry(store, ("mug/0", 0.6, 0.2, np.pi)))  # its handle to the left, where the camera is
    left, top, right, bottom = found.box
    assert (found.instance, found.category, found.visible) == ("0_mug_0", "mug", 1.0)
    assert 0 <= left < right <= SIZE
    assert 0 <= top < bottom <= SIZE
    assert found.pixels <= (right - left) * (bottom - top)


def test_a_handle_behind_its_mug_or_another_thing_is_hidden(store: AssetStore) -> None:
    assert list(handle_boxes(geometry(store, ("mug/0", 0.6, 0.2, np.pi / 4)))) == []  # behind its mug
    free, box = ("mug/0", 0.7, 0.4, np.pi), ("cereal_box/0", 0.6, 0.3, -np.pi / 4)
    [alone], hidden = list(handle_boxes(geometry(store, free))), list(handle_boxes(geometry(store, free, box)))
    assert alone.visible == 1.0
    assert sum(found.pixels for found in hidden) < alone.pixels


def test_scenes_without_a_handle_have_no_box(store: AssetStore) -> None:
    assert list(handle_boxes(geometry(store, ("plate/0", 0.5, 0.4, 0.0)))) == []
    assert list(handle_boxes(geometry(store))) == []


def test_the_export_has_pictures_boxes_and_questions_that_can_be_scored(run: RunFolder, tmp_path: Path) -> None:
    result = export_run(run, tmp_path, "manipvqa", SceneSelection())
    assert (result.num_written, result.failures, result.warning) == (3, (), None)
    contents = [json.loads(path.read_text()) for path in sorted((tmp_path / "boxes").iterdir())]
    assert [len(found["handles"]) for found in contents if found["scene_id"] == falling().scene_id] == [1]
    for content in contents:
        with Image.open(tmp_path / content["image"]) as image:
            assert image.size == (SIZE, SIZE)
    questions = json.loads((tmp_path / QUESTIONS_FILE).read_text())
    assert questions
    assert {asked["conversations"][0]["value"] for asked in questions} == {question_about("mug")}
    labels = read_labels(tmp_path / QUESTIONS_FILE)
    assert {label.size for label in labels} == {(SIZE, SIZE)}
    right = [DetectedBox(label.image, label.category, label.box) for label in labels]
    assert [score.precision for score in score_detections(labels, right)] == [{0.5: 1.0, 0.75: 1.0}]
    wrong = [replace(box, box=(0.0, 0.0, 0.01, 0.01)) for box in right]
    assert [score.precision for score in score_detections(labels, wrong)] == [{0.5: 0.0, 0.75: 0.0}]


def test_an_interrupted_export_asks_for_all_scenes_in_the_end(run: RunFolder, tmp_path: Path) -> None:
    export_run(run, tmp_path, "manipvqa", SceneSelection())
    whole = (tmp_path / QUESTIONS_FILE).read_bytes()
    next((tmp_path / "boxes").glob("falling*")).unlink()
    (tmp_path / QUESTIONS_FILE).unlink()
    again = export_run(run, tmp_path, "manipvqa", SceneSelection())
    assert (again.num_written, again.num_existing) == (1, 2)
    assert (tmp_path / QUESTIONS_FILE).read_bytes() == whole


def test_two_of_a_category_in_a_picture_are_not_asked_for(store: AssetStore, tmp_path: Path) -> None:
    from stable_data.export import manipvqa

    two = geometry(store, ("mug/0", 0.4, 0.2, np.pi), ("mug/0", 0.8, 0.2, np.pi))
    manipvqa.export_scene(two, tmp_path)
    warning = manipvqa.finish(tmp_path)
    assert warning is not None
    assert "0 questions about 1 pictures: of the 2 handles that are seen, none is the only one of its category" in warning
    assert json.loads((tmp_path / QUESTIONS_FILE).read_text()) == []
    assert len(json.loads((tmp_path / "boxes" / "s.json").read_text())["handles"]) == 2


def test_an_export_without_handles_warns_that_it_asks_nothing(run: RunFolder, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["export", run.uri, str(tmp_path), "--format", "manipvqa", "--scene", EMPTY.scene_id])
    assert done.exit_code == 0, done.output
    assert "warning: manipvqa.json has 0 questions about 1 pictures: no handle is seen" in done.output
    assert json.loads((tmp_path / QUESTIONS_FILE).read_text()) == []
