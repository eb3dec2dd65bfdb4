"""Verifies a run: whether it is whole, finding by finding and in one line. Row groups are streamed, so that the memory stays flat."""

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import pyarrow as pa
import pyarrow.compute as pc

from stable_data.errors import ConfigError
from stable_data.extras import install_hint
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.checksums import CHECKSUMS
from stable_data.storage.id_hashes import IdSet, id_hashes
from stable_data.storage.manifest import COMPLETE, MANIFEST
from stable_data.storage.row_groups import row_slices, rows_from_table
from stable_data.storage.run_changes import PRUNED
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.verification.asset_checks import AssetCheck, AssetFacts, FeatureCheck, GridCheck, MeshCheck, TextureCheck
from stable_data.verification.column_checks import SchemaCheck, check_values
from stable_data.verification.column_rules import RULES
from stable_data.verification.findings import Finding, Findings
from stable_data.verification.generated_checks import GeneratedCheck
from stable_data.verification.joined_checks import JOINED, JoinedCheck, ScenesOfShards, ShardMates, TurnCheck
from stable_data.verification.known_ids import KEYS, ForeignKey, KeyCheck, KnownIds
from stable_data.verification.manifest_checks import (
    OF_DATASET,
    SETTLING,
    CountCheck,
    check_manifest,
    important_threshold,
    older_version,
    origin_of,
    read_raw_manifest,
    settings_of,
    split_rule,
    stated_checksums,
    unasked_columns,
)
from stable_data.verification.other_files import check_other_files
from stable_data.verification.preprocessed_checks import PreprocessedCheck
from stable_data.verification.row_checks import OwnCheck
from stable_data.verification.sample_checks import SampleCheck
from stable_data.verification.scene_checks import UNRESOLVED, SceneCheck
from stable_data.verification.shard_files import (
    ShardFile,
    compare_with_checksums,
    list_files,
    open_file,
    row_groups,
    tell_of_link,
)

if TYPE_CHECKING:
    from stable_data.verification.verdict_checks import VerdictCheck

Verdicts: TypeAlias = Literal["all", "audit", "none"]
"""Which verdicts are computed again: those of the audit and of MuJoCo, those of the audit alone, or none."""

Tell: TypeAlias = Callable[[Finding], None]
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is checked, and with the number of finished and of all pieces."""

_FIRST = ("textures", "meshes", "assets", "sdf", "features", "measured", "failures", "scenes", "rejected", "warnings")
"""Tables in the order in which they are read: what others refer to comes first."""

_SCENES = ("scenes", "rejected")
_SOURCE = "scenes of the source"
_OF_SCENES = ("scenes", "rejected", "failures")
_WITHOUT_ASSETS = frozenset({"correct", "query", "publish"})
"""Jobs whose runs have no tables of assets if the scenes come from a folder, and what is made of such runs."""

_OF_OTHER_RUNS = frozenset({"query", "publish", "reach"})
"""Jobs that copy the rows of scenes."""

_IN_ONE_SHARD: Mapping[str, frozenset[str]] = {
    "generate": frozenset({"turns", "settled", "grasps"}),
    "preprocess": frozenset({"samples"}),
    "correct": frozenset({"corrections", "grasps"}),
    "edit": frozenset({"corrections", "edits", "grasps"}),
    "reach": frozenset({"grasps"}),
}
"""Job -> tables whose rows it writes to the shards of their scenes."""

_CARRIED = frozenset({"assets", "meshes", "textures", "sdf", "features", "settled"})
"""Tables that correct, edit and reach copy from the run that they read."""


@dataclass(frozen=True, slots=True)
class VerifyOptions:
    """How much is verified.

    Attributes:
        sample: Scenes whose verdicts are computed again; 0: all.
        seed: Chooses these scenes.
        verdicts: Which verdicts are computed again.
        source: The run that the scene ids of episodes, views, ratings and variants refer to; None: they are not looked up.
        assets: Folder in the MesaTask-10K format, or run, with the meshes of a run that has none.
    """

    sample: int = 20
    seed: int = 0
    verdicts: Verdicts = "all"
    source: RunFolder | None = None
    assets: str | None = None


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of a verification.

    Attributes:
        uri: The run.
        job: The job that made it; empty if the run does not say.
        is_finished: Whether the manifest says that it is complete.
        num_damaged: Number of findings by table.
        unknown: What could not be known.
        num_files: Files of shards, and the other files of a published run.
        num_checked: Those of them that were compared with their checksum.
        rows: Number of rows by table.
        num_scenes: Scenes that have verdicts.
        num_audited: Scenes that were audited again.
        num_simulated: Scenes that were simulated again.
        seconds: How long it took.
    """

    uri: str
    job: str
    is_finished: bool
    num_damaged: Mapping[str, int]
    unknown: tuple[str, ...]
    num_files: int
    num_checked: int
    rows: Mapping[str, int]
    num_scenes: int
    num_audited: int
    num_simulated: int
    seconds: float

    @property
    def is_whole(self) -> bool:
        """Whether the run is finished, nothing is damaged, and nothing that was to be checked is unknown."""
        return self.is_finished and not self.num_damaged and not self.unknown

    def __str__(self) -> str:
        """Returns in one line whether the run is whole."""
        checked = f"{self.num_checked} of {self.num_files} files by checksum, {sum(self.rows.values())} rows"
        if self.num_scenes:
            checked += (
                f", verdicts of {self.num_audited} of {self.num_scenes} scenes by audit and of {self.num_simulated} in MuJoCo"
            )
        count = sum(self.num_damaged.values())
        states = [f"damaged: {count} {'finding' if count == 1 else 'findings'} in {', '.join(self.num_damaged)}"] * bool(
            self.num_damaged
        )
        states += ["not finished"] * (not self.is_finished)
        states += [f"not known to be whole: {'; '.join(self.unknown)}"] * bool(self.unknown)
        return f"{self.uri}: {' and '.join(states) or 'whole'} ({self.job or 'unknown job'}; {checked})"


def _reading_order(file: ShardFile) -> tuple[int, str, str]:
    """The place of a file among all: after those that its rows refer to, and beside those of the same scenes, which are read once."""
    order = _FIRST.index(file.table) if file.table in _FIRST else len(_FIRST)
    return order, file.shard_id if file.table in JOINED else "", file.table


class RowCheck(Protocol):
    """Checks rows of a table."""

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        ...


def verify_run(
    folder: RunFolder, tell: Tell, options: VerifyOptions = VerifyOptions(), progress: Progress | None = None
) -> Verification:
    """Verifies a run.

    Args:
        folder: The run.
        tell: Called with each finding.
        options: How much is verified.
        progress: Called after each file, and after each scene that is judged again.

    Raises:
        ConfigError: There is no run (``not_a_run``), the folder cannot be read, or the place of the assets is neither a run with
            meshes nor a folder in the MesaTask-10K format.
    """
    if options.assets is not None and not (place := RunFolder(options.assets)).files("meshes"):
        MesaTaskDataset(Path(place.root))  # opened again for the verdicts; here a wrong place is told before anything is read
    if not (folder.tables() or folder.has_file(MANIFEST)):
        raise ConfigError(f"{folder.uri}: no tables and no manifest.json, expected the folder of a run", "not_a_run")
    return _Verifier(folder, Findings(tell), options, progress or (lambda *_: None)).run()


class _Verifier:
    """The verification of one run."""

    def __init__(self, folder: RunFolder, findings: Findings, options: VerifyOptions, progress: Progress) -> None:
        self._folder, self._findings, self._options, self._progress = folder, findings, options, progress
        for name in (MANIFEST, CHECKSUMS):
            tell_of_link(folder, name, findings)
        manifest = read_raw_manifest(folder, findings)
        self._manifest: dict[str, Any] = manifest or {}
        if manifest is not None:
            check_manifest(manifest, findings)
        self._is_finished = self._manifest.get("status") == COMPLETE
        self._checksums = stated_checksums(folder, manifest, findings)
        self._files = list_files(folder, findings)
        self._num_others = 0
        if self._checksums is not None and self._is_finished:
            compare_with_checksums(self._files, self._checksums, findings)
            is_published = self._manifest.get("job") == "publish"
            self._num_others = check_other_files(folder, self._checksums, findings, is_published=is_published)
        self._known = KnownIds(frozenset(file.table for file in self._files))
        self._counts = CountCheck(self._manifest, self._files, findings)
        is_selection = self._manifest.get("job") == "query"  # an older one has a texture once for each shard that it was in
        self._keys = {table: KeyCheck(table, findings) for table in KEYS if not (is_selection and table == "textures")}
        # A run that is not finished may have rows whose scenes, and scenes whose assets, are still to be made.
        self._foreign_keys = _foreign_keys(self._manifest) if self._is_finished else {}
        origin = origin_of(self._manifest)
        facts = AssetFacts()
        self._preprocessed: PreprocessedCheck | None = None
        if self._is_finished and origin.get("job") == "preprocess":
            self._preprocessed = PreprocessedCheck(origin, self._known, facts, findings)
        self._checks = self._row_checks(facts)
        self._generated = GeneratedCheck(origin, self._known, findings) if origin.get("job") == "generate" else None
        self._chosen = _ChosenScenes(options.sample, options.seed)
        self._num_checked = 0

    def run(self) -> Verification:
        """Verifies the run."""
        began = perf_counter()
        if self._options.source is not None:
            self._read_source(self._options.source)
        made_by = self._manifest.get("code_versions")
        carried = _CARRIED if self._manifest.get("job") in ("correct", "edit", "reach") else frozenset[str]()
        schemas = SchemaCheck(list(map(str, made_by)) if isinstance(made_by, list) else [], carried, self._findings)
        if older_version(self._manifest) is not None:
            return self._result({}, 0, 0, began)
        files = sorted(self._files, key=_reading_order)
        for number, file in enumerate(files):
            self._check_file(file, schemas)
            self._progress("files", number + 1, len(files))
        for check in self._checks.values():
            if isinstance(check, TurnCheck | SampleCheck):
                self._close(check)
        for keys in self._keys.values():
            keys.close()
        if self._is_finished:
            self._check_assets_have_meshes()
            if self._generated is not None:
                self._generated.close()
            if self._preprocessed is not None:
                self._close(self._preprocessed)
        self._counts.close(has_checksums=self._checksums is not None)
        audited, simulated = self._check_verdicts()
        return self._result({table: count for table, count in self._counts.rows.items() if count}, audited, simulated, began)

    def _result(self, rows: Mapping[str, int], audited: int, simulated: int, began: float) -> Verification:
        return Verification(
            self._folder.uri,
            str(self._manifest.get("job", "")),
            self._is_finished,
            dict(self._findings.num_damaged),
            tuple(self._findings.unknown),
            len(self._files) + self._num_others,
            self._num_checked + self._num_others,
            rows,
            self._chosen.num_scenes,
            audited,
            simulated,
            perf_counter() - began,
        )

    def _row_checks(self, facts: AssetFacts) -> dict[str, RowCheck]:
        known, findings = self._known, self._findings
        scenes = ScenesOfShards(self._folder, self._files)
        job = self._manifest.get("job")
        may_be_older = "upgraded_to" in self._manifest or job in _OF_OTHER_RUNS
        of_scene = SceneCheck(
            known,
            facts,
            split_rule(self._manifest),
            findings,
            needs_assets=self._is_finished and job not in _WITHOUT_ASSETS,
            may_be_older=may_be_older,
            is_finished=self._is_finished,
            unasked=unasked_columns(origin_of(self._manifest)),
        )
        in_one_shard = _IN_ONE_SHARD.get(str(job), frozenset()) if self._is_finished else frozenset[str]()
        mates = {table: ShardMates(scenes, known, findings) for table in in_one_shard}
        is_edit = job == "edit"
        encoder = self._manifest.get("encoder")
        return {
            "textures": TextureCheck(findings),
            "meshes": MeshCheck(known, facts, findings),
            "assets": AssetCheck(facts, findings),
            "sdf": GridCheck(facts, findings),
            "features": FeatureCheck(encoder if isinstance(encoder, str) else None, findings),
            **dict.fromkeys(_SCENES, of_scene),
            "turns": TurnCheck(scenes, findings, mates.get("turns")),
            **{
                table: JoinedCheck(table, scenes, "scene_id", findings, mates.get(table))
                for table in ("settled", "grasps", "corrections")
            },
            "samples": SampleCheck(scenes, findings, mates.get("samples"), may_be_older=may_be_older),
            **({"edits": JoinedCheck("edits", scenes, "edit_id", findings, mates.get("edits"))} if is_edit else {}),
            **{table: OwnCheck(table, findings) for table in ("episodes", "ratings", "views")},
        }

    def _check_file(self, file: ShardFile, schemas: SchemaCheck) -> None:
        checksum = None if self._checksums is None else self._checksums.get(file.name)
        self._num_checked += checksum is not None
        opened = open_file(self._folder, file, checksum, self._findings)
        if opened is None:
            return
        with opened:
            is_known = file.table in RULES  # others are of custom jobs: their files are read and their rows are counted
            is_usable = is_known and schemas.check(opened.schema_arrow, file)
            for start, rows in row_groups(opened, file, self._findings):
                if is_usable:
                    self._check_rows(rows, start, file)
                elif not is_known:
                    self._counts.note(rows, file)

    def _check_rows(self, rows: pa.Table, start: int, file: ShardFile) -> None:
        try:
            check_values(rows, start, file, self._findings)
            self._note_rows(rows, start, file)
        except Exception as error:  # noqa: BLE001 - a value that no check expects is damage, and ends no verification
            self._findings.damage(file.name, _unchecked(error), start)
        checks = [self._checks[file.table]] if file.table in self._checks else []
        if self._preprocessed is not None and file.table in PreprocessedCheck.TABLES:
            checks.append(self._preprocessed)
        if checks:
            self._check_slices(checks, rows, start, file)

    def _note_rows(self, rows: pa.Table, start: int, file: ShardFile) -> None:
        """Counts rows, notes their ids, and looks up what they refer to."""
        table = file.table
        if table in self._keys:
            self._keys[table].note(rows, start, file)
        if table in KEYS:
            self._known.add(table, rows[KEYS[table][0]])
        elif table == "failures":
            self._known.add(table, rows["id"])
        self._counts.note(rows, file)
        if self._generated is not None:
            self._generated.note(rows, start, file)
        for key in self._foreign_keys.get(table, ()):
            key.check(rows, start, file, self._known, self._findings)
        if table in _SCENES:
            self._chosen.note(rows, start, file)

    def _check_slices(self, checks: Sequence[RowCheck], rows: pa.Table, start: int, file: ShardFile) -> None:
        for part in row_slices(rows):
            found: list[Row] | None = None
            for check in checks:
                try:
                    found = rows_from_table(part) if found is None else found
                    check.check(found, start, file)
                except Exception as error:  # noqa: BLE001 - as above
                    self._findings.damage(file.name, _unchecked(error), start)
            start += part.num_rows

    def _close(self, check: TurnCheck | SampleCheck | PreprocessedCheck) -> None:
        try:
            check.close()
        except Exception as error:  # noqa: BLE001 - as above
            self._findings.damage(check.TABLE, _unchecked(error))

    def _read_source(self, source: RunFolder) -> None:
        """Reads the ids of the scenes of the source."""
        for table in _SCENES:
            if source.files(table):
                for batch in source.batches(table, ["scene_id"]):
                    self._known.add(_SOURCE, batch["scene_id"])
        self._known.there |= {_SOURCE}

    def _check_assets_have_meshes(self) -> None:
        """Each asset has one mesh, and each mesh belongs to an asset."""
        there, ids = self._known.there, self._known.of
        if {"assets", "meshes"} <= there:
            for table, other in (("assets", "meshes"), ("meshes", "assets")):
                lost = int((~ids.get(other, IdSet()).has_hashes(ids.get(table, IdSet()).hashes)).sum())
                if lost:
                    self._findings.damage(table, f"{lost} assets are in no row of {other}, expected each in both")

    def _check_verdicts(self) -> tuple[int, int]:
        """Judges the chosen scenes again; returns how many were audited, and how many were simulated."""
        options, findings = self._options, self._findings
        if options.verdicts == "none" or not self._chosen.num_scenes:
            return 0, 0
        try:
            checks = import_module("stable_data.verification.verdict_checks")
        except ModuleNotFoundError as error:
            findings.cannot_know(f"verdicts: the audit {install_hint(error) or error}; or leave them out with --verdicts none")
            return 0, 0
        simulates, origin = options.verdicts == "all", origin_of(self._manifest)
        judges = settings_of(origin).get("judges") if str(origin.get("job")) in SETTLING else None
        is_settled = isinstance(judges, str) and "mujoco" in judges
        if simulates and (is_settled or self._chosen.num_simulated) and find_spec("mujoco") is None:
            hint = install_hint(ModuleNotFoundError(name="mujoco"))
            findings.cannot_know(f"whether scenes are stable: MuJoCo {hint}; or leave it out with --verdicts audit")
            simulates = False
        try:
            threshold = important_threshold(origin)
            if threshold is None and origin.get("job") == "preprocess":
                findings.cannot_know("the stages of scenes: the setting important_threshold is missing, or is no number")
            check: VerdictCheck = checks.VerdictCheck(
                self._folder,
                findings,
                simulates=simulates,
                is_settled=is_settled,
                important_threshold=threshold,
                assets=self._options.assets,
            )
        except ConfigError as error:
            findings.cannot_know(f"verdicts: {error}")
            return 0, 0
        total = self._chosen.num_chosen
        for number, (row, place, file) in enumerate(self._chosen.rows(self._folder, self._files)):
            check.check(row, place, file)
            self._progress("verdicts", number + 1, total)
        return check.num_audited, check.num_simulated


def _unchecked(error: Exception) -> str:
    return f"cannot be checked: {type(error).__name__}: {error}"


def _foreign_keys(manifest: Mapping[str, Any]) -> Mapping[str, tuple[ForeignKey, ...]]:
    """The columns of each table of a run that name rows of others."""
    job = str(manifest.get("job"))
    # Assets are deleted from a pruned run, and what was remarked on them is kept.
    has_items = job in ("generate", "preprocess", "correct") and PRUNED not in manifest
    assets = ("assets", UNRESOLVED)
    external = ("scenes", _SOURCE)
    return {
        "sdf": (ForeignKey("asset_id", ("assets",)),),
        "features": (ForeignKey("asset_id", ("assets",)),),
        **dict.fromkeys(
            _SCENES,
            (
                ForeignKey("surface.asset_id", ("assets",)),
                ForeignKey("surface.asset_id", ("meshes",)),
                ForeignKey("variant_of", (_SOURCE,)),
            ),
        ),
        "turns": (ForeignKey("scene_id", _OF_SCENES),),
        "warnings": (ForeignKey("id", (*_OF_SCENES, "assets"), OF_DATASET),) if has_items else (),
        # Those of a run whose reach is surveyed are copied with it, also those of its rejected scenes.
        "settled": () if job == "reach" else (ForeignKey("scene_id", _SCENES),),
        "grasps": (ForeignKey("scene_id", _SCENES),),
        "corrections": (ForeignKey("scene_id", _OF_SCENES),),
        "samples": (
            ForeignKey("scene_id", ("scenes",)),
            *(ForeignKey(f"{name}.asset_id", assets) for name in ("objects_in", "objects_out")),
        ),
        "edits": (
            ForeignKey("edit_id", _OF_SCENES) if job == "edit" else ForeignKey("scene_id", ("scenes",)),
            *(() if job != "edit" else (ForeignKey("scene_id", (_SOURCE,)),)),
        ),
        "ratings": (ForeignKey("scene_id", external),),
        "views": (ForeignKey("scene_id", external),),
        "episodes": (ForeignKey("scene_id", external),),
    }


@dataclass(slots=True)
class _ChosenScenes:
    """The scenes whose verdicts are computed again, chosen by a hash of their ids and the seed; their places are kept, not their rows.

    Attributes:
        sample: Their number; 0: all.
        seed: The seed.
        num_scenes: Scenes of the run.
        num_simulated: Those of them with a verdict on stability.
    """

    sample: int
    seed: int
    num_scenes: int = 0
    num_simulated: int = 0
    _places: list[tuple[int, str, int]] = field(default_factory=list)

    @property
    def num_chosen(self) -> int:
        """The number of chosen scenes."""
        return min(self.sample, self.num_scenes) if self.sample else self.num_scenes

    def note(self, rows: pa.Table, start: int, file: ShardFile) -> None:
        """Notes the scenes of a row group."""
        self.num_scenes += rows.num_rows
        if "stable" in rows.column_names:
            self.num_simulated += rows.num_rows - rows["stable"].null_count
        if not self.sample:
            return
        names = pc.binary_join_element_wise(str(self.seed), pc.fill_null(rows["scene_id"], ""), "/")
        for number, rank in enumerate(id_hashes(names)[:, 0].tolist(), start):
            entry = -rank, file.name, number  # the heap begins with the largest rank, which leaves first
            if len(self._places) < self.sample:
                heapq.heappush(self._places, entry)
            elif entry > self._places[0]:
                heapq.heapreplace(self._places, entry)

    def rows(self, folder: RunFolder, files: Sequence[ShardFile]) -> Iterator[tuple[Row, int, ShardFile]]:
        """Yields the rows of the chosen scenes, file by file, with the number in their file."""
        chosen: dict[str, set[int]] = {}
        for _, name, number in self._places:
            chosen.setdefault(name, set()).add(number)
        for file in files:
            if file.table not in _SCENES or (self.sample and file.name not in chosen):
                continue
            silent = Findings(lambda _: None)  # what cannot be read was reported before
            opened = open_file(folder, file, None, silent)
            if opened is None:
                continue
            with opened, suppress(ConfigError):
                for start, rows in row_groups(opened, file, silent):
                    wanted = [n for n in range(start, start + rows.num_rows) if not self.sample or n in chosen[file.name]]
                    for number in wanted:
                        yield rows.slice(number - start, 1).to_pylist()[0], number, file
