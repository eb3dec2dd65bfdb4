"""The propose job: each task is a scene or a failure, in a folder that the other jobs take; a rerun does what is missing."""

import csv
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from typer.testing import CliRunner

import pipelines.propose.job as job
from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.factory import load_reasoner
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.propose.job import propose
from pipelines.propose.settings import ProposeSettings
from pipelines.propose.shard import Proposer
from pipelines.settings import resolve
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.tasks import read_tasks
from stable_data.assets.assignment import assign_assets
from stable_data.assets.ranking import RetrievalSettings
from stable_data.errors import ConfigError, Notice
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Scene, SceneObject, Stage, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.pipelines.scripts import entry

GOOD = {"instruction": "Lift it.", "table_type": "office_table", "table_size_cm": [120, 60]}

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def shelf(dataset: Path, own_cache: None) -> AssetLibraries:
    return AssetLibraries([str(dataset)])


def scripted(folder: Path, shelf: AssetLibraries, **more: Any) -> ProposeSettings:
    """An engine that answers each stage with one thing, but for some words."""
    first, second, third = shelf.libraries[0].assets[1:4]
    odd = entry(first, 60.0, "elephant_0", "an elephant with a trunk as long as a river")
    carried = {**entry(second, 60.0), "position": [60.0, 30.0, 8.0 + odd["size"][2]]}
    script = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        "Say nothing": {"objects": []},
        "Lift the elephant": {"objects": [odd]},
        f"an elephant{WANTED[Stage.IMPORTANT]}": {"objects": [odd, carried]},
        WANTED[Stage.TASK]: {"objects": [entry(first, 20.0)]},
        WANTED[Stage.IMPORTANT]: {"objects": [entry(second, 60.0)]},
        WANTED[Stage.SECONDARY]: {"objects": [entry(third, 100.0)]},
    }
    path = folder / "script.json"
    path.write_text(json.dumps(script))
    return ProposeSettings(EngineSettings(f"scripted:{path}"), scenes_per_shard=2, **more)


def task_file(folder: Path, rows: Sequence[Any]) -> Path:
    path = folder / "tasks.jsonl"
    path.write_text("".join(f"{row if isinstance(row, str) else json.dumps(row)}\n" for row in rows))
    return path


def rows_of(out: Path, table: str) -> list[Row]:
    found: list[Row] = RunFolder(str(out)).table(table).to_pylist()
    return found


def files(out: Path) -> dict[str, bytes]:
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file() and p.name != ".lock"}


def test_each_task_is_a_scene_or_a_failure(dataset: Path, shelf: AssetLibraries, tmp_path: Path) -> None:
    rows = [
        GOOD,
        "no JSON",
        {**GOOD, "scene_id": "mine", "restricted_zone_cm": [0, 40, 40, 60]},
        {**GOOD, "scene_id": "mine"},
        {**GOOD, "scene_id": "../mine"},
        {**GOOD, "instruction": " "},
        {**GOOD, "instruction": "word " * 500},
        {**GOOD, "instruction": "Say nonsense"},
        {**GOOD, "instruction": "Lift the elephant"},
        {**GOOD, "table_size_cm": [120]},
        {**GOOD, "table_type": "a/b"},
        {**GOOD, "colour": "red"},
        {**GOOD, "instruction": "Say nothing"},
    ]
    settings, tasks, out = scripted(tmp_path, shelf, num_pictures=1), task_file(tmp_path, rows), tmp_path / "out"
    manifest = propose(tasks, str(out), settings, [str(dataset)])
    failures = {row["id"]: row["code"] for row in rows_of(out, "failures")}
    assert failures == {
        "row 000002": "task_invalid",
        "row 000004": "task_invalid",
        "row 000005": "task_invalid",
        "row 000006": "instruction_invalid",
        "task_000007": "instruction_invalid",
        "task_000008": "reply_unusable",
        "task_000009": "asset_unmatched",
        "row 000010": "table_invalid",
        "row 000011": "table_invalid",
        "row 000012": "task_invalid",
        "task_000013": "layout_empty",
    }
    assert manifest["counts"]["scenes"] + len(failures) == manifest["num_tasks"] == len(rows)
    made = MesaTaskDataset(out / "dataset")
    assert made.scene_ids == ("mine", "task_000001")
    wanted = shelf.libraries[0].assets[1:4]
    for scene_id in made.scene_ids:
        scene, notices = made.read(scene_id)
        assert not notices
        assert [o.asset_id for o in scene.objects] == [a.asset_id for a in wanted]
        assert scene.task is not None
        assert scene.task.task == "Lift it."
        assert scene.task.task_objects == (f"{wanted[0].category}_0",)
        with Image.open(made.layout_path(scene_id).with_name("front.png")) as front:
            assert (front.format, front.size) == ("PNG", (512, 512))  # as the format has it
    assert made.read("mine")[0].table == Tabletop("office_table", (1.2, 0.6), (0.0, 0.4, 0.4, 0.6))
    assert set(made.annotations) == {a.asset_id for a in wanted}
    assert {p.stem for p in (out / "dataset" / "Assets_library").iterdir()} == set(made.annotations)
    asked = [json.loads(line) for line in (out / "proposals.jsonl").read_text().splitlines()]
    assert [(r["scene_id"], r["stage"]) for r in asked[:3]] == [("task_000001", str(stage)) for stage in Stage]
    (nonsense,) = [r for r in asked if r["scene_id"] == "task_000008"]
    assert nonsense["tries"] == len(nonsense["refused"]) == 4
    assert nonsense["refused"][0]["answer"] == "what?"
    page = (out / "report" / "index.html").read_text()
    assert page.count("<figure>") == 1
    assert "asset_unmatched" in page


def test_a_run_that_was_stopped_goes_on(
    dataset: Path, shelf: AssetLibraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = scripted(tmp_path, shelf, pictures=False)
    tasks = task_file(tmp_path, [{**GOOD, "scene_id": f"scene_{k}"} for k in range(5)])
    propose(tasks, str(tmp_path / "whole"), settings, [str(dataset)])
    write, left = job._Writer.write, [0]

    def stop(self: Any, *arguments: Any) -> None:
        left[0] += 1
        if left[0] == 2:
            raise KeyboardInterrupt
        write(self, *arguments)

    out = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(job._Writer, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            propose(tasks, str(out), settings, [str(dataset)])
    assert len(list(out.glob("dataset/Layout_info/*/*/layout.json"))) == 2
    propose(tasks, str(out), settings, [str(dataset)])
    assert files(out) == files(tmp_path / "whole")
    with monkeypatch.context() as patch:
        patch.setattr(Proposer, "outcomes", None)  # nothing is asked
        propose(tasks, str(out), settings, [str(dataset)])
    assert files(out) == files(tmp_path / "whole")
    with pytest.raises(ConfigError, match="seed: 0 -> 1") as caught:
        propose(tasks, str(out), scripted(tmp_path, shelf, pictures=False, seed=1), [str(dataset)])
    assert caught.value.code == "config_changed"


def test_what_rests_on_a_thing_without_an_asset_is_left_out_too(shelf: AssetLibraries) -> None:
    asset = shelf.libraries[0].assets[1]

    def thing(name: str, words: str, z: float, support: str, stage: Stage) -> SceneObject:
        return SceneObject(name, name, (0.5, 0.3, z), 0.0, (0.1, 0.1, 0.1), description=words, stage=stage, support=support)

    objects = (
        thing("a", asset.words, 0.05, "table", Stage.TASK),
        thing("elephant", "an elephant with a trunk as long as a river", 0.05, "table", Stage.IMPORTANT),
        thing("b", asset.words, 0.15, "elephant", Stage.SECONDARY),
    )
    scene = Scene("one", Tabletop("office_table", (1.2, 0.6)), objects)
    (found,) = assign_assets([scene], shelf.retriever())
    assert [o.instance for o in found.scene.objects] == ["a"]
    assert set(found.unmatched) == {"elephant"}
    assert [n.code for n in found.notices] == ["carrier_left_out", "asset_unmatched"]
    assert not assign_assets([Scene("two", scene.table, ())], shelf.retriever())[0].notices


def test_the_first_library_serves_and_a_run_is_one(tiny: Path, tiny_run: Path, dataset: Path, shelf: AssetLibraries) -> None:
    both = AssetLibraries([str(tiny_run), str(dataset)])
    names = [library.name for library in both.libraries]
    assert names == [tiny_run.name, dataset.name]
    first, rest = ({a.asset_id for a in library.assets} for library in both.libraries)
    assert first
    assert not first & rest  # an asset that two have is the earlier one's
    assert first | rest == {a.asset_id for a in shelf.libraries[0].assets}
    for asset in both.libraries[0].assets:
        path = both.asset_path(asset.asset_id)
        assert path is not None
        assert path.read_bytes().startswith(b"glTF")
        ours, theirs = both.annotation(asset.asset_id), shelf.annotation(asset.asset_id)
        assert (ours.category, ours.description, ours.is_container) == (
            theirs.category,
            theirs.description,
            theirs.is_container,
        )
        assert ours.extents_z_up == pytest.approx(theirs.extents_z_up, rel=1e-3)
    (library,) = AssetLibraries([str(tiny), str(dataset)]).libraries  # the second has nothing that the first has not
    assert library.name == str(tiny)  # both folders are called data
    with pytest.raises(ConfigError):
        AssetLibraries([str(tiny / "nowhere")])


def test_the_embedded_library_serves_where_others_have_nothing(dataset: Path) -> None:
    own, rest = AssetLibraries([str(dataset), "embedded"]).libraries
    (alone,) = AssetLibraries().libraries
    first = {a.asset_id for a in own.assets}
    assert {a.asset_id for a in rest.assets} == {a.asset_id for a in alone.assets} - first
    assert rest.name == alone.name == "embedded"


def test_a_folder_of_assets_alone_is_a_library(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "assets", ignore=shutil.ignore_patterns("Layout_info"))
    assert len(AssetLibraries([str(tmp_path / "assets")]).libraries[0])


def test_an_engine_that_is_off_ends_the_run_and_costs_no_task(
    dataset: Path, shelf: AssetLibraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, out = scripted(tmp_path, shelf, pictures=False), tmp_path / "out"
    tasks = task_file(tmp_path, [{**GOOD, "scene_id": f"scene_{k}"} for k in range(3)])

    def off(engine: EngineSettings, more: Any) -> Any:
        reasoner, statistics = load_reasoner(engine, more)
        reasoner.engine = ScriptedEngine(lambda _: Completion("", failure="nobody answers", code="endpoint_down"))
        return reasoner, statistics

    with monkeypatch.context() as patch:
        patch.setattr(job, "load_reasoner", off)
        with pytest.raises(ConfigError, match=r"nobody answers.*run again") as caught:
            propose(tasks, str(out), settings, [str(dataset)])
    assert caught.value.code == "engine_off"
    assert propose(tasks, str(out), settings, [str(dataset)])["counts"]["scenes"] == 3


def test_a_task_has_the_same_seed_wherever_it_stands(shelf: AssetLibraries) -> None:
    asked: list[tuple[str, int]] = []

    def reply(request: Request) -> str:
        asked.append((request.messages[-1]["content"], request.seed))
        return json.dumps({"objects": [entry(shelf.libraries[0].assets[1], 20.0)]})

    tasks = [LayoutTask(f"scene_{k}", f"Lift it {k} times.", Tabletop("office_table", (1.2, 0.6))) for k in range(3)]
    proposer = Proposer(SemanticReasoner(ScriptedEngine(reply)), None, shelf.retriever(), (Stage.TASK,), 5)
    proposer.outcomes(tasks)
    proposer.outcomes(tasks[:1])
    assert asked[0] == asked[3]
    assert len({seed for _, seed in asked}) == 3


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_file_of_another_kind_says_the_same(ending: str, tmp_path: Path) -> None:
    rows = [{"scene_id": "a", **GOOD, "restricted_zone_cm": [0.0, 40.0, 10.5, 20.0]}, GOOD, {**GOOD, "instruction": ""}]
    path = tmp_path / f"tasks.{ending}"
    if ending == "parquet":
        pq.write_table(pa.Table.from_pylist(rows), path)
    else:
        with path.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, rows[0])
            writer.writeheader()
            for row in rows:
                sizes = {"table_size_cm": "120 x 60"} | (
                    {"restricted_zone_cm": "[0, 40, 10.5, 20]"} if "scene_id" in row else {}
                )
                writer.writerow(row | sizes)
    expected = [*read_tasks(task_file(tmp_path, rows))]
    found = [*read_tasks(path)]
    assert found[:2] == expected[:2]
    last, other = found[2], expected[2]
    assert isinstance(last, Notice)
    assert isinstance(other, Notice)
    assert (last.item_id, last.code) == (other.item_id, other.code) == ("row 000003", "instruction_invalid")


def test_no_task_has_the_name_of_a_row_that_is_none(tmp_path: Path) -> None:
    names = ["row_000002", "row 000002", "row_000004", "task_000006"]
    rows = [*({**GOOD, "scene_id": name} for name in names), {**GOOD, "instruction": ""}, GOOD, "no JSON"]
    found = list(read_tasks(task_file(tmp_path, rows)))
    tasks = [task.scene_id for task in found if isinstance(task, LayoutTask)]
    lost = {notice.item_id: notice.message for notice in found if isinstance(notice, Notice)}
    assert tasks == ["row_000002", "row_000004", "task_000006"]
    assert list(lost) == ["row 000002", "row 000005", "row 000006", "row 000007"]
    assert "scene_id task_000006 is taken, expected one of its own" in lost["row 000006"]  # first come keeps the name


def test_an_empty_instruction_is_shown_as_it_is(tmp_path: Path) -> None:
    (lost,) = read_tasks(task_file(tmp_path, [{**GOOD, "instruction": ""}]))
    assert isinstance(lost, Notice)
    assert "instruction is '', expected" in lost.message


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_column_that_is_none_of_a_tasks_is_refused_at_once(ending: str, tmp_path: Path) -> None:
    """Else the rows alone would be lost that fill it."""
    path = tmp_path / f"tasks.{ending}"
    rows = [{"instruction": "Lift it.", "table_type": "desk", "table_size_cm": "120 x 60", "note": note} for note in ("", "a")]
    if ending == "csv":
        path.write_text("\n".join(",".join(row.values()) for row in ({key: key for key in rows[0]}, *rows)))
    else:
        pq.write_table(pa.Table.from_pylist(rows), path)
    with pytest.raises(ConfigError, match="has a column 'note', expected tasks"):
        list(read_tasks(path))


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe{", b"instruction,table_type\na,b\n", b"PAR1 and no more"])
@pytest.mark.parametrize("ending", ["jsonl", "csv", "parquet", "xlsx"])
def test_a_file_that_holds_no_tasks_is_refused(content: bytes | None, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"tasks.{ending}"
    if content is not None:
        path.write_bytes(content)
    if ending == "jsonl" and content:
        assert all(isinstance(found, Notice) for found in read_tasks(path))
        return
    with pytest.raises(ConfigError) as caught:
        list(read_tasks(path))
    assert caught.value.code == "tasks_invalid"
    assert "\n" not in str(caught.value)


BAD_ROWS: list[dict[str, Any]] = [
    {"instruction": "Lift \ud800 it."},
    {"instruction": 10**4000},
    {"instruction": ["Lift it."]},
    {"table_type": "\ud800"},
    {"scene_id": "\udfff"},
    {"scene_id": 10**4000},
    {"scene_id": 1.5},
    {"\ud800": 1},
    {"table_size_cm": [10**400, 5]},
    {"table_size_cm": [float("nan"), 60]},
    {"table_size_cm": [120, 1e-300]},
    {"table_size_cm": [120, "\ud800"]},
    {"table_size_cm": json.loads("[" * 900 + "]" * 900)},
    {"table_size_cm": {"x": 120, "y": 60}},
    {"table_size_cm": [[120, 60], None]},
    {"table_size_cm": True},
    {"restricted_zone_cm": [0, 10**400, 0, 1]},
    {"restricted_zone_cm": [0, float("inf"), 0, 1]},
]


def check_one_is_lost(path: Path) -> None:
    """Of three rows the second, whose failure can be written."""
    found = list(read_tasks(path))
    assert [type(each) for each in found] == [LayoutTask, Notice, LayoutTask]
    assert isinstance(found[1], Notice)
    assert found[1].item_id == "row 000002"
    assert len(found[1].message.encode()) < 300


@pytest.mark.parametrize("bad", BAD_ROWS, ids=range(len(BAD_ROWS)))
def test_a_bad_row_is_a_failure_of_its_own(bad: dict[str, Any], tmp_path: Path) -> None:
    check_one_is_lost(task_file(tmp_path, [GOOD, {**GOOD, **bad}, GOOD]))


@pytest.mark.parametrize("bad", [b"Lift \xff it.", b"x" * 200_000], ids=["bytes", "long"])
@pytest.mark.parametrize("ending", ["csv", "jsonl", "parquet"])
def test_a_row_that_cannot_be_read_is_a_failure_of_its_own(bad: bytes, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"tasks.{ending}"
    words = [b"Lift it.", bad, b"Lift it."]
    if ending == "csv":
        path.write_bytes(b"\n".join([b"instruction,table_type,table_size_cm", *(w + b",desk,120 x 60" for w in words)]))
    elif ending == "jsonl":
        rows = (b'{"instruction": "%s", "table_type": "desk", "table_size_cm": [120, 60]}' % w for w in words)
        path.write_bytes(b"\n".join(rows))
    else:
        texts = pa.Array.from_buffers(pa.string(), 3, pa.array(words, pa.binary()).buffers())
        sizes = pa.array([[120.0, 60.0]] * 3)
        table = pa.table({"instruction": texts, "table_type": ["desk"] * 3, "table_size_cm": sizes})
        pq.write_table(table, path)
    if len(bad) < 100 or ending == "csv":
        check_one_is_lost(path)
    else:
        assert all(isinstance(found, LayoutTask) for found in read_tasks(path))  # the prompt's limit is looked at later


def test_settings_of_all_parts_are_settings_of_the_job(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text(
        '[propose]\none_shot = true\n[propose.retrieval]\nlicences = ["CC0"]\n[propose.engine.sampling]\ntop_k = 7\n'
    )
    found = resolve(ProposeSettings, "propose", file, ["retrieval.top_k_text=20", "engine.http.tries=3", "reasoner.tries=2"])
    assert found.retrieval == RetrievalSettings(licences=frozenset({"CC0"}), top_k_text=20)
    assert (found.one_shot, found.engine.sampling.top_k, found.engine.http.tries, found.reasoner.tries) == (True, 7, 3, 2)
    json.dumps(found.shaping())
    for wrong in ("retrieval.licences=CC0", "retrieval.top_k_text=many", "engine.engine=gpt", "scenes_per_shard=0"):
        with pytest.raises(ConfigError):
            resolve(ProposeSettings, "propose", None, [wrong])


def command(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["propose", *words])
    return done.exit_code, done.output


def test_the_command_lays_out_one_scene(dataset: Path, shelf: AssetLibraries, tmp_path: Path) -> None:
    engine = scripted(tmp_path, shelf).engine.engine
    where = ["--assets", str(dataset), "--engine", engine, "--out", str(tmp_path / "out")]
    size = ["--table", "Office Table", "--size", "120", "60", "--restricted", "0", "40", "40", "60"]
    status, said = command("--instruction", "Lift it.", *size, *where, "--set", "pictures=false")
    assert status == 0, said
    assert "1 of 1 tasks laid out" in said
    (scene,) = [MesaTaskDataset(tmp_path / "out" / "dataset").read("task")[0]]
    assert scene.table == Tabletop("office_table", (1.2, 0.6), (0.0, 0.4, 0.4, 0.6))
    where[-1] = str(tmp_path / "failed")
    assert command("--instruction", "Say nonsense", *size, *where, "--one-shot")[0] == 1


@pytest.mark.parametrize(
    "words",
    [
        ["--instruction", "Lift it."],
        ["--instruction", "Lift it.", "--table", "office_table", "--size", "120", "60", "--tasks", "x.jsonl"],
        ["--tasks", "nowhere.jsonl"],
        ["--instruction", "Lift it.", "--table", "office_table", "--size", "0", "60"],
        ["--instruction", "Lift it.", "--table", "office_table", "--size", "120", "60", "--engine", "gpt"],
        [],
    ],
)
def test_what_cannot_start_is_one_line_and_status_2(words: list[str], tmp_path: Path) -> None:
    status, said = command(*words, "--out", str(tmp_path / "out"))
    assert status == 2
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert not (tmp_path / "out" / "manifest.json").exists()
