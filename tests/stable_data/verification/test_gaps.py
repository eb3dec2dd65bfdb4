"""A gap that was edited is found, also where the order of the faces of a mesh is lost that its sample of points depends on."""

from pathlib import Path

import pytest

from stable_data.assets.run_assets import run_store
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from stable_data.verification.verdict_checks import audit_faults
from tests.stable_data.verification.editing import small_run


@pytest.mark.parametrize(
    ("added_mm", "gap_mm", "in_order", "out_of_order"),
    [
        (0.005, 0.2, False, False),
        (0.05, 0.2, True, False),
        (0.5, 0.2, True, False),
        (1.2, 0.2, True, True),
        (3.0, 15.0, True, True),
    ],
)
def test_an_edited_gap_is_found(added_mm: float, gap_mm: float, in_order: bool, out_of_order: bool, tmp_path: Path) -> None:
    run = RunFolder(str(small_run(tmp_path)))
    row = run.table("scenes").to_pylist()[0]
    resolved, shapes, _ = run_store(run.uri).resolved(scene_from_row(row))
    audit = audit_posed_scene(PosedScene(resolved, shapes))
    rows = audit.rows()
    name = row["verdicts"][0]["instance"]
    assert list(audit_faults(row, audit)) == []
    shifted = type("Audit", (), {"rows": lambda self: rows})()
    rows["verdicts"][0]["gap_mm"] = gap_mm
    row["verdicts"][0]["gap_mm"] = gap_mm + added_mm
    assert bool(list(audit_faults(row, shifted))) is in_order
    assert bool(list(audit_faults(row, shifted, {name}))) is out_of_order
