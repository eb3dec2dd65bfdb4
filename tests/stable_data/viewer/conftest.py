"""A run with odd names, hostile texts, an object without a mesh, and a scene that falls; and one of its pages."""

from dataclasses import replace

import pytest

from stable_data.scene import Relation, RelationKind, Scene, Stage, TaskInfo
from stable_data.simulation.run_reader import SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.viewer.page import run_page
from tests.stable_data.export.runs import EMPTY, at_rest, falling, write_run

HOSTILE = '</script><img src="https://example.org/x.png" onerror="alert(1)">{alert(2)}'
HOSTILE_INSTANCE = "2_<b>_&_</article>_0"


def hostile() -> Scene:
    """A scene whose texts try to be markup."""
    scene = at_rest()
    first, second, third, *others = scene.objects
    objects = (
        replace(first, description=HOSTILE, stage=Stage.TASK),
        replace(second, category="<i>mug", support=None, stage=Stage.SECONDARY),
        replace(third, instance=HOSTILE_INSTANCE, stage=Stage.SECONDARY),
        *(replace(o, stage=Stage.IMPORTANT) for o in others),
    )
    relation = Relation(HOSTILE_INSTANCE, RelationKind.ON, "table")
    task = TaskInfo(HOSTILE, HOSTILE, goal=(HOSTILE,), task_objects=("0_can_0",), relations=(relation,))
    return replace(scene, scene_id="<hostile>", objects=objects, task=task, relations=(relation,))


SCENES = (at_rest(), falling(), EMPTY, hostile())


@pytest.fixture(scope="session")
def viewed_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("viewed") / "run", SCENES)


@pytest.fixture(scope="session")
def page_of_run(viewed_run: RunFolder) -> str:
    content, failures = run_page(viewed_run, SceneSelection())
    assert not failures
    return content.decode()
