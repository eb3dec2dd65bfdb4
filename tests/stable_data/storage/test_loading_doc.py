"""docs/loading.md as written, on a tiny run: our loader, and readers that have none of our code."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from stable_data.metrics.card import MetricCard
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import card_row, scene_from_row, scene_row

DOC = Path(__file__).parents[3] / "docs" / "loading.md"
CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)


def scene(number: int) -> Scene:
    cups = tuple(
        SceneObject(f"{k}_cup_0", "cup", (0.1 * k, 0.2, 0.05), 0.3 * k, (0.1, 0.1, 0.1), scale=(1.0, 1.0, 2.0) if k else None)
        for k in range(number % 3)
    )
    task = TaskInfo("An office.", "Tidy up.") if number % 2 else None
    relations = (Relation("0_cup_0", RelationKind.ON, "table"),) * (number % 2)
    return Scene(f"scene-{number:03}", Tabletop("office_table", (1.2, 0.6)), cups, task, relations)


SCENES = [scene(number) for number in range(70)]
IDS = [s.scene_id for s in SCENES]


def split_of(scene: Scene) -> str:
    return "validation" if scene.scene_id.endswith("7") else "train"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A run whose middle shard has no rows, as where no scene of a shard could be used."""
    folder = RunFolder(str(tmp_path_factory.mktemp("loading") / "run"))
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "pairs": [], "verdicts": []} | card_row(CARD)
    for number, part in enumerate([SCENES[:30], [], SCENES[30:]]):
        folder.write_shard("scenes", f"{number:016x}", [blank | scene_row(s) | {"split": split_of(s)} for s in part])
    return folder.uri


def code(word: str) -> str:
    [block] = [block for block in re.findall(r"```python\n(.*?)```", DOC.read_text(), re.DOTALL) if word in block]
    return str(block)


def test_the_documented_training_job_runs(run: str, tmp_path: Path) -> None:
    """As a program of its own: the threads of other tests cannot hold a lock when the loader forks."""
    block = code("TableStream")
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    num_rows = sum(split_of(s) == "train" for s in SCENES)
    checks = [
        f"assert scenes.num_rows == {num_rows}",
        "assert loss.isfinite()",
        f"assert {{int(optimizer.state[p]['step']) for p in policy.parameters()}} == {{{-(-num_rows // 32)}}}",
    ]
    program = tmp_path / "train.py"
    program.write_text("\n".join([f"RUN = {run!r}", block, *checks]), "utf-8")
    subprocess.run([sys.executable, program], check=True, timeout=240)


def test_polars_opens_the_tables(run: str) -> None:
    names: dict[str, Any] = {"RUN": run}
    exec(code("polars"), names)  # noqa: S102
    assert names["scenes"].collect()["scene_id"].to_list() == IDS
    objects = names["objects"].drop_nulls("instance")
    assert objects["position"].to_list() == [list(o.position) for s in SCENES for o in s.objects]


@pytest.mark.filterwarnings("ignore")
def test_hugging_face_datasets_open_the_tables(run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip("datasets")
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path)
    names: dict[str, Any] = {"RUN": run}
    exec(code("load_dataset"), names)  # noqa: S102
    assert [row["scene_id"] for row in names["rows"]] == IDS
    assert [scene_from_row(row) for row in names["rows"]] == SCENES


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore")
def test_ray_data_opens_the_tables(run: str) -> None:
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=1, include_dashboard=False, ignore_reinit_error=True, log_to_driver=False)
    try:
        names: dict[str, Any] = {"RUN": run}
        exec(code("import ray"), names)  # noqa: S102
        rows = names["some"]
    finally:
        ray.shutdown()
    assert sorted(row["scene_id"] for row in rows) == IDS
    positions = {row["scene_id"]: [list(o["position"]) for o in row["objects"]] for row in rows}
    assert positions == {s.scene_id: [list(o.position) for o in s.objects] for s in SCENES}


def test_the_documented_scenes_by_id_are_found(run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names: dict[str, Any] = {"RUN": run, "SCENE_ID": IDS[40], "OTHER_ID": IDS[2]}
    exec(code("SceneIndex"), names)  # noqa: S102
    assert [s.scene_id for s in names["scenes"]] == [IDS[40], IDS[2]]
    assert names["scene"] == names["scenes"][0]
    assert names["columns"].column_names == ["num_objects", "stable"]
    assert names["missing"] == ["no such scene"]
