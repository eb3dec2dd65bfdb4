"""A layout that another system has made for a task, as a coroutine like Algorithm 1: nothing is proposed and nothing retrieved."""

from dataclasses import replace

from models.dual_system.algorithm1 import LoopSettings, closed
from models.dual_system.generation_state import GenerationState
from models.dual_system.requests import Loop
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.replies.to_scene import attach_task_info, staged_by_instruction
from models.semantic_reasoner.staged_layout import LayoutTask
from stable_data.errors import Notice
from stable_data.scene import Scene

_SAME = 0.01  # largest difference of the sides of two tables that count as the same, metres


def imported_layout(
    task: LayoutTask, found: Scene | Notice, settings: LoopSettings, interpret: InstructionInterpreter | None = None
) -> Loop:
    """Makes a scene of a layout.

    Args:
        task: The task.
        found: The layout, or why there is none.
        settings: Whether the layout is corrected.
        interpret: Interprets the instruction, or None: the task info then has no relations.

    Yields:
        The requests of the correction.

    Returns:
        The scene with the objects, the table and the surroundings of the layout, and the task info of the task.
    """
    state = GenerationState(task)
    if isinstance(found, Notice):
        return state.failure(found.code, found.message.removeprefix(f"{task.scene_id}: "))
    if not found.movable:
        return state.failure("layout_empty", "the layout has no object, expected at least one")
    table = replace(found.table, table_type=task.table.table_type)
    if max(abs(a - b) for a, b in zip(table.size_xy, task.table.size_xy, strict=True)) > _SAME:
        theirs, ours = (" x ".join(f"{100 * s:.1f}" for s in size) for size in (table.size_xy, task.table.size_xy))
        state.warn("table_differs", f"the table of the layout is {theirs} cm, that of the task {ours} cm; the former is used")
    plain = replace(
        found, objects=tuple(replace(o, source=None) for o in found.objects)
    )  # it is no scene of their file any more
    staged = staged_by_instruction(plain.movable, table, task.instruction, interpret)
    objects = (*plain.surroundings, *staged)
    scene = Scene(task.scene_id, table, objects, fixed=found.fixed, frame=found.frame)
    scene = attach_task_info(scene, task.instruction, staged, interpret, task.reference, task.conditions)
    state.scene = state.start = scene
    return (yield from closed(state, settings))
