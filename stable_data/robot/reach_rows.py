"""Rows of tables from what a robot reaches and holds: columns of ``scenes``, and rows of ``grasps``."""

from dataclasses import asdict

from stable_data.metrics.reach_columns import REACH_COLUMNS
from stable_data.robot.reach import ObjectReach, SceneReach
from stable_data.storage.schemas import Row


def reach_columns(found: SceneReach | None) -> Row:
    """Returns the columns of ``scenes`` for a survey; all null without one."""
    if found is None:
        return dict.fromkeys(REACH_COLUMNS)
    return {
        "robot": found.robot,
        "robot_mount": found.mount,
        "task_kind": found.task_kind,
        "task_reachable": found.task_reachable,
        "task_graspable": found.task_graspable,
        "task_reason": found.task_reason,
        "reach": [_object_row(one) for one in found.objects],
    }


def grasp_rows(scene_id: str, found: SceneReach | None) -> list[Row]:
    """Returns the rows of ``grasps`` for a survey, one for each grasp that was tried."""
    if found is None:
        return []
    return [
        {
            "scene_id": scene_id,
            "instance": grasp.instance,
            "number": grasp.number,
            "robot": found.robot,
            "position": grasp.position,
            "quat_xyzw": grasp.quat_xyzw,
            "width_m": grasp.width,
            "opening_m": grasp.opening,
            "score": grasp.score,
            "outcome": str(grasp.outcome),
        }
        for grasp in found.grasps
    ]


def _object_row(one: ObjectReach) -> Row:
    blocked = None if one.blocked_by is None else [{"name": name, "count": count} for name, count in one.blocked_by.items()]
    return asdict(one) | {"role": str(one.role), "blocked_by": blocked}
