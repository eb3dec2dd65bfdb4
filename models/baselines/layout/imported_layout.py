"""A layout that another system has made for a task, as a coroutine like Algorithm 1: nothing is proposed and nothing retrieved."""

from collections.abc import Sequence
from dataclasses import replace

from models.dual_system.algorithm1 import LoopSettings, closed, proposed_supports
from models.dual_system.generation_state import GenerationState
from models.dual_system.requests import Loop
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.replies.to_scene import attach_task_info, staged_by_instruction
from models.semantic_reasoner.staged_layout import LayoutTask
from stable_data.errors import Notice
from stable_data.scene import Scene

_SAME = 0.01  # largest difference of the sides of two tables that count as the same, metres


def imported_layout(
    task: LayoutTask,
    found: Scene | Notice,
    settings: LoopSettings,
    interpret: InstructionInterpreter | None = None,
    remarks: Sequence[Notice] = (),
) -> Loop:
    """Makes a scene of a layout.

    Args:
        task: The task.
        found: The layout, or why there is none.
        settings: Whether the layout is corrected.
        interpret: Interprets the instruction, or None: the task info then has no relations.
        remarks: What the reader of the layout remarked.

    Yields:
        The requests of the correction.

    Returns:
        The scene with the objects of the layout, and with the table, the surroundings and the task info of the task. A layout for
        a table of another size keeps its own table and surroundings, with a warning.
    """
    state = GenerationState(task)
    if isinstance(found, Notice):
        return state.failure(found.code, found.message.removeprefix(f"{task.scene_id}: "))
    if not found.movable:
        return state.failure("layout_empty", "the layout has no object, expected at least one")
    for remark in remarks:
        state.warn(remark.code, remark.message.removeprefix(f"{remark.item_id}: "))
    place = task.empty_scene
    if max(abs(a - b) for a, b in zip(found.table.size_xy, task.table.size_xy, strict=True)) > _SAME:
        theirs, ours = (" x ".join(f"{100 * s:.1f}" for s in size) for size in (found.table.size_xy, task.table.size_xy))
        state.warn(
            "table_differs",
            f"the table of the layout is {theirs} cm, that of the task {ours} cm; the former is used, with what is fixed around it",
        )
        table = replace(found.table, table_type=task.table.table_type)
        fixed = tuple(replace(o, source=None) for o in found.surroundings)
        place = Scene(task.scene_id, table, fixed, fixed=found.fixed, frame=found.frame)
    plain = [replace(o, source=None) for o in found.movable]  # it is no scene of their file any more
    staged = staged_by_instruction(plain, place.table, task.instruction, interpret)
    scene = replace(place, objects=(*place.objects, *staged))
    state.supports = proposed_supports(replace(scene, objects=staged, fixed=frozenset()), {o.instance for o in staged})
    scene = attach_task_info(scene, task.instruction, staged, interpret, task.reference, task.conditions)
    state.scene = state.start = scene
    return (yield from closed(state, settings))
