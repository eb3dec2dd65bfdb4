"""The columns of ``scenes`` that say what a robot reaches and holds (:mod:`stable_data.robot.reach`); null where no robot was asked."""

from collections.abc import Collection

REACHABLE, GRASPABLE, REASON = "task_reachable", "task_graspable", "task_reason"
"""Columns of the verdict on the task."""

REACH_COLUMNS = ("robot", "robot_mount", "task_kind", REACHABLE, GRASPABLE, REASON, "reach")
"""All columns, in their order."""


def reach_columns_not_filled(columns: Collection[str], robot: str, tries: int) -> dict[str, str]:
    """Returns those of some columns that no survey fills.

    Args:
        columns: Names of columns of ``scenes``.
        robot: The robot; empty: none.
        tries: Grasps of an object that are tried.

    Returns:
        Column -> the setting that would fill it.
    """
    found = {column: "robot" for column in columns if column in REACH_COLUMNS and not robot}
    return found | ({GRASPABLE: "grasp_tries"} if robot and not tries and GRASPABLE in columns else {})
