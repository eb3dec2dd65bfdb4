"""The page of a run: what it contains, that it loads nothing, and that texts of the data stay texts."""

import hashlib
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from stable_data.assets.run_assets import run_store
from stable_data.cli import app
from stable_data.errors import ConfigError, SceneError
from stable_data.export.glb import scene_glb
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.viewer import page as page_module
from stable_data.viewer.camera import view_point
from stable_data.viewer.facts import AssetNotes, SceneFacts
from stable_data.viewer.page import PageScene, html_page, run_page, script
from tests.stable_data.export.runs import EMPTY, at_rest, posed, write_run
from tests.stable_data.viewer.conftest import HOSTILE, HOSTILE_INSTANCE, SCENES
from tests.stable_data.viewer.pages import Page

Z_UP = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
PUBLISHED = "d785423b1d046ea84a9f59ef6cf15f3077603e1bf938b01ced9b0240691884a2"
"""SHA-256 of dist/model-viewer-umd.min.js in @google/model-viewer 4.4.0, as npm publishes it."""


def test_the_script_is_the_published_one() -> None:
    assert hashlib.sha256(script()).hexdigest() == PUBLISHED
    assert b"</script" not in script().lower()
    licence = Path(page_module.__file__).parent / "model_viewer" / "LICENSE"
    assert "Apache License" in licence.read_text("utf-8")


def test_the_page_has_every_scene_and_loads_nothing(page_of_run: str) -> None:
    page = Page(page_of_run)
    assert not page.open
    assert len(page.articles) == len(page.models) == len(SCENES)
    assert [href for href in page.values("href") if not href.startswith("#scene=")] == []
    assert page.values("src", "srcset", "poster", "data", "action", "background") == []
    policy = next(value for value in page.values("content") if "default-src" in value)
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    own = [text for text in page.scripts if "model-viewer" in text and len(text) < 20_000]
    assert len(own) == 1
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|http", own[0])


def test_a_model_is_the_scene_at_its_poses(page_of_run: str, viewed_run: RunFolder) -> None:
    page, store = Page(page_of_run), run_store(viewed_run.uri)
    for number, scene in enumerate(RunScenes(viewed_run)):
        solid = SceneGeometry.of(scene, store)
        assert page.models[number] == scene_glb(solid)
        loaded = trimesh.load(io.BytesIO(page.models[number]), file_type="glb")
        loaded.apply_transform(Z_UP)
        for o in scene.objects:
            world_from_node, geometry = loaded.graph[o.instance]
            corners = trimesh.transform_points(loaded.geometry[geometry].vertices, world_from_node)
            expected = posed(solid, o.instance).vertices
            np.testing.assert_allclose([corners.min(0), corners.max(0)], [expected.min(0), expected.max(0)], atol=1e-6)


def test_labels_lie_on_the_boxes(page_of_run: str, viewed_run: RunFolder) -> None:
    page, scenes = Page(page_of_run), list(RunScenes(viewed_run))
    tops = [[float(value) for value in at.split()] for at in page.values("data-at")]
    expected = [(o.position[0], o.top, -o.position[1]) for scene in scenes for o in scene.objects]
    np.testing.assert_allclose(tops, expected, atol=1e-4)


def test_texts_of_the_data_stay_texts(page_of_run: str) -> None:
    page, number = Page(page_of_run), [scene.scene_id for scene in SCENES].index("<hostile>")
    assert len([tag for tag, _ in page.elements if tag == "script"]) == len(SCENES) + 2
    assert not [tag for tag, _ in page.elements if tag in ("img", "iframe", "object", "embed", "link", "base", "form")]
    assert not [name for _, attributes in page.elements for name in attributes if name.startswith("on")]
    words = " ".join(page.articles[number].split())
    assert words.count(HOSTILE) == 4  # the instruction, the goal, the place, a description
    assert words.count(HOSTILE_INSTANCE) == 2  # an object, a relation
    assert "<hostile>" in words


def test_facts_of_objects_and_verdicts_are_there(page_of_run: str) -> None:
    words = [" ".join(article.split()) for article in Page(page_of_run).articles]
    first = words[0]
    for o in at_rest().objects:
        assert o.instance in first
        assert " × ".join(f"{100 * side:.1f}" for side in o.size) + " cm" in first
    assert "licence CC0 · synth" in first
    assert "no mesh: a box" in first
    assert "Put the can on the plate." in first
    assert "max_penetration_mm0 mm" in first
    assert SCHEMAS["scenes"].field("settle_move_max_mm").metadata[b"meaning"].decode() in first
    assert "settle_move_max_mmunknown" in first
    assert "stable: unknown" in first
    assert "clean" in first
    assert first.count("support unknown") == 0
    assert words[3].count("support unknown") == 1


def test_a_scene_that_was_not_judged_has_unknown_verdicts(viewed_run: RunFolder) -> None:
    geometry = SceneGeometry.of(EMPTY, run_store(viewed_run.uri))
    facts = SceneFacts.of(geometry, AssetNotes(viewed_run))
    text = html_page("one", [PageScene.of(geometry, facts)]).decode()
    assert "all verdicts are unknown" in text
    assert "clean: unknown" in text
    assert 'class="dot unknown"' in text


def test_a_shared_script_is_not_in_the_page(viewed_run: RunFolder) -> None:
    geometry = SceneGeometry.of(EMPTY, run_store(viewed_run.uri))
    scene = PageScene.of(geometry, SceneFacts.of(geometry, AssetNotes(viewed_run)), 'a "title"')
    content = html_page("one", [scene], script_path="../x.js")
    assert len(content) < 300_000
    assert Page(content.decode()).values("src") == ["../x.js"]


def test_the_same_run_gives_the_same_bytes(viewed_run: RunFolder, page_of_run: str) -> None:
    assert run_page(viewed_run, SceneSelection())[0].decode() == page_of_run


def test_a_page_that_is_too_big_is_refused(viewed_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "MAX_PAGE_BYTES", 200_000)
    with pytest.raises(ConfigError, match=r"--limit or --scene, or look at them with --live") as caught:
        run_page(viewed_run, SceneSelection())
    assert caught.value.code == "page_too_big"


def test_a_scene_that_cannot_be_shown_is_a_line(viewed_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def geometry(scenes: RunScenes, scene: object) -> SceneGeometry:
        found = SceneGeometry.of(scene, scenes.store)  # type: ignore[arg-type]
        if found.scene.scene_id == "falling":
            raise SceneError("falling: broken", "broken")
        return found

    monkeypatch.setattr(RunScenes, "geometry", geometry)
    content, failures = run_page(viewed_run, SceneSelection())
    assert failures == ["falling: broken"]
    assert len(Page(content.decode()).articles) == len(SCENES) - 1


def test_the_command_writes_a_page(viewed_run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "new" / "page.html"
    done = CliRunner().invoke(app, ["view", viewed_run.uri, "--page", str(out), "--scene", "falling"])
    assert done.exit_code == 0, done.output
    assert "open it in a browser" in done.output
    assert len(Page(out.read_text("utf-8")).articles) == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--page", "p.html", "--scene", "none"], "has no scenes ['none']"),
        (["--page", "p.html", "--where", "num_objects >"], "num_objects >"),
        (["--page", "p.html", "--where", "num_objects > 99"], "no scene is selected"),
        ([], "either --page FILE.html or --live"),
        (["--page", "p.html", "--live"], "either --page FILE.html or --live"),
    ],
)
def test_what_cannot_be_shown_is_said(viewed_run: RunFolder, options: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["view", viewed_run.uri, *options])
    assert done.exit_code == 2
    assert said in done.output
    assert not Path("p.html").exists()


def test_a_run_without_meshes_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [EMPTY])
    for path in run.files("meshes"):
        Path(path).unlink()
    done = CliRunner().invoke(app, ["view", run.uri, "--page", str(tmp_path / "p.html")])
    assert done.exit_code == 2
    assert "no table meshes" in done.output


def test_rows_are_found_by_number_and_id(viewed_run: RunFolder) -> None:
    scenes = RunScenes(viewed_run)
    names = [scene.scene_id for scene in scenes]
    assert [scenes.row(k)["scene_id"] for k in reversed(range(len(names)))] == names[::-1]
    assert [scenes.number_of(name) for name in names] == list(range(len(names)))
    some = scenes.select(SceneSelection("num_objects >= 2", limit=2))
    assert some.store is scenes.store
    assert some.select(SceneSelection()).annotations is scenes.annotations
    found = [scene.scene_id for scene in some]
    assert [some.number_of(name) for name in found] == [0, 1]
    with pytest.raises(ConfigError, match="not among the 2 selected scenes"):
        some.number_of(next(name for name in names if name not in found))
    with pytest.raises(ConfigError, match="scene number is 2, expected 0 to 1"):
        some.row(2)


def test_what_is_fixed_is_listed_apart_and_a_shelf_is_seen_from_the_side(viewed_run: RunFolder) -> None:
    fixed = frozenset({"0_can_0", "4_can_1"})
    table = replace(at_rest().table, clearance=0.3)
    scene = replace(at_rest(), scene_id="shelf", fixed=fixed, table=table)
    geometry = SceneGeometry.of(scene, run_store(viewed_run.uri))
    html = SceneFacts.of(geometry, AssetNotes(viewed_run)).objects_html()
    movable, surroundings = html.split("<summary>2 fixed in the surroundings</summary>")
    assert "0_<wbr>can_<wbr>0" not in movable
    assert all(name.replace("_", "_<wbr>") in surroundings for name in fixed)
    eyes = [view_point(SceneGeometry.of(s, geometry.store)) for s in (at_rest(), scene)]
    assert eyes[0].target == eyes[1].target
    assert eyes[1].eye[2] < eyes[0].eye[2]
    for view in eyes:
        assert np.linalg.norm(np.subtract(view.eye, view.target)) == pytest.approx(view.distance)


def test_objects_beyond_the_list_are_counted(viewed_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.viewer.facts._LISTED", 2)
    scene = replace(at_rest(), relations=())
    geometry = SceneGeometry.of(scene, run_store(viewed_run.uri))
    assert "4 more are not listed." in SceneFacts.of(geometry, AssetNotes(viewed_run)).html()
