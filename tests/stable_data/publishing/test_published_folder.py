"""A published folder as a whole: each of its files is verified, nothing of it is private, and it is put in place at once."""

import fcntl
import io
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from datasets import load_dataset
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from typer.testing import CliRunner, Result

from stable_data.cli import app
from stable_data.commands.command_line import DONE, NOT_STARTED, SOME_FAILED
from stable_data.publishing.asset_licences import asset_licences
from stable_data.publishing.croissant import croissant_document, missing_entries
from stable_data.publishing.dataset_card import UNSPLIT, SplitNames
from stable_data.publishing.previews import FOLDER, SHEET, previews
from stable_data.publishing.private_paths import rows_without_folders
from stable_data.storage.checksums import CHECKSUMS
from stable_data.storage.manifest import read_manifest, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from tests.stable_data.verification.editing import manifest, rows, small_run

SOMEBODY = "alice"


def published(run: Path, out: Path | str, *more: str) -> Result:
    return CliRunner().invoke(app, ["publish", str(run), str(out), "--quiet", "--verdicts", "none", *more])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_run(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def folder(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("published") / "out"
    said = (
        "--creator",
        "A. Person",
        "--organization",
        "A Lab",
        "--url",
        "https://example.org/tables",
        "--dataset-version",
        "1.2.0",
    )
    done = published(run, out, *said)
    assert done.exit_code == DONE, done.output
    assert "croissant.json lacks" not in done.stderr
    return out


# --- its files ----------------------------------------------------------------------------------------------------------------


def test_checksums_are_of_every_file(folder: Path) -> None:
    done = subprocess.run(["sha256sum", "-c", "--quiet", CHECKSUMS], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")
    named = {line.split("  ", 1)[1] for line in (folder / CHECKSUMS).read_text("utf-8").splitlines()}
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert there - named == {CHECKSUMS, "manifest.json"}
    assert named <= there


def edited(name: str) -> Callable[[Path], object]:
    return lambda out: (out / name).write_bytes((out / name).read_bytes() + b" ")


def removed(name: str) -> Callable[[Path], object]:
    return lambda out: (out / name).unlink()


def added(name: str) -> Callable[[Path], object]:
    return lambda out: (out / name).write_text("x")


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (edited("README.md"), "README.md: has the SHA-256"),
        (edited("croissant.json"), "croissant.json: has the SHA-256"),
        (edited("licences.parquet"), "licences.parquet: has the SHA-256"),
        (edited("schemas/tables.json"), "schemas/tables.json: has the SHA-256"),
        (removed("ATTRIBUTION.md"), "ATTRIBUTION.md: is missing"),
        (removed("schemas/scene.schema.json"), "schemas/scene.schema.json: is missing"),
        (added("LICENSE"), f"LICENSE: is not in {CHECKSUMS}"),
        (added("schemas/more.json"), f"schemas/more.json: is not in {CHECKSUMS}"),
        (added(".gitattributes"), ""),  # hubs write hidden files
    ],
)
def test_every_file_is_verified(damage: Callable[[Path], object], says: str, folder: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(folder, tmp_path / "out"))
    damage(out)
    done = CliRunner().invoke(app, ["verify", str(out), "--verdicts", "none", "--quiet"])
    assert done.exit_code == (SOME_FAILED if says else DONE), done.output
    assert says in done.stdout
    assert len(done.stdout.splitlines()) == (2 if says else 1)


def test_of_an_older_folder_the_other_files_are_unknown(folder: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(folder, tmp_path / "out"))
    (out / CHECKSUMS).unlink()
    found = read_manifest(RunFolder(str(out)))
    assert found is not None
    write_manifest(RunFolder(str(out)), found)
    done = CliRunner().invoke(app, ["verify", str(out), "--verdicts", "none", "--quiet"])
    assert done.exit_code == SOME_FAILED
    assert "not known to be whole" in done.stdout
    assert "published by an older version" in done.stdout


def test_a_manifest_that_is_written_again_keeps_the_checksums_of_the_other_files(folder: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(folder, tmp_path / "out"))
    before = (out / CHECKSUMS).read_bytes()
    edited("README.md")(out)
    found = read_manifest(RunFolder(str(out)))
    assert found is not None
    write_manifest(RunFolder(str(out)), found)
    assert (out / CHECKSUMS).read_bytes() == before


@pytest.mark.parametrize("out", ["s3://bucket/name", "hf://datasets/somebody/name", "file:///data/x"])
def test_the_address_of_a_store_is_refused(out: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = published(run, out)
    assert done.exit_code == NOT_STARTED
    (line,) = done.stderr.splitlines()
    assert f"{out}: is the address of a store, expected a local folder" in line
    assert not list(tmp_path.iterdir())


def test_what_a_killed_call_left_is_removed(run: Path, tmp_path: Path) -> None:
    stale, other = tmp_path / ".o[u]t.tmp-123", tmp_path / ".other.tmp-123"
    for path in (stale / "scenes", other):
        path.mkdir(parents=True)
    (stale / "scenes" / "part-train.00000.parquet").write_bytes(b"PAR1")
    with (stale / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = published(run, tmp_path / "o[u]t")
        assert done.exit_code == NOT_STARTED
        assert "another process is writing it" in done.stderr
        assert stale.exists()
    assert published(run, tmp_path / "o[u]t").exit_code == DONE
    assert sorted(path.name for path in tmp_path.iterdir()) == [other.name, "o[u]t"]
    assert not list((tmp_path / "o[u]t").rglob(".*"))


# --- splits -------------------------------------------------------------------------------------------------------------------


def test_names_of_splits_are_those_that_hubs_allow() -> None:
    names, odd = SplitNames(), ["train", "Train", "", None, "all", "hold out!", "../x", UNSPLIT, "a.b", "a_b", "é", "x" * 99]
    found = [names.of(split) for split in odd]
    assert found[:6] == ["train", "Train_2", UNSPLIT, UNSPLIT, "all_2", "hold_out"]
    assert all(name.isascii() and name.replace("_", "").isalnum() and len(name) <= 42 for name in found)
    assert len({name.casefold() for name in found}) == len(found) - 1  # null and empty are one
    assert [names.of(split) for split in odd] == found


def test_odd_splits_and_rows_without_one_are_loaded(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))

    def change(found: list[Row]) -> None:
        found[0] |= {"split": None}
        found[-1] |= {"split": "all" if len(found) > 1 else None}

    rows("scenes", change)(copy)
    done = published(copy, tmp_path / "out", "--unverified")
    assert done.exit_code == DONE, done.output
    monkeypatch.setenv("HF_DATASETS_OFFLINE", "1")
    found = load_dataset(str(tmp_path / "out"), "scenes", cache_dir=str(tmp_path / "cache"))
    counts = {name: split.num_rows for name, split in found.items()}
    assert UNSPLIT in counts or set(counts) == {"train"}
    assert sum(counts.values()) == RunFolder(str(copy)).num_rows("scenes")
    assert "all" not in counts


# --- licences -----------------------------------------------------------------------------------------------------------------


def test_the_head_names_a_licence_only_if_all_content_has_it(run: Path, folder: Path, tmp_path: Path) -> None:
    def head(out: Path) -> dict[str, Any]:
        found: dict[str, Any] = yaml.safe_load((out / "README.md").read_text("utf-8").split("---\n", 2)[1])
        return {key: value for key, value in found.items() if key.startswith("license")}

    assert head(folder) == {
        "license": "other",
        "license_name": "not-stated-for-the-rows-and-apache-2.0",
        "license_link": "ATTRIBUTION.md",
    }
    assert published(run, tmp_path / "out", "--licence", "Apache-2.0").exit_code == DONE
    assert head(tmp_path / "out") == {"license": "apache-2.0"}


@pytest.mark.parametrize(
    ("licence", "text", "expected"),
    [
        ("CC0-1.0", None, "CC0-1.0"),
        ("CC0-1.0", "see the page of the author", "CC0-1.0"),
        ("CC0-1.0", "for research only", None),
        ("CC0-1.0", "CC BY-NC 4.0", None),
        (None, "CC BY 4.0", "CC-BY-4.0"),
        ("for research only", "CC BY 4.0", None),
        ("MIT", "Code: MIT License. Meshes: CC BY-SA 4.0", None),
        ("CC0-1.0", "CC BY 3.0 and CC BY 4.0", None),
        ("CC0-1.0", "the licence of the store", None),
        ("CC-BY", "CC BY 3.0 and CC BY 4.0", None),
        ("MIT", "MIT License", "MIT"),
        ("Apache-2.0", "made by a limited company in a permitted place", "Apache-2.0"),
        ("CC-BY-4.0", "https://creativecommons.org/licenses/by/4.0/", "CC-BY-4.0"),
    ],
)
def test_a_licence_is_known_only_if_its_text_agrees(
    licence: str | None, text: str | None, expected: str | None, tmp_path: Path
) -> None:
    row = {"asset_id": "cup", "category": "cup", "licence": licence, "licence_text": text}
    RunFolder(str(tmp_path)).write_table("assets", "0" * 16, pa.Table.from_pylist([row], schema=SCHEMAS["assets"]))
    assert [one.licence for one in asset_licences(RunFolder(str(tmp_path)))] == [expected]


# --- what is private ----------------------------------------------------------------------------------------------------------


def test_texts_in_structs_and_lists_are_changed_too() -> None:
    row = {"scene_id": "a", "dropped": [{"instance": "cup_0", "reason": "/home/alice/cup.glb is odd"}], "reason": None}
    table = pa.Table.from_pylist([row], schema=SCHEMAS["turns"])
    changed = rows_without_folders(table)
    assert changed.schema.equals(table.schema, check_metadata=True)
    assert changed.to_pylist()[0]["dropped"][0]["reason"] == "cup.glb is odd"
    same = pa.Table.from_pylist([{"scene_id": "a/b", "reply": r"{\n\tx}"}], schema=SCHEMAS["turns"])
    assert rows_without_folders(same).equals(same)


def test_no_file_of_a_published_run_has_a_private_path(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    path = f"/home/{SOMEBODY}/secret project/data/cup.glb"

    def scenes(found: list[Row]) -> None:
        found[0] |= {"layout_path": path, "source_json": json.dumps({"file": f"/home/{SOMEBODY}/a.json"})}
        found[0]["objects"][0]["source_json"] = json.dumps({"uid": f"/home/{SOMEBODY}/x"})

    def turns(found: list[Row]) -> None:
        found[0] |= {"reason": f"see /home/{SOMEBODY}", "reply": json.dumps({"note": f"/home/{SOMEBODY}/x/y"})}
        found[0]["dropped"] = [{"instance": "cup_0", "reason": f"/home/{SOMEBODY}/data/cup.glb cannot be read"}]

    def assets(found: list[Row]) -> None:
        found[0] |= dict.fromkeys(("licence_where", "source_path"), path) | {"source_url": f"file://{path}"}

    for table, change in (("scenes", scenes), ("turns", turns), ("assets", assets)):
        rows(table, change)(copy)

    def settings(document: dict[str, Any]) -> None:
        document["settings"] |= {"engine": f"transformers:/home/{SOMEBODY}/models/qwen", "weights": f"/home/{SOMEBODY}"}
        document |= {"dataset": path, "note": [f"C:\\Users\\{SOMEBODY}"], "command": f"stable-data {path}"}

    manifest(settings)(copy)
    done = published(copy, tmp_path / "out", "--unverified")
    assert done.exit_code == DONE, done.output
    found = RunFolder(str(tmp_path / "out"))
    texts = {path: path.read_text("utf-8") for path in (tmp_path / "out").rglob("*") if path.suffix in (".json", ".md")}
    texts |= {
        tmp_path / table: str(found.table(table).to_pylist()) for table in ("scenes", "turns", "assets", "failures", "warnings")
    }
    texts[tmp_path / "licences"] = str(pq.read_table(tmp_path / "out" / "licences.parquet").to_pylist())
    texts |= {path: path.read_bytes().decode("latin1") for path in (tmp_path / "out").rglob("*.png")}
    for place, text in texts.items():
        assert SOMEBODY not in text.replace("secret project", ""), place
        assert str(tmp_path) not in text, place


PRIVATE = "the diary of somebody"


def png(**options: Any) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (40, 30), (10, 200, 30)).save(stream, "png", **options)
    return stream.getvalue()


def with_sheet(run: Path, folder: Path, content: bytes) -> Path:
    copy = Path(shutil.copytree(run, folder / "run"))
    (copy / "report").mkdir(exist_ok=True)
    (copy / SHEET).write_bytes(content)
    return copy


def test_a_sheet_that_is_no_picture_is_not_published(run: Path, tmp_path: Path) -> None:
    copy = with_sheet(run, tmp_path, PRIVATE.encode())
    assert published(copy, tmp_path / "out").exit_code == DONE
    assert not (tmp_path / "out" / "previews" / "contact_sheet.png").exists()
    assert all(PRIVATE.encode() not in path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file())


@pytest.mark.parametrize("content", [png()[:60], png() * 0, b"BM" + b"0" * 80])
def test_a_damaged_sheet_is_left_out(content: bytes, run: Path, tmp_path: Path) -> None:
    found = previews(RunFolder(str(with_sheet(run, tmp_path, content))))
    assert f"{FOLDER}/contact_sheet.png" not in found


def test_of_a_sheet_the_pixels_alone_are_published(run: Path, tmp_path: Path) -> None:
    notes = PngInfo()
    notes.add_text("author", PRIVATE)
    content = png(pnginfo=notes) + PRIVATE.encode()
    assert content.count(PRIVATE.encode()) == 2
    found = previews(RunFolder(str(with_sheet(run, tmp_path, content))))
    assert found == {f"{FOLDER}/contact_sheet.png": png()}


def test_stored_pictures_are_encoded_again(tmp_path: Path) -> None:
    folder = RunFolder(str(tmp_path))
    pictures = [PRIVATE.encode(), png() + PRIVATE.encode(), None]
    kinds = {field.name: None for field in SCHEMAS["views"]}
    view = {field.name: None for field in SCHEMAS["views"].field("views").type.value_type}
    listed = [kinds | {"scene_id": f"a{k}", "views": [view | {"picture": one}]} for k, one in enumerate(pictures)]
    folder.write_table("views", "0" * 16, pa.Table.from_pylist([*listed, kinds], schema=SCHEMAS["views"]))
    assert previews(folder) == {f"{FOLDER}/0.png": png()}


def linked_out(name: str) -> Callable[[Path, Path], str]:
    """Puts a file or a folder of a run elsewhere, and a link in its place."""

    def change(run: Path, elsewhere: Path) -> str:
        shutil.move(run / name, elsewhere)
        (run / name).symlink_to(elsewhere)
        return name

    return change


def shard_linked_out(run: Path, elsewhere: Path) -> str:
    path = next((run / "scenes").glob("part-*.parquet"))
    return linked_out(f"scenes/{path.name}")(run, elsewhere)


@pytest.mark.parametrize(
    ("change", "is_verified"),
    [
        (shard_linked_out, True),
        (linked_out("meshes"), True),
        (linked_out("manifest.json"), True),
        (linked_out(CHECKSUMS), True),
        (linked_out(SHEET), False),
        (linked_out("report"), False),
    ],
)
def test_links_out_of_a_run_are_told_and_refused(
    change: Callable[[Path, Path], str], is_verified: bool, run: Path, tmp_path: Path
) -> None:
    copy = with_sheet(run, tmp_path, png())
    name = change(copy, tmp_path / "elsewhere")
    done = published(copy, tmp_path / "out", "--unverified")
    assert done.exit_code == NOT_STARTED
    assert f"{name}" in done.stderr
    assert "is a link out of the run" in done.stderr
    assert not (tmp_path / "out").exists()
    if is_verified:
        done = CliRunner().invoke(app, ["verify", str(copy), "--verdicts", "none", "--quiet"])
        assert done.exit_code == SOME_FAILED
        assert "is a link out of the run" in done.stdout


def test_links_of_a_published_folder_are_told(folder: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(folder, tmp_path / "out"))
    linked_out("README.md")(out, tmp_path / "elsewhere")
    (out / "round").symlink_to(out)
    done = CliRunner().invoke(app, ["verify", str(out), "--verdicts", "none", "--quiet"])
    assert done.exit_code == SOME_FAILED
    assert "README.md: is a link out of the run" in done.stdout
    assert f"round: is not in {CHECKSUMS}" in done.stdout


def test_a_run_behind_a_link_is_published(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    shard = next((copy / "scenes").glob("part-*.parquet"))
    (copy / "kept").mkdir()
    shard.rename(copy / "kept" / "shard")
    shard.symlink_to("../kept/shard")  # it stays in the run
    (tmp_path / "link").symlink_to(copy)
    assert published(tmp_path / "link", tmp_path / "out").exit_code == DONE


# --- Croissant ----------------------------------------------------------------------------------------------------------------


def test_croissant_has_what_its_specification_requires(folder: Path) -> None:
    document = json.loads((folder / "croissant.json").read_text("utf-8"))
    for name in ("@context", "@type", "conformsTo", "name", "description", "license", "url", "creator", "datePublished"):
        assert document[name], name
    assert document["version"] == "1.2.0"
    assert document["creator"] == [
        {"@type": "sc:Person", "name": "A. Person"},
        {"@type": "sc:Organization", "name": "A Lab"},
    ]
    assert document["license"] == [
        {"@type": "sc:CreativeWork", "name": "not stated for the rows"},
        "https://spdx.org/licenses/Apache-2.0.html",
    ]
    assert missing_entries(document) == []


def test_what_croissant_lacks_is_said(run: Path, tmp_path: Path) -> None:
    done = published(run, tmp_path / "out")
    assert done.exit_code == DONE
    assert "croissant.json lacks creator (--creator or --organization) and url (--url)" in done.stderr


@pytest.mark.parametrize("licence", ["CC-BY", "CC-BY-NC-SA", "not known"])
def test_a_licence_without_a_version_has_no_address(licence: str) -> None:
    document = croissant_document("t", "t", [licence, "CC-BY-SA-4.0", "MIT"], [], [])
    assert document["license"] == [
        {"@type": "sc:CreativeWork", "name": licence},
        "https://spdx.org/licenses/CC-BY-SA-4.0.html",
        "https://spdx.org/licenses/MIT.html",
    ]
