"""Layouts that a reasoner proposed, with their corrections: the turns of a generate run as training samples.

A turn has the poses before and after its correction. A sample has the objects that the turn, its correction and the accepted scene have in
common: its coarse layout is the proposal, and its target the corrected layout. Only turns that were accepted and whose correction is clean
are used: names of a rejected attempt may mean other objects.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow.compute as pc

from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, Scene
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table

TABLES = ("scenes", "turns", "meshes")
"""The tables of a generate run that are read."""

_COLUMNS = {name: pc.field(name) for name in ("scene_id", "turn", "coarse", "corrected", "code")} | {
    "clean": pc.field("card_after", "clean")
}


@dataclass(frozen=True, slots=True, eq=False)
class ProposalSample:
    """A proposed layout with its correction.

    Attributes:
        scene: The corrected layout: the objects of the accepted scene that were there, at their poses after the turn.
        coarse: Proposed poses of these objects, (N, 4) float64, metres and radians.
        split: The split of the scene.
    """

    scene: Scene
    coarse: FloatArray
    split: str


def read_proposals(uri: str, meshes: Mapping[str, str]) -> tuple[list[ProposalSample], dict[str, int]]:
    """Reads the proposals of the accepted scenes of a generate run.

    Args:
        uri: The run.
        meshes: Hash of the mesh of each asset that may be used. A scene with another asset, or another mesh of it, is left out.

    Returns:
        The proposals, and their numbers by reason.

    Raises:
        ConfigError: A table is missing (``table_missing``) or cannot be read.
    """
    run = RunFolder(uri)
    for name in TABLES:
        if not run.files(name):
            raise ConfigError(f"{uri}: no table {name}, expected the folder of a generate run", "table_missing")
    own_meshes = run.table("meshes", ["asset_id", "sha256"]).to_pylist()
    usable = {row["asset_id"] for row in own_meshes if meshes.get(row["asset_id"]) == row["sha256"]}
    turns = defaultdict[str, list[Mapping[str, Any]]](list)
    for row in run.table("turns", _COLUMNS).to_pylist():
        turns[row["scene_id"]].append(row)
    found: list[ProposalSample] = []
    counts = {"proposals": 0, "proposals_used": 0, "left_out_without_correction": 0, "left_out_of_other_assets": 0}
    table = TableFiles(uri, "scenes", [*SCENE_LEAVES, "split"])
    for group in range(len(table.groups)):
        rows = table.read([group])
        for scene, split in zip(scenes_from_table(rows), rows["split"].to_pylist(), strict=True):
            own = sorted(turns.get(scene.scene_id, ()), key=lambda row: row["turn"])
            counts["proposals"] += len(own)
            if any(o.asset_id not in usable for o in scene.objects):
                counts["left_out_of_other_assets"] += len(own)
                continue
            proposals = [p for row in own if (p := _proposal(scene, split, row)) is not None]
            counts["proposals_used"] += len(proposals)
            counts["left_out_without_correction"] += len(own) - len(proposals)
            found += proposals
    return found, counts


def _proposal(scene: Scene, split: str, row: Mapping[str, Any]) -> ProposalSample | None:
    """The proposal of one turn; None if it was rejected, its correction is not clean, or nothing of it stays."""
    if row["code"] or row["clean"] is not True:
        return None
    before, after = ({pose["instance"]: pose for pose in row[name] or ()} for name in ("coarse", "corrected"))
    objects = [o for o in scene.objects if o.instance in before and o.instance in after]
    if not objects:
        return None
    there = tuple(o.moved(tuple(after[o.instance]["position"]), after[o.instance]["yaw"]) for o in objects)
    coarse = [[*before[o.instance]["position"], before[o.instance]["yaw"]] for o in objects]
    return ProposalSample(replace(scene, objects=there), np.array(coarse, np.float64), split)
