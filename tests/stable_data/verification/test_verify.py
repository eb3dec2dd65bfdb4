"""verify finds every way in which a run can be damaged, and nothing in a run that is whole."""

import shutil
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.commands.command_line import DONE, NOT_STARTED, SOME_FAILED
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import ConfigError
from stable_data.extras import EXTRA_OF_MODULE
from stable_data.storage.checksums import CHECKSUMS, read_checksums
from stable_data.storage.manifest import read_manifest, write_manifest
from stable_data.storage.run_changes import prune, upgrade
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.subset import select
from stable_data.verification.column_rules import RULES
from stable_data.verification.findings import Finding
from stable_data.verification.joined_checks import ScenesOfShards
from stable_data.verification.known_ids import KEYS
from stable_data.verification.manifest_checks import CountCheck
from stable_data.verification.shard_files import ShardFile
from stable_data.verification.verifier import Verdicts, Verification, VerifyOptions, verify_run
from tests.bounds import limit, soon
from tests.object_store import object_store
from tests.stable_data.verification.damages import (
    BY_CHECKSUM,
    BY_CONTENT,
    BY_VERDICT,
    OF_CORRECTIONS,
    OF_FEATURES,
    OF_SAMPLES,
    OF_STAGES,
    OF_TEXTURES,
    OLDER_RUNS,
    TOGETHER,
)
from tests.stable_data.verification.editing import Damage, files_of, hide, manifest, rows, small_run, write_equal_rows


def verified(
    run: Path, *, verdicts: Verdicts = "none", sample: int = 0, source: Path | None = None
) -> tuple[Verification, list[Finding]]:
    found = list[Finding]()
    options = VerifyOptions(sample, verdicts=verdicts, source=None if source is None else RunFolder(str(source)))
    return verify_run(RunFolder(str(run)), found.append, options), found


def check(run: Path, tmp_path: Path, damage: Damage, where: str, what: str, verdicts: Verdicts = "none") -> None:
    """Damages a copy of a run, and checks that it is found."""
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    damage(copy)
    result, found = verified(copy, verdicts=verdicts)
    assert not result.is_whole
    assert any(f.where.startswith(where) and what in f.what for f in found), [str(f) for f in found]
    assert "damaged" in str(result)


@pytest.mark.parametrize("name", BY_CHECKSUM)
def test_what_a_disk_does_is_found(name: str, generated: Path, tmp_path: Path) -> None:
    check(generated, tmp_path, *BY_CHECKSUM[name])


@pytest.mark.parametrize("name", BY_CONTENT)
def test_damage_with_fitting_checksums_is_found(name: str, generated: Path, tmp_path: Path) -> None:
    check(generated, tmp_path, *BY_CONTENT[name])


@pytest.mark.sim
@pytest.mark.parametrize("name", BY_VERDICT)
def test_an_edited_verdict_is_found(name: str, generated: Path, tmp_path: Path) -> None:
    check(generated, tmp_path, *BY_VERDICT[name], verdicts="all")


@pytest.mark.parametrize("name", OF_TEXTURES)
def test_damaged_assets_are_found(name: str, imported: Path, tmp_path: Path) -> None:
    check(imported, tmp_path, *OF_TEXTURES[name])


@pytest.mark.parametrize("name", OF_SAMPLES)
def test_damaged_samples_and_grids_are_found(name: str, clean_run: Path, tmp_path: Path) -> None:
    check(clean_run, tmp_path, *OF_SAMPLES[name])


def test_damage_in_many_places_is_found_everywhere(clean_run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(clean_run, tmp_path / "run"))
    for damage, _, _ in TOGETHER.values():
        damage(copy)
    _, found = verified(copy)
    for name, (_, where, what) in TOGETHER.items():
        assert any(f.where.startswith(where) and what in f.what for f in found), name


@pytest.fixture(scope="module")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of preprocess with features, and with two tasks of each of two scenes."""
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.preprocess.job import preprocess
    from tests.pipelines.runs import SMALL

    root = tmp_path_factory.mktemp("encoded")
    write_world(root / "data", 2, EmbeddedWorld(seed=3, pictures=False))
    out = root / "run"
    preprocess(str(root / "data"), str(out), replace(SMALL, features="auto", tasks_per_scene=2), WorkerPool())
    assert verified(out)[0].is_whole
    return out


@pytest.mark.parametrize("name", OF_FEATURES)
def test_damaged_features_and_further_tasks_are_found(name: str, encoded: Path, tmp_path: Path) -> None:
    check(encoded, tmp_path, *OF_FEATURES[name])


@pytest.mark.parametrize("name", OF_STAGES)
def test_stages_and_reports_are_computed_again(name: str, clean_run: Path, tmp_path: Path) -> None:
    check(clean_run, tmp_path, *OF_STAGES[name], verdicts="audit")


@pytest.fixture(scope="module")
def corrected(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of correct over ``generated``."""
    from pipelines.correct.job import correct
    from pipelines.correct.settings import CorrectSettings
    from pipelines.execution.ray_executor import WorkerPool

    out = tmp_path_factory.mktemp("corrected") / "run"
    correct(str(generated), str(out), CorrectSettings(weights="none", scenes_per_shard=2, num_pictures=0), WorkerPool())
    return out


@pytest.mark.parametrize("name", OF_CORRECTIONS)
def test_damaged_corrections_are_found(name: str, corrected: Path, tmp_path: Path) -> None:
    check(corrected, tmp_path, *OF_CORRECTIONS[name])


def test_scenes_are_read_once_for_all_rows_of_their_shard(generated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    once, read = ScenesOfShards._scenes_of, list[str]()

    def scenes_of(scenes: ScenesOfShards, file: ShardFile) -> Any:
        read.append(file.name)
        return once(scenes, file)

    monkeypatch.setattr(ScenesOfShards, "_scenes_of", scenes_of)
    assert verified(generated)[0].is_whole
    assert len(read) == len(set(read)) > 3


@pytest.mark.sim
def test_a_whole_run_is_whole(generated: Path, imported: Path, clean_run: Path) -> None:
    for run in (generated, imported, clean_run):
        result, found = verified(run, verdicts="all")
        assert (result.is_whole, found) == (True, []), (str(result), list(map(str, found)))
        assert result.num_checked == result.num_files > 0
    assert (result.num_scenes, result.num_audited, result.num_simulated) == (4, 4, 0)  # preprocess does not simulate


def test_very_many_rows_of_a_small_file_take_little_memory(tmp_path: Path) -> None:
    run, many = small_run(tmp_path), 4_000_000
    write_equal_rows(run, "failures", many)
    assert sum(path.stat().st_size for path in files_of(run, "failures")) < 100_000
    was, pool = pa.default_memory_pool(), pa.proxy_memory_pool(pa.default_memory_pool())
    pa.set_memory_pool(pool)
    try:
        result, found = verified(run)
        counts = RunFolder(str(run)).count_values("failures", ["code"])["code"]
    finally:
        pa.set_memory_pool(was)
    assert (result.rows["failures"], counts) == (many, {"": many})
    assert any("by the rows" in each.what for each in found)
    assert (pool.max_memory() or 0) < 16 * 2**20


def test_rows_that_are_far_larger_than_their_file_are_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A text of 10 kB that a hundred thousand rows have: a gigabyte, of which no more than the limit is looked at."""
    run = small_run(tmp_path)
    write_equal_rows(run, "failures", 100_000, "x" * 10_000)
    assert sum(path.stat().st_size for path in files_of(run, "failures")) < 100_000
    limit(monkeypatch, "table", max_decoded_bytes=20 * 10**6)
    with soon(5.0):
        result, found = verified(run)
    assert not result.is_whole
    assert any("its rows have more than 20,000,000 bytes" in each.what for each in found), found
    assert result.rows["failures"] < 2_000


def test_lists_that_are_far_larger_than_their_file_are_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = small_run(tmp_path)
    [path] = files_of(run, "scenes")
    rows = pq.read_table(path)
    names = pa.array([["x" * 10_000] * 5000] * len(rows), rows.schema.field("fixed").type)
    pq.write_table(rows.set_column(rows.schema.get_field_index("fixed"), rows.schema.field("fixed"), names), path)
    limit(monkeypatch, "table", max_decoded_bytes=20 * 10**6)
    _, found = verified(run)
    assert any("the lists of a row group may need" in each.what for each in found), found


def test_there_are_many_ways_to_damage_a_run() -> None:
    of_preprocess = (OF_SAMPLES, TOGETHER, OF_FEATURES, OF_STAGES)
    assert sum(map(len, (BY_CHECKSUM, BY_CONTENT, BY_VERDICT, OF_TEXTURES, OF_CORRECTIONS, *of_preprocess))) >= 180


# --- what is unknown ----------------------------------------------------------------------------------------------------------


def test_an_older_run_is_not_known_to_be_whole(tmp_path: Path) -> None:
    result, found = verified(OLDER_RUNS / "generate")
    assert (result.is_whole, found) == (False, [])
    line = str(result)
    assert "not known to be whole" in line
    assert all(word in line for word in ("no digest", "no checksums"))
    copy = Path(shutil.copytree(OLDER_RUNS / "generate", tmp_path / "run"))
    assert upgrade(RunFolder(str(copy))).num_files == 0  # its tables are of the present version, and it gets checksums
    result, found = verified(copy)
    assert (result.is_whole, found) == (True, []), str(result)


@pytest.mark.parametrize("version", ["run_v1", "run_v2"])
def test_an_upgraded_run_is_whole(version: str, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(OLDER_RUNS.parent / version, tmp_path / "run"))
    RunFolder(str(copy)).write_shard("sdf", "0" * 16, [])
    result, found = verified(copy)
    assert (result.is_whole, found) == (False, [])  # it is older, and not damaged
    assert str(result).count("run stable-data upgrade RUN") == 1
    assert upgrade(RunFolder(str(copy))).num_files > 0
    manifest = read_manifest(RunFolder(str(copy)))
    assert manifest is not None
    manifest["counts"]["sdf"] = 0
    write_manifest(RunFolder(str(copy)), manifest)
    result, found = verified(copy, verdicts="audit")
    assert all("has no grid at the aspect" in each.what for each in found)  # the stored runs lack their grids
    assert (list(result.num_damaged), result.unknown, result.num_audited) == (["sdf"], (), 2), str(result)


def test_a_scene_whose_last_stage_was_left_out_was_corrected_again(generated: Path, tmp_path: Path) -> None:
    def left_out(found: list[Row]) -> list[Row]:
        name = next(row["scene_id"] for row in found if row["corrected"])
        last = max((row for row in found if row["scene_id"] == name), key=lambda row: row["turn"])
        failed = last | {"turn": last["turn"] + 1, "stage": "important", "code": "empty", "reply": None, "dropped": []}
        failed |= dict.fromkeys(("coarse", "corrected", "card_before", "card_after"))
        last["corrected"][0]["position"][0] += 0.001
        place = found.index(last) + 1
        return [*found[:place], failed, *found[place:]]

    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    rows("turns", left_out, recounts=True)(copy)
    result, found = verified(copy)
    assert (result.is_whole, found) == (True, []), list(map(str, found))


def test_layouts_of_another_system_have_no_turns(generated: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    for _ in range(len(files_of(copy, "turns"))):
        rows("turns", lambda found: [], recounts=True)(copy)
    assert {f.where for f in verified(copy)[1]} == {"turns"}
    manifest(lambda document: document["settings"].update(layout="files"))(copy)
    result, found = verified(copy)
    assert (result.is_whole, found) == (True, []), str(result)


def test_only_what_was_accepted_is_compared_with_the_scene(generated: Path, tmp_path: Path) -> None:
    """The last attempt at a stage may be worse than an earlier one, which is then in the scene."""

    def tried_again(found: list[Row]) -> list[Row]:
        name = next(row["scene_id"] for row in found if row["corrected"])
        last = max((row for row in found if row["scene_id"] == name), key=lambda row: row["turn"])
        again = deepcopy(last) | {"turn": last["turn"] + 1, "code": "relation_lost", "reason": "a relation does not hold"}
        again["corrected"][0]["position"][0] += 0.1
        place = found.index(last) + 1
        return [*found[:place], again, *found[place:]]

    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    rows("turns", tried_again, recounts=True)(copy)
    result, found = verified(copy)
    assert (result.is_whole, found) == (True, []), list(map(str, found))


@pytest.mark.parametrize(("table", "column"), [("scenes", "task_kind"), ("assets", "geometry_hash"), ("turns", "code")])
def test_text_that_is_not_utf_8_is_damage(table: str, column: str, tmp_path: Path) -> None:
    run = small_run(tmp_path)
    for path in files_of(run, table):
        found = pq.read_table(path)
        odd = pa.array([b"\xff\xfe"] * len(found), pa.binary())
        values = pa.StringArray.from_buffers(len(odd), odd.buffers()[1], odd.buffers()[2])
        number = found.schema.get_field_index(column)
        pq.write_table(found.set_column(number, found.schema.field(number), values), path)
    hide(run)
    found_damage = verified(run)[1]
    assert any(f.where.startswith(f"{table}/") and "Invalid UTF8" in f.what for f in found_damage), found_damage
    assert not any("UnicodeDecodeError" in f.what for f in found_damage)  # it is said once, where it is


def test_a_value_that_no_check_expects_ends_no_verification(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = small_run(tmp_path)
    monkeypatch.setattr(CountCheck, "note", Mock(side_effect=KeyError("gone")))
    assert {"cannot be checked: KeyError: 'gone'"} <= {f.what for f in verified(run)[1]}


def test_an_unfinished_run_is_not_whole(generated: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    found = read_manifest(RunFolder(str(copy)))
    assert found is not None
    files_of(copy, "turns")[0].unlink()
    write_manifest(
        RunFolder(str(copy)), {k: v for k, v in found.items() if k not in ("counts", "planned")} | {"status": "running"}
    )
    result, findings = verified(copy)
    assert not result.is_whole
    assert not result.is_finished
    assert findings == []
    assert "not finished" in str(result)


@pytest.mark.parametrize(
    "lost",
    [
        {"assets": None, "meshes": None, "scenes": 1, "rejected": 1},  # killed in the step of the scenes
        {"assets": None, "meshes": 1},  # in the step of the assets
        {"meshes": None},  # between assets and meshes
        {"assets": None},
    ],
)
def test_a_killed_run_is_not_damaged(lost: dict[str, int | None], generated: Path, tmp_path: Path) -> None:
    """Whatever shards are still to be made; ``lost``: the number of files of a table that are, None for all."""
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    for table, count in lost.items():
        for path in sorted((copy / table).glob("part-*"))[:count]:
            path.unlink()
    found = read_manifest(RunFolder(str(copy)))
    assert found is not None
    write_manifest(
        RunFolder(str(copy)), {k: v for k, v in found.items() if k not in ("counts", "planned")} | {"status": "running"}
    )
    result, findings = verified(copy)
    assert (result.is_finished, list(map(str, findings))) == (False, [])
    assert str(result).startswith(f"{copy}: not finished (generate; ")


@pytest.mark.parametrize("hidden", [{"networkx", "scipy"}, pytest.param({"mujoco"}, marks=pytest.mark.slow)])
def test_without_the_extras_verdicts_are_unknown(hidden: set[str], generated: Path) -> None:
    """With the base dependencies alone all else is checked, and the line says what is not."""
    missing = [name for name in EXTRA_OF_MODULE if name in hidden or "networkx" in hidden]
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({missing})); from stable_data.cli import app; "
        f"app(['verify', {str(generated)!r}, '--quiet', *sys.argv[1:]])"
    )

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", code, *more], capture_output=True, text=True)

    done = run("--sample", "1")
    assert done.returncode == SOME_FAILED, done.stderr
    assert "not known to be whole" in done.stdout
    assert "pip install 'stable-data[geometry,sim]'" in done.stdout
    left_out = run("--verdicts", "none" if "networkx" in hidden else "audit", "--sample", "1")
    assert (left_out.returncode, left_out.stderr) == (DONE, ""), left_out.stdout


# --- the command --------------------------------------------------------------------------------------------------------------


def test_the_last_line_says_whether_a_run_is_whole(generated: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["verify", str(generated), "--verdicts", "none"])
    assert (done.exit_code, done.stderr) == (DONE, "")
    (line,) = done.stdout.splitlines()
    assert line.startswith(f"{generated}: whole (generate; ")
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    rows("turns", lambda found: found[1].update(tries=-1), hidden=False)(copy)
    done = CliRunner().invoke(app, ["verify", str(copy), "--verdicts", "none"])
    assert done.exit_code == SOME_FAILED
    *findings, line = done.stdout.splitlines()
    assert len(findings) == 2
    assert any("row 1: tries is -1, expected a number from 0" in finding for finding in findings)
    assert f"{copy}: damaged: 2 findings in turns (generate;" in line


@pytest.mark.parametrize("arguments", [["nowhere"], ["RUN", "--verdicts", "some"], ["RUN", "--sample", "-1"], ["s3://"]])
def test_bad_input_is_status_two(arguments: list[str], generated: Path, tmp_path: Path) -> None:
    places = {"nowhere": str(tmp_path / "nowhere"), "RUN": str(generated)}
    done = CliRunner().invoke(app, ["verify", *(places.get(word, word) for word in arguments)])
    assert done.exit_code == NOT_STARTED
    assert not done.stdout


def test_the_sample_follows_from_the_seed(generated: Path) -> None:
    def judged(seed: int) -> list[str]:
        told = list[str]()
        verify_run(
            RunFolder(str(generated)),
            lambda finding: told.append(str(finding)),
            VerifyOptions(sample=1, seed=seed, verdicts="audit"),
            lambda what, done, total: told.append(f"{what} {done} of {total}"),
        )
        return [line for line in told if line.startswith("verdicts")]

    assert judged(0) == judged(1) == ["verdicts 1 of 1"]


def test_references_to_another_run_are_resolved_in_it(generated: Path, clean_run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    rows("scenes", lambda found: found[0].update(variant_of="task_2", varied="task", num_varied=0))(copy)
    result, _ = verified(copy)
    assert result.is_whole  # without the source, nothing is known of its scenes
    assert verified(copy, source=generated)[0].is_whole
    result, found = verified(copy, source=clean_run)
    assert [f.what for f in found] == ["variant_of is 'task_2', which is in no row of scenes of the source"]


def test_a_run_without_meshes_is_judged_with_those_of_its_folder(
    dataset: Path, clean_run: Path, real_data: Path, tmp_path: Path
) -> None:
    """What correct makes of a folder has none of its own, where no folder can be written beside it: in an object store."""
    from pipelines.correct.job import correct
    from pipelines.correct.settings import CorrectSettings
    from pipelines.execution.ray_executor import WorkerPool

    run = str(tmp_path / "run")
    correct(str(dataset), run, CorrectSettings(weights="none", num_pictures=0, write_dataset=False), WorkerPool())

    def last_line(*more: str) -> str:
        done = CliRunner().invoke(app, ["verify", run, "--verdicts", "audit", "--quiet", *more])
        assert done.exit_code == (DONE if ": whole" in done.stdout else SOME_FAILED)
        return done.stdout.splitlines()[-1]

    assert "not known to be whole: verdicts" in (unknown := last_line())
    assert "--assets names" in unknown
    for place in (dataset, clean_run):
        assert "verdicts of 4 of 4 scenes by audit" in last_line("--assets", str(place))
    assert "damaged" in last_line("--assets", str(real_data))
    missing = CliRunner().invoke(app, ["verify", run, "--assets", str(tmp_path / "none")])  # refused before anything is read
    assert (missing.exit_code, missing.stdout) == (NOT_STARTED, "")
    assert "none is not a folder" in missing.stderr


# --- checksums and the manifest -----------------------------------------------------------------------------------------------


def test_checksums_are_those_that_other_programs_check(generated: Path) -> None:
    done = subprocess.run(["sha256sum", "-c", "--quiet", CHECKSUMS], cwd=generated, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")
    listed = read_checksums(RunFolder(str(generated)))
    assert listed is not None
    assert set(listed) == {f.relative_to(generated).as_posix() for f in generated.glob("*/part-*.parquet")}


def test_a_stored_checksum_is_kept_although_its_file_was_changed(generated: Path, tmp_path: Path) -> None:
    """Whoever completes a run again does not bless what happened to it in the meantime."""
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    path = files_of(copy, "turns")[0]
    path.write_bytes(path.read_bytes() + b" ")
    folder = RunFolder(str(copy))
    found = read_manifest(folder)
    assert found is not None
    write_manifest(folder, found)
    assert any("SHA-256" in finding.what for finding in verified(copy)[1])


def test_odd_checksums_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = RunFolder(str(tmp_path))
    folder.write_bytes(CHECKSUMS, b"0" * 64 + b"  a/part-1.parquet\n" + b"1" * 64 + b"  a/part-1.parquet\n")
    with pytest.raises(ConfigError, match=r"line 2 is .* each file once"):
        read_checksums(folder)


def test_selections_and_pruned_runs_are_whole(generated: Path, tmp_path: Path) -> None:
    target = RunFolder(str(tmp_path / "chosen"))
    select(RunFolder(str(generated)), "scene_id != 'task_2'", target)
    result, found = verified(tmp_path / "chosen")
    assert (result.is_whole, found, result.num_scenes) == (True, [], 2), str(result)
    select(target, "scene_id is not None", RunFolder(str(tmp_path / "joined")), [RunFolder(str(generated))])
    result, found = verified(tmp_path / "joined")
    assert (result.is_whole, found, result.num_scenes) == (True, [], 3), str(result)
    copy = Path(shutil.copytree(generated, tmp_path / "run"))
    prune(RunFolder(str(copy)))
    result, found = verified(copy)
    assert (result.is_whole, found) == (True, []), (str(result), found)


def test_a_run_on_an_object_store_is_verified(generated: Path) -> None:
    with object_store() as uri:
        folder = RunFolder(uri)
        for path in sorted(generated.glob("*/part-*.parquet")):
            folder.write_bytes(path.relative_to(generated).as_posix(), path.read_bytes())
        for name in (CHECKSUMS, "manifest.json"):
            folder.write_bytes(name, (generated / name).read_bytes())
        found = list[Finding]()
        assert verify_run(RunFolder(uri), found.append, VerifyOptions(verdicts="none")).is_whole
        name = files_of(generated, "turns")[0].relative_to(generated).as_posix()
        folder.write_bytes(name, b"PAR1")
        result = verify_run(RunFolder(uri), found.append, VerifyOptions(verdicts="none"))
        assert result.num_damaged == {"turns": 4}  # its checksum; it cannot be read; the rows and the scenes that it has left


# --- the rules ----------------------------------------------------------------------------------------------------------------


def test_every_rule_names_a_column_that_exists() -> None:
    assert RULES.keys() == SCHEMAS.keys()
    for table, rules in RULES.items():
        for path in (
            *rules.given,
            *rules.lengths,
            *rules.words,
            *rules.shares,
            *rules.counts,
            *rules.units,
            *KEYS.get(table, ()),
        ):
            first, *names = path.split(".")
            type_ = SCHEMAS[table].field(first).type
            for name in names:
                type_ = type_.value_type if pa.types.is_list(type_) else type_
                assert pa.types.is_struct(type_), (table, path)
                type_ = type_.field(name).type
