"""Targets: runs of others: shards, manifests and checksums, read by all that reads runs."""

import hashlib
import io
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import DATA, check_finite, check_scene, check_verdicts, files_below
from benchmarks.fuzzing.watching import FalsePass, check_text
from stable_data.assets.run_assets import run_annotations
from stable_data.diversity.comparison import compare_sets
from stable_data.diversity.scene_set import SceneSet
from stable_data.errors import ConfigError, StableDataError
from stable_data.export.exporter import export_run
from stable_data.publishing.dataset_card import CROISSANT_FILE
from stable_data.publishing.publisher import PublishOptions, publish
from stable_data.simulation.run_reader import RunScenes, SceneSelection, SettledPoses
from stable_data.storage import run_changes
from stable_data.storage.checksums import read_checksums
from stable_data.storage.manifest import MANIFEST, manifest_digest, read_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SceneArrays, scenes_from_table
from stable_data.storage.subset import count_selected, select
from stable_data.storage.table_rows import card_from_row, scene_from_row
from stable_data.verification.evaluation_folder import EVALUATION, verify_evaluation
from stable_data.verification.findings import Finding
from stable_data.verification.verifier import VerifyOptions, verify_run
from stable_data.viewer.page import run_page

_WORDS = (
    *(
        "scene_id",
        "asset_id",
        "objects",
        "position",
        "yaw",
        "size",
        "task",
        "instance",
        "clean",
        "stable",
        "split",
        "train",
        "table_size",
    ),
    *(
        "complete",
        "status",
        "counts",
        "planned",
        "digest",
        "settings",
        "inputs",
        "job",
        "generate",
        "preprocess",
        "table_version",
        "checksums",
    ),
    *(
        "../x",
        "scenes/part-0.parquet",
        "left of",
        "on",
        "task_objects",
        "important",
        "../../outside/rows.parquet",
        "2_mug_0",
        "table",
        "seed",
    ),
)


def _small(table: pa.Table, rows: int) -> bytes:
    sink = io.BytesIO()
    pq.write_table(table.slice(0, rows), sink, compression="zstd")
    return sink.getvalue()


@lru_cache(maxsize=1)
def _preprocessed() -> Mapping[str, bytes]:
    """One scene with its assets: a run of preprocess of the tests, made smaller."""
    folder = DATA / "run_v3" / "preprocess"
    tables = {
        path.parent.name: (path, pq.read_table(path))
        for path in sorted(folder.glob("*/part-*.parquet"))
        if pq.read_table(path).num_rows
    }
    scene = tables["scenes"][1].slice(0, 1)
    used = {o["asset_id"] for o in scene["objects"].to_pylist()[0]}
    found = {MANIFEST: (folder / MANIFEST).read_bytes()}
    for name, (path, table) in tables.items():
        if "asset_id" in table.column_names:
            table = table.filter(pc.is_in(table["asset_id"], pa.array(sorted(used), pa.string())))
        elif name == "scenes":
            table = scene
        found[path.relative_to(folder).as_posix()] = _small(table, 10)
    return found


@lru_cache(maxsize=1)
def _generated() -> Mapping[str, bytes]:
    """Scenes with what belongs to them, without assets: a run of generate of the tests."""
    folder = DATA / "run_v3" / "generate"
    files = files_below(folder, MANIFEST, "scenes/*", "settled/*", "turns/*", "warnings/*")
    return {
        path: content for path, content in files.items() if path == MANIFEST or pq.read_metadata(io.BytesIO(content)).num_rows
    }


def _with_checksums(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """A run that states its checksums, and a manifest that is consistent with itself."""
    lines = "".join(
        f"{hashlib.sha256(files[path]).hexdigest()}  {path}\n" for path in sorted(files) if path.endswith(".parquet")
    )
    manifest: dict[str, Any] = json.loads(files[MANIFEST])
    manifest["checksums"] = {"files": lines.count("\n"), "sha256": hashlib.sha256(lines.encode()).hexdigest()}
    manifest["planned"] = [
        {"table": "scenes", "column": "scene_id", "count": 1, "digest": "", "lost": True, "failed_key": None}
    ]
    manifest["digest"] = manifest_digest(manifest)
    return {**files, MANIFEST: json.dumps(manifest, indent=1).encode(), "SHA256SUMS": lines.encode()}


def _weights(files: Mapping[str, bytes], **weights: float) -> dict[str, float]:
    found = {path: weights.get(path.partition("/")[0].removesuffix(".json"), 0.0) for path in files}
    return {path: weight for path, weight in found.items() if weight}


def _shards() -> list[Base]:
    whole = _preprocessed()
    return [Base("preprocess", whole, _weights(whole, scenes=6, assets=2, meshes=2))]


def _scenes_alone() -> list[Base]:
    files = {path: content for path, content in _generated().items() if path.startswith(("scenes/", "settled/", MANIFEST))}
    return [Base("scenes", files, _weights(files, scenes=5, settled=1))]


def _all_tables() -> list[Base]:
    pre, gen = _preprocessed(), _generated()
    return [
        Base("preprocess", pre, _weights(pre, scenes=4, assets=2, meshes=2, samples=1, features=1, warnings=1)),
        Base("generate", gen, _weights(gen, scenes=3, settled=2, turns=2, warnings=1)),
    ]


def _manifests() -> list[Base]:
    files = _with_checksums(
        {path: content for path, content in _generated().items() if path.startswith((MANIFEST, "warnings/", "turns/"))}
    )
    evaluation: dict[str, Any] = {"systems": {"stable": {"repetitions": 1, "figures": {"oc": 0.0}}}, "seed": 0}
    evaluation["digest"] = manifest_digest(evaluation)
    run = {f"seed_0/stable/scenes/{path}": content for path, content in files.items()}
    return [
        Base("generate", files, {MANIFEST: 4, "SHA256SUMS": 1}),
        Base("evaluation", {EVALUATION: json.dumps(evaluation).encode(), **run}, {EVALUATION: 1}),
    ]


def _outcome(one: Callable[[], object]) -> bool:
    """Runs a reader whose refusal does not keep the others from running."""
    try:
        one()
    except StableDataError as error:
        check_text(str(error), error.code)
        return False
    return True


def _read_rows(folder: Path, base: str) -> bool:
    run = RunFolder(str(folder))
    rows = run.table("scenes")
    ways = (
        lambda: scenes_from_table(rows),
        lambda: SceneArrays.from_table(rows),
        lambda: run.num_rows("scenes"),
    )
    done = [_outcome(way) for way in ways]
    for row in rows.to_pylist():
        scene = scene_from_row(row)
        check_scene(scene)
        card_from_row(row)
        for position, quat in SettledPoses(run).of(scene.scene_id).values():
            check_finite("pose", position, quat)
    return all(done)


def _read_geometry(folder: Path, base: str) -> bool:
    run = RunFolder(str(folder))
    scenes = RunScenes(run)
    _outcome(lambda: run_annotations(run))
    count = 0
    for row in scenes.rows():
        scene = scene_from_row(row)
        check_scene(scene)
        geometry = scenes.geometry(scene, row)
        for shape in geometry.shapes:
            if not (shape.vertices == shape.vertices).all():
                raise FalsePass("a shape has a corner that is no number")
        count += 1
    return bool(count)


def _query(folder: Path, base: str) -> bool:
    run, out = RunFolder(str(folder)), Path(tempfile.gettempdir(), "selected")
    found, total = count_selected(run, "clean or not clean or clean is None")
    assert found <= total
    _outcome(lambda: compare_sets([SceneSet.read(str(folder))]))
    target = RunFolder(str(out))
    select(run, "scene_id is not None", target)
    return True


def _verify(folder: Path, base: str) -> bool:
    findings: list[Finding] = []
    found = verify_run(RunFolder(str(folder)), findings.append, VerifyOptions(2, verdicts="none"))
    for one in findings:
        text = str(one)
        if "Error: " in text and any(
            name in text for name in ("KeyError", "TypeError", "IndexError", "AttributeError", "AssertionError")
        ):
            continue  # a value that no check expects is named as damage
        if len(text) > 5000:
            raise FalsePass(f"a finding of {len(text)} characters: {text[:200]}")
    _check_noted(folder, findings)
    return bool(str(found))


def _check_noted(folder: Path, findings: Sequence[Finding]) -> None:
    """Refuses a verification that says nothing of a file of scenes with a good verdict beside a figure that is no number."""
    for path in folder.glob("scenes/*.parquet"):
        if any(one.where.startswith("scenes") for one in findings):
            return
        try:
            rows = pq.read_table(path).to_pylist()
        except (pa.ArrowException, OSError, ValueError):
            continue
        for row in rows:
            check_verdicts(row)


def _verify_verdicts(folder: Path, base: str) -> bool:
    verify_run(RunFolder(str(folder)), lambda _: None, VerifyOptions(1, verdicts="audit"))
    return True


def _page(folder: Path, base: str) -> bool:
    content, failures = run_page(RunFolder(str(folder)), SceneSelection(limit=1))
    for failure in failures:
        check_text(failure.replace("\n", " ")[:1900], "unexpected" if "unexpected" in failure else "")
    return bool(content) and not failures


def _export(folder: Path, base: str) -> bool:
    out = Path(tempfile.gettempdir(), "exported")
    found = export_run(RunFolder(str(folder)), out, base, SceneSelection(limit=1))
    for failure in found.failures:
        check_text(failure, "unexpected" if "unexpected" in failure else "")
    return found.num_written > 0


def _exports() -> list[Base]:
    whole = _preprocessed()
    return [Base(name, whole, _weights(whole, scenes=6, assets=2, meshes=1)) for name in ("glb", "mjcf", "mesatask")]


def _read_manifest(folder: Path, base: str) -> bool:
    run = RunFolder(str(folder))
    if base == "evaluation":
        findings: list[Finding] = []
        found_runs = list(verify_evaluation(run, findings.append, VerifyOptions(1, verdicts="none")))
        for finding in findings:
            check_text(str(finding), "")
        return bool(found_runs)
    _outcome(lambda: read_checksums(run))
    try:
        run.read_document(MANIFEST)
    except ConfigError:
        raise
    except ValueError:
        pass  # inspect turns it into an error
    found = _outcome(lambda: read_manifest(run))
    _verify(folder, base)
    return found


def _upgrade(folder: Path, base: str) -> bool:
    own = Path(tempfile.gettempdir(), "copy")
    shutil.copytree(folder, own)
    done = _outcome(lambda: run_changes.upgrade(RunFolder(str(own))))
    return _outcome(lambda: run_changes.prune(RunFolder(str(own)))) or done


def _publish(folder: Path, base: str) -> bool:
    out = Path(tempfile.gettempdir(), "published")
    options = PublishOptions(
        allow_unknown_licences=True, allow_no_derivatives=True, unverified=True, verify=VerifyOptions(1, verdicts="none")
    )
    found = publish(RunFolder(str(folder)), out, options, lambda _: None)
    document = json.loads((out / CROISSANT_FILE).read_text("utf-8"), parse_constant=_refuse_constant)
    if document["name"] != folder.name or not (out / "README.md").read_text("utf-8"):
        raise FalsePass("the published folder has no metadata or no card of the run")
    published = RunFolder(str(out))
    for table in found.tables:
        if published.num_rows(table.name) != table.num_rows:
            raise FalsePass(f"{table.name}: {published.num_rows(table.name)} rows were published, {table.num_rows} are stated")
    return True


def _refuse_constant(text: str) -> None:
    raise FalsePass(f"the metadata of a published run have the number {text}, which JSON has not")


_JOINED = ("first", "second")


def _join(folder: Path, base: str) -> bool:
    first, second = (RunFolder(str(folder / name)) for name in _JOINED)
    target = RunFolder(Path(tempfile.gettempdir(), "joined"))
    with target.locked():
        counts = select(first, "scene_id is not None", target, [second])
    if not 0 <= counts["scenes"] <= first.num_rows("scenes") + second.num_rows("scenes"):
        raise FalsePass(f"the joined run has {counts['scenes']} scenes, more than both runs have")
    return True


def _two_runs() -> list[Base]:
    """Two runs that share their assets and a scene; one file of one of them is changed."""
    found = []
    for name, files in (("preprocess", _preprocessed()), ("generate", _generated())):
        both = {f"{run}/{path}": content for run in _JOINED for path, content in files.items()}
        weights = _weights(files, scenes=5, manifest=1, assets=2, meshes=2, settled=1, warnings=1)
        found.append(Base(name, both, {f"{run}/{path}": weight for run in _JOINED for path, weight in weights.items()}))
    return found


def _to_publish() -> list[Base]:
    found = []
    for name, files in (("preprocess", _preprocessed()), ("generate", _generated())):
        whole = _with_checksums(files)
        found.append(
            Base(name, whole, _weights(whole, scenes=5, manifest=3, assets=3, meshes=2, warnings=2, settled=1, turns=1))
        )
    return found


def _old() -> list[Base]:
    found = []
    for version in ("run_v1", "run_v2"):
        folder = DATA / version
        files = {
            path: content
            for path, content in files_below(folder).items()
            if path.startswith((MANIFEST, "scenes/", "warnings/", "failures/"))
        }
        found.append(Base(version, files, _weights(files, scenes=4, manifest=1, warnings=1)))
    return found


TARGETS = (
    Target("run_rows", 5, _scenes_alone, _read_rows, _WORDS),
    Target("run_geometry", 5, _shards, _read_geometry, _WORDS, block=50),
    Target("run_query", 5, _scenes_alone, _query, _WORDS, block=50),
    Target("run_verify", 5, _all_tables, _verify, _WORDS, block=50),
    Target("run_verdicts", 5, _shards, _verify_verdicts, _WORDS, block=25),
    Target("run_page", 5, _shards, _page, _WORDS, block=25),
    Target("run_export", 5, _exports, _export, _WORDS, block=25),
    Target("run_manifest", 5, _manifests, _read_manifest, _WORDS, block=100),
    Target("run_upgrade", 5, _old, _upgrade, _WORDS, block=50),
    Target("run_publish", 5, _to_publish, _publish, _WORDS, block=25),
    Target("run_join", 5, _two_runs, _join, _WORDS, block=50),
)
"""The targets of this module."""
