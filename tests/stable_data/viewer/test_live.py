"""The live viewer: a real server; what the browser gets are the nodes and texts that are checked here."""

import socket
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.rotations import wxyz, yaw_quat
from stable_data.scene import Stage
from stable_data.simulation.run_reader import SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.viewer import live
from stable_data.viewer.live import BEFORE, LiveViewer
from tests.stable_data.export.runs import at_rest, falling, write_run
from tests.stable_data.viewer.conftest import SCENES

NAMES = [scene.scene_id for scene in SCENES]


@pytest.fixture
def viewer(viewed_run: RunFolder) -> Iterator[LiveViewer]:
    with LiveViewer(viewed_run) as started:
        yield started


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.02)


def test_a_browser_gets_the_page(viewer: LiveViewer) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=20) as answer:
        assert b"<html" in answer.read().lower()


def test_the_nodes_are_the_objects_at_their_poses(viewer: LiveViewer) -> None:
    scene = next(s for s in SCENES if viewer.geometry is not None and s.scene_id == viewer.geometry.scene.scene_id)
    assert len(viewer.nodes) == len(scene.objects)
    for node, o in zip(viewer.nodes, scene.objects, strict=True):
        np.testing.assert_allclose(node.position, o.position, atol=1e-7)
        np.testing.assert_allclose(node.wxyz, wxyz(yaw_quat(o.yaw)), atol=1e-7)


def test_pages_go_round_and_to_an_id(viewer: LiveViewer) -> None:
    assert viewer.num_scenes == len(NAMES)
    viewer.show(-1)
    assert viewer.number == len(NAMES) - 1
    viewer.show(viewer.number + 1)
    assert viewer.number == 0
    viewer.go_to(" falling ")
    assert viewer.geometry is not None
    assert viewer.geometry.scene.scene_id == "falling"
    viewer.go_to("1")
    assert viewer.number == 0
    for wrong, said in (("nothing", "'nothing' is not among the 4"), ("99", "scene number is 98"), ("0", "scene number is -1")):
        viewer.go_to(wrong)
        assert said in viewer.message
        assert viewer.number == 0
    viewer.show(2)
    assert viewer.message == ""


def test_a_filter_narrows_and_a_wrong_one_is_a_message(viewer: LiveViewer) -> None:
    viewer.filter("num_objects == 2")
    assert viewer.num_scenes == 1
    assert viewer.geometry is not None
    assert viewer.geometry.scene.scene_id == "falling"
    for wrong, said in (
        ("num_objects >", "num_objects >"),
        ("nonsense > 2", "nonsense"),
        ("num_objects > 99", "no scene satisfies"),
    ):
        viewer.filter(wrong)
        assert said in viewer.message
        assert viewer.num_scenes == 1
    viewer.filter("")
    assert viewer.message == ""
    assert viewer.num_scenes == len(NAMES)


def test_a_filter_stays_within_the_choice(viewed_run: RunFolder) -> None:
    with LiveViewer(viewed_run, SceneSelection(scene_ids=("falling", NAMES[0]))) as viewer:
        assert viewer.num_scenes == 2
        viewer.filter("num_objects >= 0")
        assert viewer.num_scenes == 2
        viewer.go_to("empty")
        assert "'empty' is not among the 2" in viewer.message


def test_stages_colliders_and_labels_are_shown_and_hidden(viewer: LiveViewer) -> None:
    viewer.go_to("<hostile>")
    scene = next(s for s in SCENES if s.scene_id == "<hostile>")
    viewer.show_parts(True)
    viewer.show_stages([stage for stage in Stage if stage is not Stage.SECONDARY])
    for node, o in zip(viewer.nodes, scene.objects, strict=True):
        assert node.visible is (o.stage is not Stage.SECONDARY)
    assert viewer.num_parts == len(scene.objects)
    viewer.show_parts(False)
    viewer.show_stages(list(Stage))
    assert all(node.visible for node in viewer.nodes)
    assert viewer.message == ""


def test_a_step_moves_what_falls_and_reset_puts_it_back(viewer: LiveViewer) -> None:
    viewer.go_to("falling")
    start = [np.array(node.position) for node in viewer.nodes]
    viewer.step(100)
    moves = [float(np.linalg.norm(np.array(node.position) - was)) for node, was in zip(viewer.nodes, start, strict=True)]
    assert moves[0] > 2e-3  # the can
    assert moves[1] < 1e-3  # the mug stands
    viewer.reset()
    for node, was in zip(viewer.nodes, start, strict=True):
        np.testing.assert_allclose(node.position, was, atol=1e-9)


def test_play_runs_until_pause(viewer: LiveViewer) -> None:
    viewer.go_to("falling")
    start = np.array(viewer.nodes[0].position)
    viewer.play()
    wait_for(lambda: float(np.linalg.norm(np.array(viewer.nodes[0].position) - start)) > 2e-3)
    viewer.pause()
    stays = np.array(viewer.nodes[0].position)
    time.sleep(0.2)
    np.testing.assert_array_equal(viewer.nodes[0].position, stays)
    assert viewer.message == ""


def test_an_empty_scene_has_physics_too(viewer: LiveViewer) -> None:
    viewer.go_to("empty")
    viewer.step()
    assert viewer.message == ""
    assert viewer.nodes == []


@pytest.mark.parametrize("table", ["turns", "corrections"])
def test_poses_before_the_correction(table: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    scene = at_rest()
    run = write_run(tmp_path_factory.mktemp("before") / "run", [scene, falling()])
    moved: list[Row] = [
        {"instance": o.instance, "position": [o.position[0] + 0.1, *o.position[1:]], "yaw": o.yaw + 0.5} for o in scene.objects
    ]
    blank = dict.fromkeys(SCHEMAS[table].names) | {"scene_id": scene.scene_id}
    later = [pose | {"position": [9.0, 9.0, 9.0]} for pose in moved]
    rows = [blank | {"start": moved[:-1]}]
    if table == "turns":
        wrong = blank | {"turn": 0, "code": "refused", "coarse": later}
        rows = [
            blank | {"turn": 2, "code": "", "coarse": later[:-1]},
            blank | {"turn": 1, "code": "", "coarse": moved[:-1]},
            wrong,
        ]
    run.write_shard(table, "0" * 16, rows)
    with LiveViewer(run) as viewer:
        viewer.go_to(scene.scene_id)
        viewer.set_poses(BEFORE)
        assert viewer.message == ""
        for node, o, pose in zip(viewer.nodes[:-1], scene.objects[:-1], moved[:-1], strict=True):
            np.testing.assert_allclose(node.position, pose["position"], atol=1e-7)
            np.testing.assert_allclose(node.wxyz, wxyz(yaw_quat(o.yaw + 0.5)), atol=1e-7)
        np.testing.assert_allclose(viewer.nodes[-1].position, scene.objects[-1].position)
        viewer.go_to("falling")
        assert "does not store its poses before the correction" in viewer.message
        assert viewer.geometry is None
        viewer.step()
        assert "nothing to simulate" in viewer.message
        viewer.set_poses(live.AFTER)
        assert viewer.message == ""


def test_a_port_in_use_is_refused(viewed_run: RunFolder) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"port {port} of 127.0.0.1 is in use.*--port 0") as caught:
            LiveViewer(viewed_run, port=port)
        assert caught.value.code == "port_in_use"
        done = CliRunner().invoke(app, ["view", viewed_run.uri, "--live", "--port", str(port)])
        assert done.exit_code == 2
        assert f"error: port {port}" in done.output


def test_an_address_of_another_machine_is_refused(viewed_run: RunFolder) -> None:
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1:0 cannot be used"):
        LiveViewer(viewed_run, host="192.0.2.1")


def test_a_missing_extra_is_named(viewed_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "stable_data.viewer.live")
    done = CliRunner().invoke(app, ["view", viewed_run.uri, "--live"])
    assert done.exit_code == 2
    assert "needs viser, which is not installed: pip install 'stable-data[geometry,sim,view]'" in done.output


def test_a_viewer_ends_with_its_threads(viewed_run: RunFolder) -> None:
    with LiveViewer(viewed_run):
        assert "physics" in {thread.name for thread in threading.enumerate()}
    assert "physics" not in {thread.name for thread in threading.enumerate()}
