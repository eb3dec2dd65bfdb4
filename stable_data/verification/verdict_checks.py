"""Judges scenes of a run again, with the exact audit and in MuJoCo, and compares the verdicts with those that the run states."""

from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

from stable_data.assets.run_assets import RowsOfAssets, run_annotations, run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError, StableDataError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.scene_graph.staging import stage_scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import scene_from_row
from stable_data.verification.findings import Findings
from stable_data.verification.shard_files import ShardFile

_DEPTH_MM, _DEPTH_SHARE = 0.011, 0.03
"""By how much depths may differ: meshes that touch have the least depth of 0.01 mm or none, and depths are measured to 2 %."""

_DEEP = 1e-3  # metres: samples of surfaces find a pair that is deeper, whatever the rounding of its meshes

_GAP_MM = 0.01  # by how much gaps and depths in the table may differ

_GAP_MM_UNORDERED, _GAP_SHARE_UNORDERED = 1.0, 0.1
"""By how much more gaps may differ if the mesh of an older run lost the order of its faces, on which the sample of points depends that a
gap is measured from. Of 1,188 objects, each with three other orders of the faces, the gaps of 21 changed by more than 0.01 mm: those of
objects that rest on others by up to 0.5 mm, larger ones by up to 6 %."""

_REST_SLACK = {
    "settle_move_max_mm": 1.0,
    "settle_turn_max_deg": 1.0,
    "drift_mm": 1.0,
    "jitter_mm": 1.0,
    "engine_penetration_mm": 0.1,
}
"""Column -> by how much two simulations of a stable scene may differ."""

_REPORT = ("is_watertight", "is_solid", "is_sheet", "num_components", "num_boundary_edges", "num_nonmanifold_edges")
"""Entries of the report on a mesh that follow from the mesh as it is stored; others are of its repair, or are compared for all assets."""

_BY_PROBES = frozenset({"is_solid", "is_sheet"})
"""Those of them that points on the surface decide, which depend on the order of the faces."""

_REPORTED = frozenset({"asset_id", "report"})

_SMALL = 1e-9

_NEAR = 0.3  # share of a limit: verdicts on movements nearer to it may differ from one machine to another
_LIMITS = {"settle_move_max_mm": 10.0, "settle_turn_max_deg": 5.0, "drift_mm": 50.0}
_SAME = ("floats", "leaves_table", "enters_restricted_zone", "has_mesh")


class VerdictCheck:
    """Judges scenes of a run again.

    Args:
        folder: The run.
        simulates: Whether stability is simulated.
        is_settled: Whether the job asked MuJoCo about every scene: a scene without verdict is then simulated too.
        important_threshold: The setting of preprocess with which it set the stages of scenes; None: they are not set again.
        findings: Where damage is noted.
        assets: Folder or run with the meshes, for a run that has none.

    Raises:
        ConfigError: The run has no meshes (``table_missing``), or they cannot be read.
    """

    def __init__(
        self,
        folder: RunFolder,
        findings: Findings,
        *,
        simulates: bool,
        is_settled: bool,
        important_threshold: float | None = None,
        assets: str | None = None,
    ) -> None:
        self._findings, self._simulates, self._is_settled = findings, simulates, is_settled
        self._important_threshold = important_threshold
        self._store, self._containers = _opened(folder, assets)
        has_reports = bool(folder.files("assets") and folder.files("meshes"))
        self._reports = RowsOfAssets(folder, "assets", set(SCHEMAS["assets"].names) - _REPORTED) if has_reports else None
        self._reported = set[str]()
        self.num_audited = self.num_simulated = 0

    def check(self, row: Row, number: int, file: ShardFile) -> None:
        """Judges the scene of a row, which has a number in its file."""
        try:
            for what in self._faults(row):
                self._findings.damage(file.name, f"{row['scene_id']}: {what}", number)
        except (StableDataError, ValueError, TypeError, KeyError, ArithmeticError) as error:
            self._findings.damage(file.name, f"{row.get('scene_id')}: cannot be judged again ({error})", number)

    def _faults(self, row: Row) -> Iterator[str]:
        scene = scene_from_row(row)
        resolved, shapes, _ = self._store.resolved(scene)
        if resolved != scene:
            other = next(o.instance for o, was in zip(resolved.objects, scene.objects, strict=True) if o != was)
            yield f"the mesh of {other} does not have its size at its scale"
        posed = PosedScene(resolved, shapes)
        audit = audit_posed_scene(posed)
        self.num_audited += 1
        self._check_reports(scene)
        yield from self._stage_faults(scene)
        unordered = frozenset(o.instance for o in scene.objects if o.asset_id is not None and self._lost_order(o.asset_id))
        yield from audit_faults(row, audit, unordered)
        yield from sampled_faults(row, posed, audit, unordered)
        if scene.relations:
            related = relate_scene(posed, audit, self._containers(scene)).scene
            if extra := set(scene.relations) ^ set(related.relations):
                yield f"relation {min(extra)} is {'stated' if min(extra) in scene.relations else 'not stated'}, expected otherwise"
            for o, was in zip(related.objects, scene.objects, strict=True):
                if o.support != was.support:
                    yield f"support of {o.instance} is {was.support}, expected {o.support}"
        if self._simulates and (self._is_settled or row.get("stable") is not None):
            yield from self._rest_faults(row, resolved, shapes)

    def _check_reports(self, scene: Scene) -> None:
        """Notes what the reports on the meshes of a scene say that does not follow from the stored meshes."""
        for asset_id in sorted({o.asset_id for o in scene.objects if o.asset_id is not None} - self._reported):
            self._reported.add(asset_id)
            row = None if self._reports is None or self._store.fault_of(asset_id) is not None else self._reports.row(asset_id)
            if row is None or row["report"] is None:
                continue
            found, is_ordered = self._store.asset(asset_id).report, not self._lost_order(asset_id)
            for name in _REPORT if is_ordered else sorted(set(_REPORT) - _BY_PROBES):
                if row["report"][name] != getattr(found, name):
                    what = f"its report says {name} {row['report'][name]}, expected {getattr(found, name)} as of its mesh"
                    self._findings.damage("assets", f"asset {asset_id}: {what}")

    def _stage_faults(self, scene: Scene) -> Iterator[str]:
        """Yields stages that do not follow from the task of a scene and the distances of its objects."""
        if self._important_threshold is None or scene.task is None:
            return
        # Layouts are rounded to whole millimetres, so that a distance may be the threshold but for the rounding of a library.
        staged = [stage_scene(scene, self._important_threshold * (1 + slack)).objects for slack in (-_SMALL, _SMALL)]
        for o, one, other in zip(scene.objects, *staged, strict=True):
            if o.stage not in (one.stage, other.stage):
                yield f"stage of {o.instance} is {o.stage}, expected {one.stage}"

    def _lost_order(self, asset_id: str) -> bool:
        return self._store.fault_of(asset_id) is None and not self._store.asset(asset_id).is_in_order

    def _rest_faults(self, row: Row, scene: Scene, shapes: Sequence[Shape]) -> Iterator[str]:
        from stable_data.simulation.collision_bodies import bodies_of
        from stable_data.simulation.settling import settle

        try:
            found = settle(bodies_of(scene, shapes, self._store), scene.table)
        except MeshError as error:
            if row["stable"] is not None:
                yield f"stable is {row['stable']}, but it cannot be simulated ({error})"
            return
        self.num_simulated += 1
        figures = {name: getattr(found, name) for name in _REST_SLACK}
        if row["stable"] is None:
            if found.stable is not None:
                yield f"stable is null, expected {found.stable}: it can be simulated"
        elif found.stable != row["stable"]:
            if any(_is_near(values.get(name), limit) for values in (row, figures) for name, limit in _LIMITS.items()):
                self._findings.cannot_know(
                    f"{row['scene_id']}: whether it is stable, which is near a limit and differs in this simulation"
                )
            else:
                yield f"stable is {row['stable']}, expected {found.stable}{f': {found.reason}' if found.reason else ''}"
        elif found.stable:
            for name, slack in _REST_SLACK.items():
                if name in row and not _is_about(row[name], figures[name], slack):
                    yield f"{name} is {row[name]}, expected {figures[name]}"


def audit_faults(row: Row, audit: Audit, unordered: Set[str] = frozenset()) -> Iterator[str]:
    """Yields the verdicts of a row of ``scenes`` that another audit of it does not give.

    Args:
        row: The row.
        audit: The other audit.
        unordered: Instances whose meshes may have their faces in another order than when they were judged.
    """
    expected = audit.rows()
    depths = [
        {frozenset((p["first"], p["second"])): p["penetration_mm"] for p in pairs}
        for pairs in (row["pairs"], expected["pairs"])
    ]
    for pair in sorted(depths[0].keys() | depths[1].keys(), key=sorted):
        found, right = (each.get(pair, 0.0) for each in depths)
        is_same = (
            found == right
            if found is None or right is None
            else abs(found - right) <= _DEPTH_MM + _DEPTH_SHARE * max(found, right)
        )
        if not is_same:
            yield f"the penetration of {' and '.join(sorted(pair))} is {found} mm, expected {right} mm"
    for verdict, right in zip(row["verdicts"], expected["verdicts"], strict=True):
        name = verdict["instance"]
        for key in _SAME:
            if verdict[key] != right[key]:
                yield f"{key} of {name} is {verdict[key]}, expected {right[key]}"
        if set(verdict["supports"]) != set(right["supports"]):
            yield f"{name} stands on {sorted(verdict['supports'])}, expected {sorted(right['supports'])}"
        for key in ("gap_mm", "table_penetration_mm"):
            most = _GAP_MM
            if key == "gap_mm" and name in unordered:
                most += _GAP_MM_UNORDERED + _GAP_SHARE_UNORDERED * abs(right[key] or 0.0)
            if not _is_about(verdict[key], right[key], most):
                yield f"{key} of {name} is {verdict[key]}, expected {right[key]}"


def sampled_faults(row: Row, posed: PosedScene, audit: Audit, unordered: Set[str] = frozenset()) -> Iterator[str]:
    """Yields ``oc_sdf`` of a row of ``scenes`` if another count of its pairs cannot give it.

    The count has no tolerance: a pair that only touches may be counted or not by the rounding of a mesh. A null is left alone, because
    older runs have it.

    Args:
        row: The row.
        posed: Its scene with its meshes.
        audit: Another audit of it.
        unordered: As for :func:`audit_faults`: where the samples of a mesh may be others, too.
    """
    found = row.get("oc_sdf")
    if found is None:
        return
    expected = add_sampled_collisions(audit.card(), posed.scene, posed.shapes, audit).oc_sdf
    if expected is None:
        yield f"oc_sdf is {found}, expected null: a pair cannot be judged"
        return
    touching = [p for p in audit.pairs if p.penetration is None or p.penetration < _DEEP or {p.first, p.second} & unordered]
    if abs(found - expected) > len(touching) / max(1, audit.num_pairs) + 1e-9:
        yield f"oc_sdf is {found}, expected {expected} by the samples of its surfaces"


def _is_about(found: float | None, expected: float | None, most: float) -> bool:
    return found == expected if found is None or expected is None else abs(found - expected) <= most


def _is_near(value: Any, limit: float) -> bool:
    return value is not None and abs(value - limit) <= _NEAR * limit


def _opened(folder: RunFolder, assets: str | None) -> tuple[AssetStore, "_Containers"]:
    """The meshes of a run, else those of the place that has them, and whether the assets are containers."""
    place = folder if assets is None or folder.files("meshes") else RunFolder(assets)
    if place.files("meshes"):
        annotations = run_annotations(place) if place.files("assets") else {}
        return run_store(place.uri), _Containers({name: annotations[name].is_container for name in annotations})
    root = Path(place.root)
    if place is folder:
        root /= "dataset"  # what a correction of a folder writes beside the tables
        if not (folder.is_local and root.is_dir()):
            raise ConfigError(
                f"{folder.uri}: has no meshes, expected the table meshes; its verdicts cannot be checked; --assets names the folder "
                "or run that has its meshes, --verdicts none leaves verdicts out",
                "table_missing",
            )
    dataset = MesaTaskDataset(root)
    return AssetStore(dataset), _Containers({name: dataset.annotation(name).is_container for name in dataset.annotations})


class _Containers:
    """Whether objects can be put into the objects of a scene."""

    def __init__(self, known: Mapping[str, bool | None]) -> None:
        self._known = known

    def __call__(self, scene: Scene) -> dict[str, bool | None]:
        return {o.instance: None if o.asset_id is None else self._known.get(o.asset_id) for o in scene.objects}
