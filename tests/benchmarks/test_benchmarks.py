"""The benchmarks: that all of them are started, on any set; what they measure is measured by running them."""

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.audit import readable_scenes
from benchmarks.generalisation import CASES, outcome
from benchmarks.meshes import repaired_meshes
from stable_data.commands.command_line import DONE, NOT_STARTED, SOME_FAILED
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop

FOLDER = Path(benchmarks.__file__).parent


class Commands:
    """Keeps commands instead of running them; the job ends with a status, and so do the benchmarks that are broken."""

    def __init__(self, status: int, broken: Sequence[str] = ()) -> None:
        self.status, self.broken, self.commands = status, broken, list[list[str]]()

    def __call__(self, command: list[str]) -> subprocess.CompletedProcess[str]:
        self.commands.append(command)
        return subprocess.CompletedProcess(command, self.status if command[2] == "pipelines" else command[2] in self.broken)


def started(out: Path, status: int, monkeypatch: pytest.MonkeyPatch, broken: Sequence[str] = ()) -> list[list[str]]:
    commands = Commands(status, broken)
    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", commands)
        patch.setattr(sys, "argv", ["benchmarks", "--data", "data", "--out", str(out)])
        if broken:
            with pytest.raises(SystemExit, match="could not be measured: " + ", ".join(b.partition(".")[2] for b in broken)):
                benchmarks.main()
        else:
            benchmarks.main()
    return commands.commands


@pytest.mark.parametrize("status", [DONE, SOME_FAILED])
def test_every_benchmark_runs_although_some_items_failed(status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job, *rest = started(tmp_path, status, monkeypatch)
    assert job[2:4] == ["pipelines", "preprocess"]
    modules = {f"benchmarks.{path.stem}" for path in FOLDER.glob("*.py") if "__main__" in path.read_text("utf-8")}
    aside = {
        "__main__",
        "leaderboard",
        "paper_tables",
        "policy",
        "replay",
        "same_shard",
        "soak",
    }  # the first ones measure nothing; the others take hours, or need episodes
    assert {command[2] for command in rest} == modules - {f"benchmarks.{name}" for name in aside}


def test_one_that_cannot_be_measured_does_not_keep_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = ("benchmarks.audit", "benchmarks.retrieval")
    less, all_of_them = (started(tmp_path, DONE, monkeypatch, b) for b in (broken, ()))
    assert [command[2] for command in less] == [command[2] for command in all_of_them]


def test_each_time_has_a_run_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (started(tmp_path, DONE, monkeypatch)[0][-1] for _ in range(2))
    assert first != second
    assert [path.name for path in tmp_path.iterdir()] == ["machine.json"]


def test_a_job_that_could_not_start_ends_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit) as caught:
        started(tmp_path, NOT_STARTED, monkeypatch)
    assert caught.value.code == NOT_STARTED


def test_scenes_and_meshes_that_cannot_be_used_are_left_out(tmp_path: Path) -> None:
    write_world(tmp_path, 2, EmbeddedWorld(pictures=False))
    dataset = MesaTaskDataset(tmp_path)
    broken, kept = dataset.scene_ids
    dataset.layout_path(broken).write_text("{")
    assert [scene.scene_id for scene in readable_scenes(MesaTaskDataset(tmp_path))] == [kept]
    library = tmp_path / "few"
    library.mkdir()
    for path in sorted((tmp_path / "Assets_library").glob("*.glb"))[:2]:
        shutil.copy(path, library)
    first, second = sorted(library.iterdir())
    first.write_bytes(first.read_bytes()[:100])
    assert [asset_id for asset_id, _, _ in repaired_meshes(library, 0)] == [second.stem]


def test_a_contradiction_counts_as_followed_only_where_the_scene_holds_it() -> None:
    case = {"instruction": "", "possible": True, "objects": ["mug", "book"], "claims": [["book", "on", "mug"]]}
    things = tuple(SceneObject(f"{name}_0", name, (0.5, 0.3, 0.1), 0.0, (0.1, 0.1, 0.1)) for name in ("mug", "book"))
    held = Scene("one", Tabletop("office_table", (1.0, 0.6)), things, relations=(Relation("book_0", RelationKind.ON, "mug_0"),))
    found = outcome(case, held, [])
    assert (found["made"], found["objects_there"], found["claims_held"], found["said"]) == (True, 2, 1, [])
    inside = replace(held, relations=(Relation("book_0", RelationKind.IN, "mug_0"),))
    assert outcome(case, inside, [])["claims_held"] == 1
    notices = [("not_as_said", "the instruction says what does not hold: book_0 on mug_0"), ("dropped", "book_0 is left out")]
    turned = replace(held, relations=(Relation("mug_0", RelationKind.ON, "book_0"),))
    lost = outcome(case, turned, notices)
    assert (lost["claims_held"], lost["said"]) == (0, ["not_as_said"])
    assert outcome(case, held, notices)["said"] == []  # it holds after all
    glass = {**case, "objects": ["plate", "wine_glass"], "claims": [["plate", "in", "wine_glass"]]}
    in_words = [("not_as_said", "the instruction states relations that do not hold: plate in wine glass")]
    assert outcome(glass, replace(held, relations=()), in_words)["said"] == ["not_as_said"]
    others = [("asset_unmatched", "nothing is like elephant"), ("not_as_said", "what does not hold: cup_0 on mug_0")]
    assert outcome(case, turned, others)["said"] == []  # of other things
    failed = outcome(case, None, [("reply_unusable", "no reply can be used")])
    assert (failed["made"], failed["objects_there"], failed["claims_held"], failed["said"]) == (False, 0, 0, ["reply_unusable"])


def test_claims_count_together_only_if_they_hold_for_one_object_of_each_category() -> None:
    claims = [["mug", "on", "book"], ["book", "on", "mug"]]
    case = {"instruction": "", "possible": False, "objects": ["mug", "book"], "claims": claims}
    names = (("mug_0", "mug"), ("mug_1", "mug"), ("book_0", "book"))
    things = tuple(SceneObject(name, of, (0.5, 0.3, 0.1), 0.0, (0.1, 0.1, 0.1)) for name, of in names)
    on = (Relation("mug_0", RelationKind.ON, "book_0"), Relation("book_0", RelationKind.ON, "mug_1"))
    assert outcome(case, Scene("one", Tabletop("office_table", (1.0, 0.6)), things, relations=on), [])["claims_held"] == 1


def test_contradictory_cases_are_whole() -> None:
    cases = [json.loads(line) for line in CASES.read_text("utf-8").splitlines()]
    assert len(cases) == 20
    assert sum(case["possible"] for case in cases) == 8
    for case in cases:
        assert {name for subject, _, target in case["claims"] for name in (subject, target)} <= set(case["objects"])
        assert all(kind in set(RelationKind) for _, kind, _ in case["claims"])
