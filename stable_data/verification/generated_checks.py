"""Checks that a run of generate has what its job leaves of each scene: it meets the rule of acceptance, and it has its turns."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.errors import ConfigError
from stable_data.storage.filter_expression import FilterExpression, parse_filter
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.manifest import MANIFEST
from stable_data.storage.run_changes import PRUNED
from stable_data.storage.schema_checks import conform_to_schema
from stable_data.storage.schemas import SCHEMAS
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.manifest_checks import settings_of
from stable_data.verification.shard_files import ShardFile

_STEP = "accept"
"""The step of the failures that say why scenes were rejected."""

_ROW = "number of the row"


class GeneratedCheck:
    """Checks rows of ``scenes``, ``rejected`` and ``failures`` of a run of generate.

    Args:
        manifest: The manifest of the run, or of the one that a published run was made of.
        known: Ids of all scenes, and of those of turns and of settled poses.
        findings: Where damage is noted.
    """

    def __init__(self, manifest: Mapping[str, Any], known: KnownIds, findings: Findings) -> None:
        self._known, self._findings = known, findings
        settings = settings_of(manifest)
        self._keeps_settled, self._is_pruned = settings.get("keep_settled") is True, PRUNED in manifest
        self._is_proposed = settings.get("layout") != "files"  # layouts of another system have no turns
        self._judged, self._refused, self._varied = IdSet(), IdSet(), IdSet()
        self._accept: FilterExpression | None = None
        rule = settings.get("accept")
        try:
            if isinstance(rule, str) and rule.strip():
                self._accept = parse_filter(rule, SCHEMAS["scenes"])
        except ConfigError as error:
            findings.damage(MANIFEST, f"settings.accept: {error}")

    def note(self, rows: pa.Table, start: int, file: ShardFile) -> None:
        """Checks and notes rows of a file, of which the first has a number."""
        if file.table == "failures":
            self._refused.add(rows["id"].filter(pc.equal(rows["step"], _STEP)))
        elif file.table in ("scenes", "rejected"):
            if "varied" in rows.column_names:
                self._varied.add(rows["scene_id"].filter(rows["varied"].is_valid()))
            if "stable" in rows.column_names:
                self._judged.add(rows["scene_id"].filter(rows["stable"].is_valid()))
            if file.table == "scenes" and self._accept is not None:
                self._check_accepted(self._accept, rows, start, file)

    def _check_accepted(self, rule: FilterExpression, rows: pa.Table, start: int, file: ShardFile) -> None:
        """Reports the scenes that do not meet the rule of acceptance."""
        schema = pa.schema([SCHEMAS["scenes"].field(name) for name in rule.columns])
        numbers = np.arange(rows.num_rows)
        known = conform_to_schema(rows.select([name for name in rule.columns if name in rows.column_names]), schema)
        accepted = rule.rows(known.append_column(_ROW, pa.array(numbers)))[_ROW].to_numpy()
        for number in np.setdiff1d(numbers, accepted).tolist():
            values = ", ".join(f"{name} is {value}" for name, value in known.slice(number, 1).to_pylist()[0].items())
            what = f"{rows['scene_id'][number]}: does not meet the rule {rule.text!r:.80} of its run: {values}"
            self._findings.damage(file.name, what, start + number)

    def close(self) -> None:
        """Compares which scenes have turns, settled poses and a failure, after all rows were noted."""
        for table in ("scenes", "rejected"):
            scenes = self._ids(table)
            proposed = scenes.hashes[~self._varied.has_hashes(scenes.hashes)]  # most variants are made without the reasoner
            lost = int((~self._ids("turns").has_hashes(proposed)).sum())
            if lost and self._is_proposed:
                self._findings.damage("turns", f"{lost} {table} have no turn, expected at least one of each")
            if self._keeps_settled:
                judged = scenes.hashes[self._judged.has_hashes(scenes.hashes)]
                lost = int((~self._ids("settled").has_hashes(judged)).sum())
                if lost:
                    what = f"{lost} {table} have no row, expected one of each that was simulated: keep_settled is set"
                    self._findings.damage("settled", what)
        if not self._is_pruned:
            rejected = self._ids("rejected")
            self._compare("rejected", self._refused, rejected, "scenes were not accepted by failures, but have no row")
            self._compare("failures", rejected, self._refused, f"rejected have no failure of the step {_STEP}")

    def _ids(self, name: str) -> IdSet:
        return self._known.of.get(name, IdSet())

    def _compare(self, where: str, ids: IdSet, others: IdSet, what: str) -> None:
        if lost := int((~others.has_hashes(ids.hashes)).sum()):
            self._findings.damage(where, f"{lost} {what}")
