"""Runs that were written earlier stay readable: they lack what was added since, and that is null, unknown, and said."""

import atexit
import shutil
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from stable_data.cli import app
from stable_data.commands.command_line import DONE
from stable_data.errors import ConfigError, MissingColumnsWarning
from stable_data.scene import Scene
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import REQUIRED, SCHEMAS, TABLE_VERSION
from stable_data.storage.table_rows import card_from_row, scene_from_row
from stable_data.storage.torch_dataset import TableDataset, TableStream, collate_scenes

STORED = Path(__file__).parents[2] / "data" / "run_v3"
JOBS = ("preprocess", "generate")
ADDED = "float_gap, oc_sdf, awt_annotated, aws_graph, awt_understood, aws_understood, read_as_labelled"
"""Columns of cards that did not exist when the stored runs were made."""


@cache
def runs() -> Path:
    """The stored runs with all columns of today, null where the stored ones lack them."""
    target = Path(mkdtemp())
    atexit.register(shutil.rmtree, target, ignore_errors=True)
    for name in JOBS:
        shutil.copytree(STORED / name, target / name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingColumnsWarning)
            for table in SCHEMAS:
                if (target / name / table).is_dir():
                    rows = RunFolder(STORED / name).table(table)
                    shutil.rmtree(target / name / table)
                    (target / name / table).mkdir()
                    pq.write_table(rows, target / name / table / "part-0.parquet")
    return target


@pytest.mark.parametrize(
    ("name", "tables"),
    [("preprocess", ["scenes", "assets", "meshes"]), ("generate", ["scenes", "turns", "assets", "meshes", "rejected"])],
)
def test_a_stored_run_is_read_for_good(name: str, tables: list[str]) -> None:
    folder = RunFolder(STORED / name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for table in filter(folder.files, SCHEMAS):
            assert folder.table(table).schema.equals(SCHEMAS[table])
            TableFiles(str(STORED / name), table, None)
        assert len(_rows(TableDataset(str(STORED / name)))) == 2
    texts = [str(w.message) for w in caught]
    assert [text.partition("table ")[2].split()[0] for text in texts] == tables
    assert f"was written before {ADDED} existed" in texts[tables.index("scenes")]


def _rows(table: TableDataset) -> list[Any]:
    return [table[k] for k in range(len(table))]


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)])


def rewritten(name: str, target: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> str:
    """A copy of a run one table of which is changed; gives its URI."""
    shutil.copytree(runs() / name, target)
    for path in (target / table).iterdir():
        pq.write_table(change(pq.read_table(path, partitioning=None)), path)
    return str(target)


def without(name: str, target: Path, *columns: str) -> str:
    """A copy of a run whose scenes lack some columns."""
    return rewritten(name, target, "scenes", lambda rows: rows.drop_columns(list(columns)))


@pytest.mark.parametrize("name", JOBS)
def test_a_run_of_this_version_loads_and_streams(name: str) -> None:
    uri, folder = str(runs() / name), RunFolder(runs() / name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenes = _rows(TableDataset(uri))
        assert len(scenes) == 2
        assert all(isinstance(scene, Scene) and scene.objects for scene in scenes)
        assert [scene_from_row(row) for row in folder.table("scenes").to_pylist()] == scenes
        [batch] = TableStream(uri, batch_size=2, collate=collate_scenes)
        assert int(batch["mask"].sum()) == sum(len(scene.objects) for scene in scenes)
    for table in SCHEMAS:
        if folder.files(table):
            rows = folder.table(table)
            assert rows.schema.equals(SCHEMAS[table])
            assert rows.num_rows == folder.num_rows(table) == len(TableFiles(uri, table, None))


@pytest.mark.parametrize(("name", "num_clean"), [("preprocess", 1), ("generate", 2)])
def test_a_run_of_this_version_is_queried_and_exported(name: str, num_clean: int, tmp_path: Path) -> None:
    counted = command("query", runs() / name, "clean and num_objects >= 2")
    assert (counted.exit_code, counted.stderr) == (DONE, "")
    assert f"{num_clean} of 2 scenes" in counted.stdout
    chosen = command("query", runs() / name, "clean", "--to", tmp_path / "chosen")
    assert (chosen.exit_code, chosen.stderr) == (DONE, "")
    assert len(TableDataset(str(tmp_path / "chosen"))) == num_clean
    written = command("export", runs() / name, tmp_path / "out", "--format", "mesatask")
    assert written.exit_code == DONE, written.stderr
    assert "2 of 2 scenes as mesatask" in written.stdout
    assert len(list((tmp_path / "out").rglob("layout.json"))) == 2


def test_what_a_run_lacks_is_null_and_said(tmp_path: Path) -> None:
    uri = without("generate", tmp_path / "run", "stable", "drift_mm")
    warned = r"table scenes was written before drift_mm, stable existed; they are read as null \(unknown\)"
    assert RunFolder(uri).table("scenes", ["stable"])["stable"].to_pylist() == [None, None]
    with pytest.warns(MissingColumnsWarning, match=warned):
        rows = _rows(TableDataset(uri, decode=dict))
    assert [card_from_row(row).stable for row in rows] == [None, None]
    assert [card_from_row(row).clean for row in rows] == [True, True]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(_rows(TableDataset(uri))) == 2  # a scene needs neither
    for where, count in (("stable", 0), ("not stable", 0), ("stable is None", 2), ("clean or stable", 2)):
        with pytest.warns(
            MissingColumnsWarning, match="the condition names stable, and rows with null there do not pass"
        ) as caught:
            assert len(TableDataset(uri, where=where)) == count
        assert "\n" not in str(caught[0].message)
    with pytest.warns(MissingColumnsWarning, match="before stable existed"):
        assert TableDataset(uri, columns=["scene_id", "stable"])[0] == {"scene_id": rows[0]["scene_id"], "stable": None}


def test_the_commands_say_in_one_line_what_a_run_lacks(tmp_path: Path) -> None:
    uri = without("generate", tmp_path / "run", "stable")
    counted = command("query", uri, "stable")
    assert counted.exit_code == DONE
    assert "0 of 2 scenes" in counted.stdout
    [line] = counted.stderr.splitlines()
    assert line.startswith(f"warning: {uri}: table scenes was written before stable existed")
    assert "rows with null there do not pass" in line
    chosen = command("query", uri, "clean", "--to", tmp_path / "chosen")
    assert "2 of 2 scenes" in chosen.stdout
    assert len(chosen.stderr.splitlines()) == 1
    assert RunFolder(tmp_path / "chosen").table("scenes", ["stable"])["stable"].to_pylist() == [None, None]
    written = command("export", uri, tmp_path / "out", "--format", "mesatask")
    assert written.exit_code == DONE, written.stderr
    assert sum("before stable existed" in line for line in written.stderr.splitlines()) == 1


@pytest.mark.slow
def test_any_column_that_is_not_required_may_be_missing(tmp_path: Path) -> None:
    scenes = _rows(TableDataset(str(runs() / "preprocess")))
    for column in SCHEMAS["scenes"].names:
        uri = without("preprocess", tmp_path / column, column)
        if column in REQUIRED["scenes"]:
            for read in (lambda uri=uri: RunFolder(uri).table("scenes"), lambda uri=uri: TableDataset(uri)):
                with pytest.raises(ConfigError, match=f"column {column} is missing, expected in every") as caught:
                    read()
                assert caught.value.code == "column_missing"
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingColumnsWarning)
            found = _rows(TableDataset(uri))
        assert [scene.objects for scene in found] == [scene.objects for scene in scenes]


def test_a_field_of_a_struct_may_be_missing(tmp_path: Path) -> None:
    """A new metric is also a field of the cards in other tables."""

    def drop(rows: pa.Table) -> pa.Table:
        card = rows.schema.field("card_after")
        fields = [card.type.field(k) for k in range(card.type.num_fields) if card.type.field(k).name != "stable"]
        return rows.set_column(
            rows.schema.get_field_index("card_after"),
            card.with_type(pa.struct(fields)),
            rows["card_after"].cast(pa.struct(fields)),
        )

    uri = rewritten("generate", tmp_path / "run", "turns", drop)
    with pytest.warns(MissingColumnsWarning, match=r"table turns was written before card_after\.stable existed"):
        files = TableFiles(uri, "turns", None)
    expected = RunFolder(runs() / "generate").table("turns")["card_after"].to_pylist()
    for rows in (RunFolder(uri).table("turns"), files.read(range(len(files.groups)))):
        assert rows.schema.equals(SCHEMAS["turns"])
        assert rows["card_after"].to_pylist() == [None if card is None else card | {"stable": None} for card in expected]


@pytest.mark.parametrize(
    ("version", "remedy"), [(-1, "bring the run up to date with: stable-data upgrade RUN"), (1, "install the version")]
)
def test_a_run_of_another_version_is_refused_in_one_line(version: int, remedy: str, tmp_path: Path) -> None:
    found = str(TABLE_VERSION + version)
    uri = rewritten(
        "preprocess", tmp_path / "run", "scenes", lambda rows: rows.replace_schema_metadata({"stable_data.version": found})
    )
    result = command("query", uri, "clean")
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert f"written as table version {found}, expected {TABLE_VERSION}; {remedy}" in line
    with pytest.raises(ConfigError, match=remedy):
        TableDataset(uri)
