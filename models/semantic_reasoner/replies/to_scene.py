"""Converts a reply that passed the checks to scene objects, ready for retrieval."""

from collections.abc import Sequence
from dataclasses import replace

from models.instruction_reader.goals import conditions_of_reading
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import (
    InstructionInterpreter,
    compare_with_instruction,
    relations_of_task,
)
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutReply
from stable_data.condition import GoalCondition
from stable_data.metrics.alignment import AlignmentReference, align, members
from stable_data.scene import TABLE, Relation, Scene, SceneObject, Stage, Tabletop, TaskInfo
from stable_data.scene_graph.relations import contacts_of
from stable_data.scene_graph.staging import stage_scene
from stable_data.scene_graph.support_from_boxes import carriers_of
from stable_data.tasks.goal import rename_conditions
from stable_data.tasks.regions import REGIONS


def objects_of_reply(
    reply: LayoutReply, question: ReasonerQuestion, interpret: InstructionInterpreter | None = None
) -> tuple[SceneObject, ...]:
    """Returns the objects of a reply in SI units, each with its stage and its support.

    Args:
        reply: The reply; without hard faults.
        question: The question.
        interpret: Interprets the instruction; only a whole layout needs it.

    Returns:
        The objects in the order of the reply, without assets. The stage is that of the question. A whole layout is staged by
        its instruction; all of it is O^t if the instruction has no known meaning. Objects of an edit have no stage: a changed
        object keeps its stage of the scene. The support is None if nothing is close below.
    """
    stage = question.wanted if isinstance(question.wanted, Stage) else None
    new = [o.to_scene_object(stage) for o in reply.objects]
    gone = {*reply.removed, *(o.instance for o in new)} if question.edits else set()
    layout = [*(o.to_scene_object() for o in question.layout if o.instance not in gone), *new]
    carriers = carriers_of(layout, question.table)
    objects = tuple(replace(o, support=carriers[o.instance]) for o in new)
    if question.wanted != "whole":
        return objects
    return staged_by_instruction(objects, question.table, question.instruction, interpret)


def attach_task_info(
    scene: Scene,
    instruction: str,
    proposed: Sequence[SceneObject],
    interpret: InstructionInterpreter | None = None,
    reference: AlignmentReference | None = None,
    labels: Sequence[GoalCondition] = (),
) -> Scene:
    """Returns a scene with its task info: the instruction, the objects of O^t, their stated relations at the start, and its goal.

    Args:
        scene: The scene, staged.
        instruction: The task instruction.
        proposed: The objects as they were proposed; the relations are inferred from their supports and boxes.
        interpret: Interprets the instruction; None gives no relations and no conditions.
        reference: What the scene must have by labels that no reader made; None without labels.
        labels: What holds when the task is done, in the names of ``reference``. They have priority over the reading.
    """
    task_objects = tuple(o.instance for o in scene.objects if o.stage is Stage.TASK)
    relations: tuple[Relation, ...] = ()
    conditions: tuple[GoalCondition, ...] = ()
    if interpret is not None:
        meant = interpret(instruction)
        found, _ = compare_with_instruction(proposed, scene.table, meant)
        if found is not None:
            relations = tuple(r for r in relations_of_task(found) if set(members(r)) <= set(task_objects))
            there = {o.instance for o in scene.objects}
            # The requirements have a number for each mentioned object, and other names for what it contains.
            names = {int(number): name for number, name in found.matches if number.isdigit() and name in there}
            conditions = conditions_of_reading(meant.reading, instruction, names)
    if reference is not None and labels:
        layout = Scene("layout", scene.table, tuple(proposed))
        labelled = align(layout, reference, contacts=contacts_of(layout))
        counterparts = {one: other for one, other in labelled.matches if other in {o.instance for o in scene.objects}}
        known = {name for c in labels for name in (*c.subjects, *c.targets)} - {TABLE} - REGIONS
        sizes = {o.instance: o.size for o in scene.objects}
        conditions = rename_conditions(labels, counterparts, known, sizes) or conditions
    task = TaskInfo("", instruction, task_objects=task_objects, relations=relations, conditions=conditions)
    return replace(scene, task=task)


def staged_by_instruction(
    objects: Sequence[SceneObject], table: Tabletop, instruction: str, interpret: InstructionInterpreter | None
) -> tuple[SceneObject, ...]:
    """Returns the objects of a whole layout with their stages.

    Args:
        objects: The objects, with supports.
        table: The table.
        instruction: The instruction; if it has no known meaning, all objects are O^t.
        interpret: Interprets the instruction; None: one that knows the nouns of the objects alone.
    """
    if interpret is None:
        interpret = InstructionInterpreter(CategoryStatistics.of_names(o.category for o in objects))
    found, _ = compare_with_instruction(objects, table, interpret(instruction))
    task_objects = () if found is None else tuple(name for _, name in found.matches)
    if not task_objects:
        return tuple(replace(o, stage=Stage.TASK) for o in objects)
    task = TaskInfo("", instruction, task_objects=task_objects)
    stages = {o.instance: o.stage for o in stage_scene(Scene("layout", table, tuple(objects), task=task)).objects}
    return tuple(replace(o, stage=stages[o.instance]) for o in objects)
