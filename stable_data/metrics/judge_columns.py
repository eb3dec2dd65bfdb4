"""The judges by name, and their columns of ``scenes``: verdicts of physics engines other than MuJoCo, and the share of robust rest."""

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class JudgeInfo:
    """What is known of a judge without its engine.

    Attributes:
        engine: Name of its engine for readers.
        package: The module that its adapter imports.
    """

    engine: str
    package: str


JUDGES = {
    "mujoco": JudgeInfo("MuJoCo", "mujoco"),
    "sapien": JudgeInfo("PhysX (SAPIEN)", "sapien"),
    "drake": JudgeInfo("Drake SAP", "pydrake"),
}
"""Every judge; the adapter is the module of this name in ``stable_data.judges``."""

FURTHER = tuple(name for name in JUDGES if name != "mujoco")
"""The judges that have columns of their own name; those of MuJoCo are older and are named without it."""

SHARE = "stable_share"
"""Column of the share of repetitions in which a scene was stable (``stable_data.judges.robust_rest``)."""

MUJOCO_COLUMNS = (
    "stable",
    "settle_move_max_mm",
    "settle_turn_max_deg",
    "drift_mm",
    "jitter_mm",
    "engine_penetration_mm",
)
"""Columns of the verdict of MuJoCo, fields of the metric card."""


def verdict_columns(name: str) -> tuple[str, str, str]:
    """Returns the columns of a judge: whether the scene is stable, the largest move, mm, and the largest turn, degrees."""
    if name == "mujoco":
        return "stable", "settle_move_max_mm", "settle_turn_max_deg"
    return f"{name}_stable", f"{name}_move_max_mm", f"{name}_turn_max_deg"


FURTHER_COLUMNS = (*(column for name in FURTHER for column in verdict_columns(name)), SHARE)
"""The columns of ``scenes`` that are no fields of the metric card; null where no judge was asked."""


def columns_not_filled(columns: Collection[str], judges: Collection[str], has_share: bool) -> dict[str, str]:
    """Returns those of some columns that no verdict fills.

    Args:
        columns: Names of columns of ``scenes``.
        judges: The judges that run.
        has_share: Whether the share of robust rest is computed.

    Returns:
        Column -> the judge that would fill it, or ``robust_rest``.
    """
    owners = dict.fromkeys(MUJOCO_COLUMNS, "mujoco")
    owners |= {column: name for name in FURTHER for column in verdict_columns(name)}
    running = {*judges, *(["robust_rest"] if has_share else [])}
    owners[SHARE] = "robust_rest"
    return {column: owners[column] for column in columns if column in owners and owners[column] not in running}
