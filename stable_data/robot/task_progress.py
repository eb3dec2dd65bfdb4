"""How far a robot has come with its task: the state of the simulation as the goal's conditions see it."""

from contextlib import suppress

import numpy as np

from stable_data.errors import GoalError
from stable_data.robot.arm.world import RobotWorld
from stable_data.scene import FloatArray
from stable_data.tasks.checking import GoalChecker, SceneState, start_state
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal, Step, StepAction
from stable_data.tasks.placing import TargetPose, target_poses

_PLACES = 16  # poses that are tried for a placed object
_STEADY = 3  # looks in a row at which a goal must be fulfilled, so that a passing moment does not count


class TaskProgress:
    """Follows a task in a simulation.

    Args:
        goal: The goal.
        geometry: The scene at the start.
        world: The simulation, at its start.

    Attributes:
        goal: The goal.
        state: The state of the scene at the last look.
    """

    def __init__(self, goal: Goal, geometry: TaskGeometry, world: RobotWorld) -> None:
        self.goal, self._geometry, self._world = goal, geometry, world
        self._checker = GoalChecker(goal, geometry)
        self.reset()

    def reset(self) -> None:
        """Starts anew from the present state of the simulation."""
        self.state = scene_state(self._world)
        self._places: dict[int, FloatArray | None] = {}
        self._fulfilled = 0

    def update(self) -> tuple[float, bool]:
        """Looks at the simulation; returns the reward, and whether the goal is fulfilled and was so at the last looks too."""
        self.state = scene_state(self._world)
        self._fulfilled = self._fulfilled + 1 if self._checker.is_success(self.state) else 0
        return self._checker.reward(self.state), self._fulfilled >= _STEADY

    def unfulfilled(self) -> tuple[str, ...]:
        """The conditions of the goal that do not hold, in words."""
        held = self._checker.conditions(self.state)
        return tuple(str(c) for c, is_held in zip(self.goal.conditions, held, strict=True) if not is_held)

    def is_done(self, number: int) -> bool:
        """Whether a step of the goal is done."""
        return self._checker.steps_done(self.state)[number]

    def places(self, step: Step) -> tuple[TargetPose, ...]:
        """Poses at which a step can put its subject now, best first.

        Raises:
            GoalError: There is none.
        """
        return target_poses(step, self._geometry, self.state, _PLACES)

    def now(self) -> tuple[str | None, str | None, FloatArray | None]:
        """What the next step acts on, the object that it relates this to, and where it shall be put, (3,), metres."""
        done = self._checker.steps_done(self.state)
        number = next((k for k, is_done in enumerate(done) if not is_done), None)
        if number is None:
            return None, None, None
        step, at = self.goal.steps[number], number
        if step.action is StepAction.PICK:  # whoever picks may know where it goes
            at = number + 1
            if at == len(self.goal.steps) or self.goal.steps[at].subject != step.subject:
                return step.subject, None, None
        placing = self.goal.steps[at]
        if at not in self._places:
            try:
                self._places[at] = np.array(self.places(placing)[0].position)
            except GoalError:
                self._places[at] = None  # no free place
        names = self._world.built.names
        target = next((name for c in placing.conditions for name in c.targets if name in names), None)
        return step.subject, target, self._places[at]


def target_places(goal: Goal, geometry: TaskGeometry) -> FloatArray:
    """Returns a place where each step of a goal that puts an object down can do so at the start, (P, 2), metres.

    Steps for which there is none are left out.
    """
    found = []
    for step in goal.steps:
        if step.action is not StepAction.PICK:
            with suppress(GoalError):
                found.append(target_poses(step, geometry, start_state(geometry), 1)[0].position[:2])
    return np.array(found, np.float64).reshape(-1, 2)


def scene_state(world: RobotWorld) -> SceneState:
    """Returns the state of a simulation as conditions see it."""
    poses, contacts = world.object_poses, world.contacts()
    return SceneState(
        positions=poses[:, :3],
        quats_xyzw=poses[:, 3:],
        touching=contacts.supports,
        held=contacts.held,
        grasped=contacts.gripped,
        max_speed=float(world.object_speeds.max(initial=0.0)),
        gripper_position=world.tool_position,
    )
