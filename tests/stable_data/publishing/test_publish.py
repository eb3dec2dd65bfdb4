"""publish writes a folder that a dataset hub takes as it is, and refuses what must not be given away."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import yaml
from datasets import get_dataset_config_names, load_dataset
from typer.testing import CliRunner, Result

from stable_data.cli import app
from stable_data.commands.command_line import DONE, NOT_STARTED
from stable_data.publishing.croissant import croissant_document
from stable_data.publishing.dataset_card import ABOUT, UNSPLIT, CardContent, PublishedTable, hub_licence, size_category
from stable_data.storage.checksums import CHECKSUMS
from stable_data.storage.manifest import read_manifest, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.torch_dataset import TableDataset
from tests.stable_data.verification.editing import rows
from tests.whole import check_whole


def published(run: Path, out: Path, *more: str) -> Result:
    return CliRunner().invoke(app, ["publish", str(run), str(out), "--quiet", "--verdicts", "none", *more])


@pytest.fixture(scope="module")
def split_run(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The generated run with scenes of two splits, and a message with a path of the machine that made it."""
    run = Path(shutil.copytree(generated, tmp_path_factory.mktemp("split") / "run"))

    def other_split(found: list[Row]) -> None:
        found[0] |= {"split": "test", "variant_of": "elsewhere", "varied": "task", "num_varied": 0, "duplicate_group": "0" * 16}

    rows("scenes", other_split)(run)
    message = "task_1: /home/somebody/data/cup.glb cannot be read"
    rows("failures", lambda found: found[0].update(message=message))(run)
    return run


@pytest.fixture(scope="module")
def folder(split_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("published") / "out"
    done = published(split_run, out, "--title", "Three tables", "--licence", "cc by 4.0", "--url", "https://example.org/tables")
    assert done.exit_code == DONE, done.output
    assert "scenes 3" in done.stdout
    return out


def head_of(folder: Path) -> dict[str, Any]:
    _, head, _ = (folder / "README.md").read_text("utf-8").split("---\n", 2)
    found: dict[str, Any] = yaml.safe_load(head)
    return found


def test_the_head_of_the_card_is_what_a_hub_reads(folder: Path) -> None:
    head = head_of(folder)
    assert head["pretty_name"] == "Three tables"
    assert (head["license"], head["license_name"], head["license_link"]) == (
        "other",
        "cc-by-4.0-and-apache-2.0",
        "ATTRIBUTION.md",
    )
    assert (head["size_categories"], head["task_categories"]) == (["n<1K"], ["robotics"])
    configs = {config["config_name"]: config for config in head["configs"]}
    assert [name for name, config in configs.items() if config.get("default")] == ["scenes"]
    assert {entry["split"] for entry in configs["scenes"]["data_files"]} == {"train", "test"}
    for config in configs.values():
        for entry in config["data_files"]:
            assert list(folder.glob(entry["path"])), entry


def test_hugging_face_loads_every_table_by_split(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_DATASETS_OFFLINE", "1")
    names = get_dataset_config_names(str(folder))
    assert {"scenes", "turns", "assets", "meshes", "licences"} <= set(names)
    for name in names:
        found = load_dataset(str(folder), name, cache_dir=str(tmp_path))
        counts = {split: rows_of.num_rows for split, rows_of in found.items()}
        if name == "scenes":
            assert counts == {"train": 2, "test": 1}
        elif name in SCHEMAS:
            assert counts == {"train": RunFolder(str(folder)).num_rows(name)}


def test_the_folder_is_a_whole_run_with_the_same_rows(folder: Path, split_run: Path) -> None:
    assert check_whole(folder, verdicts="audit").num_audited == 3

    def rows_by_text(run: Path, table: str) -> list[Row]:
        return sorted(RunFolder(str(run)).table(table).to_pylist(), key=lambda row: json.dumps(row, default=str))

    for table in ("scenes", "turns", "assets", "meshes", "settled"):
        assert rows_by_text(folder, table) == rows_by_text(split_run, table), table
    assert len(TableDataset(str(folder), split="test")) == 1


def test_nothing_private_is_published(folder: Path, split_run: Path) -> None:
    (message,) = [
        row["message"] for row in RunFolder(str(folder)).table("failures").to_pylist() if "cannot be read" in row["message"]
    ]
    assert message == "task_1: cup.glb cannot be read"
    for path in folder.rglob("*"):
        if path.suffix in (".json", ".md"):
            text = path.read_text("utf-8")
            assert not any(word in text for word in ("/home/", "/tmp/", str(split_run))), path  # noqa: S108
    assert not (folder / "report").exists()
    assert not (folder / "timing").exists()
    assert not list(folder.rglob(".*"))


def test_licences_are_a_table(folder: Path) -> None:
    found = pq.read_table(folder / "licences.parquet").to_pylist()
    assert [row["asset_id"] for row in found] == sorted(
        row["asset_id"] for row in RunFolder(str(folder)).table("assets").to_pylist()
    )
    assert {row["licence"] for row in found} == {"Apache-2.0"}
    assert {row["is_credited"] for row in found} == {True}
    assert "## Apache-2.0\n\nAsked: name the author and the licence.\n" in (folder / "ATTRIBUTION.md").read_text("utf-8")


def test_croissant_names_every_table_and_its_files(folder: Path) -> None:
    document = json.loads((folder / "croissant.json").read_text("utf-8"))
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    assert document["license"] == [f"https://spdx.org/licenses/{name}.html" for name in ("CC-BY-4.0", "Apache-2.0")]
    assert document["url"] == "https://example.org/tables"
    files = {entry["@id"]: entry for entry in document["distribution"]}
    records = {entry["@id"]: entry for entry in document["recordSet"]}
    assert {"scenes", "turns", "assets", "meshes", "licences"} <= records.keys()
    for name, record in records.items():
        ids = [field["@id"] for field in record["field"]]
        assert len(set(ids)) == len(ids)
        if "key" in record:
            assert record["key"]["@id"] in ids
        source = "licences.parquet" if name == "licences" else f"{name}-files"
        assert source in files
        for field in record["field"]:
            inner = field.get("subField", [field])
            assert all(next(iter(each["source"].values()))["@id"] == source for each in inner)
    (described,) = (record["field"] for name, record in records.items() if name == "scenes")
    columns = {field["@id"].partition("/")[2] for field in described}
    assert columns == set(SCHEMAS["scenes"].names)
    for name, entry in files.items():
        if entry["@type"] == "cr:FileObject":
            assert (folder / name).stat().st_size == int(entry["contentSize"].split()[0])
        else:
            assert list(folder.glob(entry["includes"]))


def test_every_column_has_a_field_or_no_type_in_croissant() -> None:
    tables = [PublishedTable(name, {UNSPLIT: 1}, 1) for name in SCHEMAS]
    document = croissant_document("all", "all tables", [], tables, [])
    for record in document["recordSet"]:
        name = record["@id"]
        named = {field["@id"].partition("/")[2] for field in record["field"]}
        assert set(SCHEMAS[name].names) - named <= {"glb", "look"}, name


# --- what is refused ----------------------------------------------------------------------------------------------------------


def stated(licence: str | None, text: str | None = None) -> Any:
    return rows("assets", lambda found: found[0].update(licence=licence, licence_text=text))


@pytest.mark.parametrize(
    ("licence", "option", "says"),
    [
        (None, "--allow-unknown-licences", "1 of 3 assets have no known licence: 'none stated' (1)"),
        ("for research only", "--allow-unknown-licences", "have no known licence: 'for research only' (1)"),
        ("CC BY-ND 4.0", "--allow-no-derivatives", "must not be passed on changed"),
    ],
)
def test_a_licence_that_is_unknown_or_forbids_it_is_refused(
    licence: str | None, option: str, says: str, generated: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(generated, tmp_path / "run"))
    stated(licence)(run)
    done = published(run, tmp_path / "out")
    assert done.exit_code == NOT_STARTED
    assert says in done.stderr
    assert option in done.stderr
    assert not (tmp_path / "out").exists()
    done = published(run, tmp_path / "out", option)
    assert done.exit_code == DONE, done.stderr
    assert head_of(tmp_path / "out")["license"] == "other"


def test_a_run_that_is_not_whole_is_refused(generated: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(generated, tmp_path / "run"))
    rows("turns", lambda found: found[0].update(tries=-1))(run)
    done = published(run, tmp_path / "out")
    assert done.exit_code == NOT_STARTED
    assert "tries is -1" in done.stderr
    assert "damaged" in done.stderr.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    done = published(run, tmp_path / "out", "--unverified")
    assert done.exit_code == DONE
    assert "the card says so" in done.stdout
    assert "damaged: 1 finding in turns" in (tmp_path / "out" / "README.md").read_text("utf-8")


def test_an_unfinished_run_is_refused(generated: Path, tmp_path: Path) -> None:
    run = RunFolder(str(shutil.copytree(generated, tmp_path / "run")))
    manifest = read_manifest(run)
    assert manifest is not None
    write_manifest(run, manifest | {"status": "running"})
    done = published(Path(run.root), tmp_path / "out")
    assert done.exit_code == NOT_STARTED
    assert "not finished" in done.stderr


def test_a_folder_with_files_is_refused(generated: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    done = published(generated, tmp_path / "out")
    assert done.exit_code == NOT_STARTED
    assert "is not empty" in done.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [("--licence", "mine", "is no known licence"), ("--dataset-version", "1.0", "is no version, expected three numbers")],
)
def test_an_odd_licence_or_version_is_refused(option: str, value: str, says: str, generated: Path, tmp_path: Path) -> None:
    done = published(generated, tmp_path / "out", option, value)
    assert (done.exit_code, (tmp_path / "out").exists()) == (NOT_STARTED, False)
    assert says in done.stderr


def test_an_error_while_writing_leaves_nothing(generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stable_data.publishing.publisher.write_contracts", lambda folder: (folder / "no" / "such").mkdir())
    done = published(generated, tmp_path / "out")
    assert done.exit_code == NOT_STARTED
    assert not list(tmp_path.iterdir())


def test_textures_and_pictures_of_an_import_are_published(imported: Path, tmp_path: Path) -> None:
    done = published(imported, tmp_path / "out", "--licence", "CC-BY-4.0")
    assert done.exit_code == DONE, done.stderr
    assert head_of(tmp_path / "out")["license"] == "cc-by-4.0"
    check_whole(tmp_path / "out")
    assert (tmp_path / "out" / CHECKSUMS).is_file()


# --- small things -------------------------------------------------------------------------------------------------------------


def test_every_table_is_described() -> None:
    assert ABOUT.keys() == SCHEMAS.keys()


@pytest.mark.parametrize(
    ("count", "name"),
    [(0, "n<1K"), (999, "n<1K"), (1000, "1K<n<10K"), (5 * 10**6, "1M<n<10M"), (10**8, "100M<n<1B"), (10**12, "n>1T")],
)
def test_sizes_are_those_of_the_hub(count: int, name: str) -> None:
    assert size_category(count) == name


@pytest.mark.parametrize(
    ("licences", "own", "expected"),
    [
        ({"CC0-1.0": 3}, None, "other"),
        ({"CC0-1.0": 3}, "CC0-1.0", "cc0-1.0"),
        ({"CC0-1.0": 3}, "CC-BY-4.0", "other"),
        ({"CC0-1.0": 3, "not known": 1}, None, "other"),
        ({"CC-BY": 3}, None, "other"),
        ({}, None, "unknown"),
        ({}, "CC-BY-4.0", "cc-by-4.0"),
        ({"not known": 2}, None, "other"),
    ],
)
def test_one_known_licence_is_named_and_several_are_a_page(licences: dict[str, int], own: str | None, expected: str) -> None:
    content = CardContent("t", {}, [PublishedTable("scenes", {UNSPLIT: 1}, 1)], licences, own, "", [], [])
    assert hub_licence(content)["license"] == expected
