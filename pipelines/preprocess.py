"""Preprocess: a folder of scenes in the MesaTask-10K format becomes staged, geometry-complete tables.

A shard whose last table is in place is done. Workers write their own shards, so nothing large travels.
"""

import importlib
import json
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from tqdm import tqdm

import stable_data
from pipelines.asset_step import AssetSettings, AssetUse, preprocess_asset
from pipelines.plan import Plan, PreprocessSettings, Shard, plan_run
from pipelines.report import write_report
from pipelines.runner import Workers, alone
from pipelines.scene_step import CachedWriter, preprocess_scene
from pipelines.settings import differences
from stable_data import tables
from stable_data.assets import AssetStore
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.mesatask import MesaTaskDataset, read_text_features
from stable_data.shards import RunFolder, content_id

SCENE_TABLES = ("warnings", "failures", "samples", "scenes")
"""Tables of a scene shard, in the order in which they are put in place: the last one says that the shard is complete."""
ASSET_TABLES = ("warnings", "failures", "sdf", "meshes", "assets")
"""Tables of an asset shard, likewise."""


@dataclass(frozen=True, slots=True)
class PreprocessShard:
    """The work of one shard; sent to the workers.

    Attributes:
        data: Root of the dataset, which every worker can read.
        out: The run's folder, which every worker can write.
        settings: The job's settings.
    """

    data: str
    out: str
    settings: PreprocessSettings

    def __call__(self, shard: Shard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its items and how many of them failed."""
        rows: dict[str, list[tables.Row]] = defaultdict(list)
        items: tuple[str | AssetUse, ...] = (*shard.assets, *shard.scenes)
        for item in items:
            found = alone(self.item, item, seconds=self.settings.seconds_per_item) if isolated else self.item(item)
            if found is None:
                item_id = _id_of(item)
                over = f"died or took over {self.settings.seconds_per_item:g} s"
                message = f"{item_id}: the process that read it {over}; is the file hostile?"
                found = {"failures": [tables.notice_row(Notice(item_id, "isolate", "crashed", message))]}
            for table, new in found.items():
                rows[table] += new
        out = RunFolder(self.out)
        for table in ASSET_TABLES if shard.assets else SCENE_TABLES:
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def item(self, item: str | AssetUse) -> dict[str, list[tables.Row]]:
        """Rows of one scene or asset, by table; a failure is a row too."""
        dataset, store = _opened(self.data)
        item_id = _id_of(item)
        try:
            if isinstance(item, str):
                scene = preprocess_scene(dataset, item, store, self.settings.scene_settings(), _writer(self.settings))
                found = {"scenes": [scene.scene], "samples": list(scene.samples)}
                notices = scene.notices
            else:
                embedding = _embeddings(self.data).get(item.asset_id)
                asset = preprocess_asset(
                    item, dataset.annotation(item.asset_id), store, AssetSettings(self.settings.num_points), embedding
                )
                found = {"assets": [asset.asset], "meshes": [asset.mesh], "sdf": list(asset.grids)}
                notices = asset.notices
        except ConfigError:
            raise  # the run itself cannot go on
        except StableDataError as error:
            return {"failures": [tables.notice_row(Notice(item_id, _step_of(item), error.code, str(error)))]}
        except Exception as error:  # noqa: BLE001 - the one place where what nobody foresaw becomes a row
            message = f"{item_id}: {type(error).__name__}: {error}; please report this with the file"
            return {"failures": [tables.notice_row(Notice(item_id, _step_of(item), "unexpected", message))]}
        return found | {"warnings": [tables.notice_row(n) for n in notices]}


def _id_of(item: str | AssetUse) -> str:
    return item if isinstance(item, str) else item.asset_id


def _step_of(item: str | AssetUse) -> str:
    return "read" if isinstance(item, str) else "mesh"


@lru_cache(maxsize=2)
def _opened(data: str) -> tuple[MesaTaskDataset, AssetStore]:
    dataset = MesaTaskDataset(Path(data))
    return dataset, AssetStore(dataset)


@lru_cache(maxsize=2)
def _embeddings(data: str) -> dict[str, list[float]]:
    path = Path(data) / "sbert_text_features.pkl"
    if not path.is_file():
        return {}
    asset_ids, features = read_text_features(path)
    return {a: row.tolist() for a, row in zip(asset_ids, features, strict=True)}


@lru_cache(maxsize=2)
def _writer(settings: PreprocessSettings) -> CachedWriter | None:
    if not settings.task_writer:
        return None
    module, _, name = settings.task_writer.partition(":")
    try:
        write: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"setting task_writer is {settings.task_writer} ({error}), expected module:function", "config_invalid"
        ) from error
    return CachedWriter(write, settings.task_cache, settings.task_writer)


def preprocess(data: str, out: str, settings: PreprocessSettings, workers: Workers, *, report: bool = True) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        data: Root of a dataset in the MesaTask-10K format.
        out: Local folder or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    dataset = MesaTaskDataset(Path(data))
    settings = settings.settled(dataset)
    _writer(settings)
    _embeddings(data)
    folder = RunFolder(out)
    with folder.locked():
        plan = plan_run(dataset, settings)
        manifest = _manifest(dataset, plan, settings)
        _check_resume(folder, manifest)
        folder.write_bytes("manifest.json", _json(manifest))
        _write_dataset_notices(folder, dataset)
        if not plan.num_assets:  # a table without rows is still a table
            for table in ASSET_TABLES:
                folder.write_shard(table, content_id("no assets"), [])
        _run_shards(folder, plan, PreprocessShard(str(dataset.root), out, settings), workers)
        manifest |= {"status": "complete", "counts": _counts(folder)}
        if report:
            write_report(folder, manifest, AssetStore(dataset), settings.num_pictures)
        folder.write_bytes("manifest.json", _json(manifest))
    return manifest


def describe_plan(data: str, settings: PreprocessSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    dataset = MesaTaskDataset(Path(data))
    settings = settings.settled(dataset)
    plan = plan_run(dataset, settings)
    counts = {k: v for k, v in asdict(plan).items() if k.startswith("num_")}
    return {"settings": asdict(settings), "input_fingerprint": plan.fingerprint, "num_shards": len(plan.shards), **counts}


def _write_dataset_notices(folder: RunFolder, dataset: MesaTaskDataset) -> None:
    """What is odd about the dataset as a whole; a scene folder without a layout is a failure like any other."""
    lost = [n for n in dataset.notices if n.code == "layout_missing"]
    odd = [n for n in dataset.notices if n.code != "layout_missing"]
    for table, notices in (("failures", lost), ("warnings", odd)):
        if notices:
            rows = [tables.notice_row(n) for n in notices]
            folder.write_shard(table, content_id("dataset", rows), rows)


def _run_shards(folder: RunFolder, plan: Plan, work: PreprocessShard, workers: Workers) -> None:
    done = folder.shard_ids("scenes") | folder.shard_ids("assets")
    missing = [s for s in plan.shards if s.shard_id not in done]
    total, failed = sum(map(len, plan.shards)), 0
    with tqdm(total=total, initial=total - sum(map(len, missing)), desc="preprocess", unit="item") as bar:
        for size, failures in workers.run(work, missing) if missing else ():
            failed += failures
            bar.update(size)
            bar.set_postfix_str(f"{failed} failed", refresh=False)


def _manifest(dataset: MesaTaskDataset, plan: Plan, settings: PreprocessSettings) -> dict[str, Any]:
    return {
        "job": "preprocess",
        "status": "running",
        "code_version": stable_data.__version__,
        "table_version": tables.TABLE_VERSION,
        "dataset": dataset.root.name,
        "input_fingerprint": plan.fingerprint,
        "settings": asdict(settings),
        "num_scenes": plan.num_scenes,
        "num_assets": plan.num_assets,
        "num_assets_without_mesh": plan.num_assets_without_mesh,
    }


def _check_resume(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Refuses to mix rows of two configurations, inputs or versions in one folder."""
    content = folder.read_bytes("manifest.json")
    if content is None:
        return
    try:
        was = dict(json.loads(content))
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/manifest.json: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error
    shaping = PreprocessSettings(**manifest["settings"]).shaping()
    compared = ("job", "code_version", "table_version", "input_fingerprint")
    changed = differences({k: was.get(k) for k in compared}, {k: manifest[k] for k in compared})
    changed += differences({k: was.get("settings", {}).get(k) for k in shaping}, shaping)
    if changed:
        raise ConfigError(
            f"{folder.uri}: was made with another configuration ({'; '.join(changed)}); choose a new folder or restore it",
            "config_changed",
        )


def _counts(folder: RunFolder) -> dict[str, Any]:
    counts: dict[str, Any] = {t: folder.dataset(t).count_rows() for t in dict.fromkeys((*ASSET_TABLES, *SCENE_TABLES))}
    for table in ("warnings", "failures"):
        rows = folder.table(table, ["code", "step"])
        counts[f"{table}_by_code"] = dict(sorted(Counter(rows["code"].to_pylist()).items()))
    steps = Counter(folder.table("failures", ["step"])["step"].to_pylist())
    counts["failures_by_step"] = dict(sorted(steps.items()))
    return counts


def _json(document: dict[str, Any]) -> bytes:
    return (json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()
