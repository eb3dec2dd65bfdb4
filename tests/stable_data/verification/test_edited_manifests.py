"""verify says what is wrong with a manifest, whatever it contains, and fails on none."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.commands.command_line import SOME_FAILED
from stable_data.errors import ConfigError
from stable_data.limits import MIB
from stable_data.storage.checksums import CHECKSUMS, read_checksums
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.evaluation_folder import EVALUATION, is_evaluation, verify_evaluation
from stable_data.verification.verifier import VerifyOptions
from tests.bounds import limit, little_memory
from tests.stable_data.verification.editing import small_run

HUGE = 10**400  # an integer that no float holds
SHARES = {"seed": 0, "train_share": 0.9, "validation_share": 0.05}
PLAN = {"table": "scenes", "column": "scene_id", "count": 4, "digest": ""}

EDITS: dict[str, dict[str, Any]] = {
    "half a surrogate pair": {"code_version": "\ud800"},
    "half a surrogate pair in a list": {"planned": ["\ud800"]},
    "half a surrogate pair as a key": {"counts": {"\ud800": 1}},
    "a share that no float holds": {"job": "preprocess", "settings": SHARES | {"train_share": HUGE}},
    "a share that is text": {"job": "preprocess", "settings": SHARES | {"validation_share": "0.05"}},
    "a seed that is null": {"job": "preprocess", "settings": SHARES | {"seed": None}},
    "the job of an origin is a list": {"job": "publish", "origin": {"job": ["generate"], "settings": {"judges": "mujoco"}}},
    "an origin of text": {"job": "publish", "origin": "generate"},
    "an origin without settings": {"job": "publish", "origin": {"job": "generate", "settings": None, "planned": 3}},
    "a rule that is a number": {"settings": {"accept": 3, "keep_settled": "yes"}},
    "settings that are a list": {"settings": [["accept", "clean"]]},
    "a job that is null": {"job": None},
    "a version that is huge": {"table_version": HUGE},
    "a version that is a list": {"table_version": [3], "upgraded_to": {}},
    "counts that are text": {"counts": "many"},
    "counts of lists": {"counts": {"scenes": [2], "failures_by_code": [1], "turns": None}},
    "counts that are huge": {"counts": {"scenes": HUGE, "warnings_by_code": {"x": HUGE}}},
    "checksums that are text": {"checksums": "none"},
    "a hash that is a number": {"checksums": {"sha256": 3}, "digest": 7},
    "versions of code that are a mapping": {"code_versions": {"a": None}, "inputs": None},
    "a plan of numbers": {"planned": [1, None, "scenes"]},
    "a plan without a table": {"planned": [{"column": "scene_id"}]},
    "a plan of a huge number": {"planned": [PLAN | {"count": HUGE}]},
    "a plan of numbers of scenes": {"planned": [PLAN | {"column": "num_objects"}]},
    "a plan of bytes": {"planned": [PLAN | {"table": "meshes", "column": "glb"}]},
    "a plan of structs": {"planned": [PLAN | {"column": "objects"}]},
    "a plan below text": {"planned": [PLAN | {"column": "scene_id.x.y"}]},
    "a plan of an unknown table": {"planned": [PLAN | {"table": "nothing"}]},
    "an encoder that is a list": {"encoder": [1], "pruned": 3},
}

RAW = {
    "nested too deep": b'{"job": ' + b"[" * 100_000,
    "nested too deep, and closed": b'{"job": "generate", "a": ' + b"[" * 900 + b"]" * 900 + b"}",
    "digits without end": b'{"job": "generate", "table_version": ' + b"9" * 6000 + b"}",
    "a number out of range": b'{"job": "generate", "counts": 1e999, "table_version": NaN}',
    "other bytes": b"\xff\xfe{",
    "null": b"null",
    "a list": b"[]",
    "nothing": b"",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without the tables whose checks take time and know nothing of the manifest. Each test writes its manifest."""
    found = small_run(tmp_path_factory.mktemp("small"))
    for table in ("assets", "meshes", "settled", "turns"):
        shutil.rmtree(found / table)
    return found


@pytest.fixture(scope="module")
def document(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "manifest.json").read_text("utf-8"))
    return found


def check_found(run: Path, content: bytes, where: str = "manifest.json") -> None:
    (run / "manifest.json").write_bytes(content)
    done = CliRunner().invoke(app, ["verify", str(run), "--verdicts", "audit", "--quiet"], catch_exceptions=False)
    assert (done.exit_code, done.stderr) == (SOME_FAILED, ""), done.output
    assert any(line.startswith(f"{where}: ") for line in done.stdout.splitlines()), done.stdout
    assert max(map(len, done.stdout.splitlines())) < 3000
    assert "damaged: " in done.stdout.splitlines()[-1]


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_entry_is_damage(name: str, run: Path, document: dict[str, Any]) -> None:
    check_found(run, json.dumps(document | EDITS[name]).encode())


@pytest.mark.parametrize("entry", ["job", "inputs", "settings", "counts", "table_version", "status", "checksums"])
def test_a_missing_entry_is_damage(entry: str, run: Path, document: dict[str, Any]) -> None:
    found = {key: value for key, value in document.items() if key != entry}
    check_found(run, json.dumps(found).encode())


def test_without_a_digest_as_if_the_run_were_older_other_checksums_are_still_found(run: Path, document: dict[str, Any]) -> None:
    found = {key: value for key, value in document.items() if key != "digest"} | {"checksums": {"files": 1, "sha256": "0" * 64}}
    check_found(run, json.dumps(found).encode(), "SHA256SUMS")


@pytest.mark.parametrize("name", RAW)
def test_a_manifest_that_is_none_is_damage(name: str, run: Path, document: dict[str, Any]) -> None:
    check_found(run, RAW[name])


@pytest.mark.parametrize("content", [*RAW.values(), b'{"systems": {"a": {"repetitions": "\\ud800"}}}', b'{"systems": 3}'])
def test_an_odd_evaluation_is_damage(content: bytes, tmp_path: Path) -> None:
    (tmp_path / EVALUATION).write_bytes(content)
    told = list[str]()
    (found,) = verify_evaluation(RunFolder(str(tmp_path)), lambda finding: told.append(str(finding)), VerifyOptions())
    assert not found.is_whole
    assert told


@pytest.mark.parametrize("content", [b"\xff\xfe", b"", b"0" * 64 + b"  ../../etc/passwd\n", b"0" * 64 + b"  x" * 10_000])
def test_odd_checksums_are_damage(content: bytes, run: Path, document: dict[str, Any], tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    (copy / "manifest.json").write_text(json.dumps(document), "utf-8")
    (copy / CHECKSUMS).write_bytes(content)
    done = CliRunner().invoke(app, ["verify", str(copy), "--verdicts", "none", "--quiet"], catch_exceptions=False)
    assert done.exit_code == SOME_FAILED
    assert CHECKSUMS in done.stdout


def test_a_finding_of_a_very_long_name_is_a_line_of_a_bounded_length(
    run: Path, document: dict[str, Any], tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    (copy / "manifest.json").write_text(json.dumps(document), "utf-8")
    with (copy / CHECKSUMS).open("a") as file:
        file.write(f"{'0' * 64}  turns/part-{'c' * 16}{'-c' * 5000}.parquet\n")
    done = CliRunner().invoke(app, ["verify", str(copy), "--verdicts", "none", "--quiet"], catch_exceptions=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("turns/part-cccc")]
    assert lines
    assert max(map(len, lines)) < 3000


def write_sparse(path: Path) -> None:
    """A file of 400 MB that takes no space."""
    with path.open("wb") as file:
        file.truncate(400 * MIB)


def test_huge_checksums_are_damage_and_are_not_read_whole(run: Path, document: dict[str, Any], tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    (copy / "manifest.json").write_text(json.dumps(document), "utf-8")
    words = ["verify", str(copy), "--verdicts", "none", "--quiet"]
    write_sparse(copy / CHECKSUMS)
    with little_memory(300 * MIB):
        done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == SOME_FAILED, done.output
    (line,) = (line for line in done.stdout.splitlines() if line.startswith(f"{CHECKSUMS}: "))
    assert "is larger, expected at most 67,108,864 bytes (text.max_checksum_bytes in STABLE_DATA_LIMITS)" in line


def test_checksums_of_empty_lines_take_little_memory(tmp_path: Path) -> None:
    (tmp_path / CHECKSUMS).write_bytes(b"\n" * (64 * MIB))
    with little_memory(200 * MIB), pytest.raises(ConfigError, match="line 1 is"):
        read_checksums(RunFolder(str(tmp_path)))


def test_a_huge_evaluation_is_damage_and_is_not_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "text", max_document_bytes=MIB)
    (tmp_path / "seed_0" / "stable" / "scenes").mkdir(parents=True)
    for name in (EVALUATION, "seed_0/stable/scenes/manifest.json"):
        write_sparse(tmp_path / name)
    told, folder = list[str](), RunFolder(str(tmp_path))
    with little_memory(200 * MIB):
        assert is_evaluation(folder)
        found = list(verify_evaluation(folder, lambda finding: told.append(str(finding)), VerifyOptions()))
    assert [one.is_whole for one in found] == [False, False]
    assert [line.partition(": ")[0] for line in told] == [EVALUATION, "seed_0/stable/scenes/manifest.json"]
    assert all("text.max_document_bytes" in line for line in told)
