"""Compiles the task info of a scene into a goal that can be checked.

The conditions are those of the task info (``TaskInfo.conditions``), which templates and the instruction reader write with the exact
instances. Where it has none, as in files of MesaTask, its ``Goal`` sentences and its actions are read instead.
"""

from collections.abc import Mapping, Sequence

from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import GoalError
from stable_data.instructions.task_info import resolve_task_objects
from stable_data.scene import Scene
from stable_data.scene_graph.relations import contacts_of, scene_graph
from stable_data.tasks.checking import ConditionPredicates, GoalChecker
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal
from stable_data.tasks.planning import StepPlanner, kind_of
from stable_data.tasks.sentences import GoalSentences, ObjectResolver, not_checkable
from stable_data.tasks.unseen_actions import unseen_action


def compile_goal(geometry: TaskGeometry) -> Goal:
    """Compiles the goal of a scene's task.

    Args:
        geometry: The scene at the start of the task, with the supports of its objects, and its geometry.

    Raises:
        GoalError: ``no_task``; ``no_goal``: the task info states none; ``goal_not_checkable``: no state of the scene shows whether the
            goal is reached, or a container holds nothing; ``goal_unresolved``: an instance is missing or ambiguous;
            ``goal_true_at_start``.
    """
    scene = geometry.scene
    if scene.task is None:
        raise GoalError(f"{scene.scene_id}: no task, expected one with a goal; derive a task first", "no_task")
    try:
        conditions = scene.task.conditions or stated_conditions(scene, geometry.containers)
        return goal_from_conditions(conditions, geometry)
    except GoalError as error:
        where = "" if str(error).startswith(scene.scene_id) else f"{scene.scene_id}: "
        raise GoalError(f"{where}{error}", error.code) from error


def holds_at_start(geometry: TaskGeometry) -> bool:
    """Returns whether the goal of a scene's task holds already, so that there is nothing to do; False if it cannot be checked."""
    try:
        compile_goal(geometry)
    except GoalError as error:
        return error.code == "goal_true_at_start"
    return False


def stated_conditions(scene: Scene, containers: Mapping[str, bool | None]) -> tuple[GoalCondition, ...]:
    """Reads the conditions that the goal sentences and actions of a scene's task info state.

    Args:
        scene: The scene with its task; the supports of its objects are known.
        containers: Whether objects can be put into an object; None or missing if it is not known.

    Raises:
        GoalError: ``no_task``, ``no_goal``, ``goal_not_checkable`` or ``goal_unresolved``.
    """
    task = scene.task
    if task is None or not (task.goal or task.action_sequence):
        if task is not None and (words := unseen_action(task.task)) is not None:
            raise not_checkable(words, "no state of the objects shows that it is done")
        raise GoalError(
            f"{scene.scene_id}: the task info states no goal, expected conditions, goal sentences or actions; an instruction that is not "
            "understood as a whole has none",
            "no_goal" if task is not None else "no_task",
        )
    graph = scene_graph(scene, contacts_of(scene), containers=containers)
    known = task if task.task_objects else resolve_task_objects(task, scene, graph)[0]
    resolver = ObjectResolver(scene, graph, known.task_objects)
    return GoalSentences(task, resolver, lambda name: containers.get(name) is True).conditions()


def goal_from_conditions(conditions: Sequence[GoalCondition], geometry: TaskGeometry) -> Goal:
    """Makes a goal of conditions: plans its steps, finds its kind, and checks that it can be reached and is not reached yet.

    Raises:
        GoalError: ``goal_not_checkable``, ``goal_unresolved`` or ``goal_true_at_start``.
    """
    scene, held = geometry.scene, _held(conditions)
    # What the hand holds is in and on nothing else.
    conditions = [c for c in conditions if not (c.is_negated and c.kind in _SUPPORTED and c.subject in held)]
    if not conditions:
        raise not_checkable("the goal", "it states no condition")
    predicates = ConditionPredicates(geometry)
    supports = {o.instance: o.support for o in scene.objects}
    categories = {o.instance: o.category for o in scene.objects}
    checker = GoalChecker(Goal(kind_of(conditions, categories), tuple(conditions), ()), geometry)
    _refuse_unreachable(conditions, geometry)
    if checker.is_success(predicates.start):
        words = "; ".join(map(str, conditions))
        raise GoalError(
            f"{scene.scene_id}: the goal {words!r} holds at the start, expected a task to do; leave the task out",
            "goal_true_at_start",
        )
    planner = StepPlanner(supports, predicates)
    return Goal(checker.goal.kind, tuple(conditions), planner.plan(conditions))


_SUPPORTED = (ConditionKind.IN, ConditionKind.ON)


def _held(conditions: Sequence[GoalCondition]) -> set[str]:
    """What is held at the end."""
    return {c.subject for c in conditions if c.kind is ConditionKind.HELD and not c.is_negated}


def _refuse_unreachable(conditions: Sequence[GoalCondition], geometry: TaskGeometry) -> None:
    """Refuses goals that no state fulfils, or that move what is fixed."""
    held = _held(conditions)
    if len(held) > 1:
        raise not_checkable(f"{' and '.join(sorted(held))} held", "one hand holds one object")
    for c in conditions:
        if c.kind is not ConditionKind.HELD and not c.is_negated and held.intersection(c.subjects):
            raise not_checkable(str(c), f"{', '.join(held)} is held at the end")
        if c.kind is ConditionKind.IN and not c.is_negated and geometry.containers.get(c.target) is False:
            raise not_checkable(str(c), f"{c.target} is no container, so nothing counts as in it")
        if c.kind is not ConditionKind.EMPTY and geometry.scene.fixed.intersection(c.subjects):
            raise not_checkable(str(c), f"{c.subject} is fixed")
