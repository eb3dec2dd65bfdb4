"""A table whose objects and goals are known, and an oracle that puts objects where a goal wants them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.scene import Scene, SceneObject, Tabletop, TaskInfo
from stable_data.tasks.checking import SceneState, start_state
from stable_data.tasks.compiling import goal_from_conditions
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal, StepAction
from stable_data.tasks.placing import carried_by, placed_state, target_poses
from tests.scenes import box, cup

TABLE = Tabletop("desk", (1.2, 0.7))

SHAPES = {
    "mug": cup(0.04, 0.1, 0.004),
    "bin": cup(0.1, 0.15, 0.005),
    "book": box(0.2, 0.15, 0.03),
    "block": box(0.05, 0.05, 0.05),
    "plate": box(0.16, 0.16, 0.02),
    "pen": box(0.14, 0.012, 0.012),
}
_PLACES: Mapping[str, tuple[str, float, float, str]] = {
    "mug_0": ("mug", 0.2, 0.2, "table"),
    "bin_0": ("bin", 0.9, 0.45, "table"),
    "book_0": ("book", 0.5, 0.2, "table"),
    "block_0": ("block", 0.5, 0.2, "book_0"),
    "block_1": ("block", 0.2, 0.45, "table"),
    "block_2": ("block", 0.35, 0.5, "table"),
    "plate_0": ("plate", 0.75, 0.15, "table"),
    "pen_0": ("pen", 0.9, 0.45, "bin_0"),
}


def geometry(task: TaskInfo | None = None) -> TaskGeometry:
    """A mug, a bin with a pen, a book with a block on it, a plate and two more blocks."""
    objects, shapes = [], []
    for name, (category, x, y, support) in _PLACES.items():
        shape = SHAPES[category]
        bottom = 0.0 if support == "table" else 0.03 if support == "book_0" else 0.011
        a, b, c = shape.size.tolist()
        objects.append(
            SceneObject(
                name, category, (x, y, bottom + c / 2), 0.0, (a, b, c), asset_id=category, scale=(1, 1, 1), support=support
            )
        )
        shapes.append(shape)
    containers = {name: place[0] in ("mug", "bin") for name, place in _PLACES.items()}
    return TaskGeometry(Scene("scene", TABLE, tuple(objects), task), tuple(shapes), containers)


def goal(*conditions: GoalCondition) -> Goal:
    return goal_from_conditions(conditions, geometry())


def moved(state: SceneState, space: TaskGeometry, name: str, position: Sequence[float], *touched: str) -> SceneState:
    """The state with an object elsewhere, upright, touching supports."""
    positions, quats = state.positions.copy(), state.quats_xyzw.copy()
    positions[space.rows[name]], quats[space.rows[name]] = position, (0, 0, 0, 1)
    return replace(state, positions=positions, quats_xyzw=quats, touching={**state.touching, name: touched})


def lifted(state: SceneState, space: TaskGeometry, name: str, height: float = 0.1) -> SceneState:
    """The state with an object in the gripper, and what it carries in it."""
    positions = state.positions.copy()
    for one in (name, *carried_by(state, name)):
        positions[space.rows[one], 2] += height
    touching = {**state.touching, name: ()}
    gripper = positions[space.rows[name]]
    return replace(state, positions=positions, touching=touching, held=frozenset({name}), gripper_position=gripper)


def states_of(target: Goal, space: TaskGeometry) -> list[SceneState]:
    """The states after each step of a goal, if all steps succeed; the first is the start.

    Raises:
        GoalError: There is no free place.
    """
    states = [start_state(space)]
    for step in target.steps:
        state = states[-1]
        if step.action is StepAction.PICK:
            states.append(lifted(state, space, step.subject))
            continue
        pose = target_poses(step, space, state)[0]
        states.append(replace(placed_state(space, state, step.subject, pose), gripper_position=np.array(pose.position)))
    return states


def of(subject: str, kind: str, target: str = "", distance: float | None = None, *, negated: bool = False) -> GoalCondition:
    return GoalCondition(subject, ConditionKind(kind), target, distance, negated)
