"""How far a robot has come with its task: the state of the simulation as the goal's conditions see it."""

import numpy as np

from stable_data.robot.world import RobotWorld
from stable_data.scene import FloatArray
from stable_data.tasks.checking import GoalChecker, SceneState
from stable_data.tasks.goal import Goal, Step, StepAction
from stable_data.tasks.placing import target_poses

_RESTING = 0.02  # an object is at rest below this speed, metres a second


class TaskProgress:
    """Follows a task in a simulation.

    Args:
        goal: The goal.
        world: The simulation, at its start.
    """

    def __init__(self, goal: Goal, world: RobotWorld) -> None:
        self.goal, self._world = goal, world
        self._checker = GoalChecker(goal, world.built.geometry)
        self.reset()

    def reset(self) -> None:
        """Starts anew from the present state of the simulation."""
        self.state = scene_state(self._world)
        self._places: dict[int, FloatArray | None] = {}

    def update(self) -> tuple[float, bool]:
        """Looks at the simulation; returns the reward and whether the goal is fulfilled."""
        self.state = scene_state(self._world)
        is_success = self._checker.is_success(self.state)
        return (1.0 if is_success else self._checker.reward(self.state)), is_success

    @property
    def step(self) -> tuple[int, Step] | None:
        """The step of the task that comes next, and its number; None if all are done."""
        number = self._checker.num_steps_done(self.state)
        return (number, self.goal.steps[number]) if number < len(self.goal.steps) else None

    def now(self) -> tuple[str | None, str | None, FloatArray | None]:
        """What the next step acts on, the object that it relates this to, and where it shall be put, (3,), metres."""
        found = self.step
        if found is None:
            return None, None, None
        number, step = found
        # A pick is followed by the place of the same object: the policy may know from the start where it goes.
        then = self.goal.steps[number + 1] if number + 1 < len(self.goal.steps) else None
        placing, at = (step, number) if step.action is not StepAction.PICK else (then, number + 1)
        if placing is None or placing.subject != step.subject:
            return step.subject, None, None
        if at not in self._places:
            poses = target_poses(placing, self._world.built.geometry, self.state)
            self._places[at] = None if not poses else np.asarray(poses[0].position, np.float64)
        names = self._world.built.names
        target = next((c.target for c in placing.conditions if c.target in names), None)
        return step.subject, target, self._places[at]


def scene_state(world: RobotWorld) -> SceneState:
    """Returns the state of a simulation as conditions see it."""
    poses, contacts = world.object_poses, world.contacts()
    return SceneState(
        positions=poses[:, :3],
        quats_xyzw=poses[:, 3:],
        touching=contacts.supports,
        held=contacts.held,
        is_moving=bool(world.object_speeds.max(initial=0.0) > _RESTING),
        gripper_position=world.tool_position,
    )
