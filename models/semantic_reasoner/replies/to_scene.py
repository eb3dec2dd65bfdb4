"""A reply that passed the checks becomes objects of the scene, ready for retrieval."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.stated_relations import interpret_layout
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutReply
from stable_data.metrics.alignment import members
from stable_data.scene import Relation, Scene, SceneObject, Stage, TaskInfo
from stable_data.scene_graph.staging import stage_scene
from stable_data.scene_graph.support_from_boxes import carriers_of


def objects_of_reply(
    reply: LayoutReply, ask: ReasonerQuestion, statistics: CategoryStatistics | None = None
) -> tuple[SceneObject, ...]:
    """The objects of a reply in SI units, each with its stage and what carries it.

    Args:
        reply: The reply; without hard faults.
        ask: What it answers.
        statistics: What is known of categories, to read the instruction by; only the whole layout asks for it.

    Returns:
        In the order of the reply, without assets. The stage is the one that was asked for. A whole layout is staged by what its
        instruction means, or is all task objects where it means nothing known. An edit's objects have no stage: what is changed
        keeps the one that it has in the scene. The support is None where nothing is near below.
    """
    stage = ask.wanted if isinstance(ask.wanted, Stage) else None
    new = [o.to_scene_object(stage) for o in reply.objects]
    gone = {*reply.removed, *(o.instance for o in new)} if ask.edits else set()
    layout = [*(o.to_scene_object() for o in ask.layout if o.instance not in gone), *new]
    carriers = carriers_of(layout, ask.table)
    objects = tuple(replace(o, support=carriers[o.instance]) for o in new)
    if ask.wanted != "whole":
        return objects
    stages = _stages(objects, ask, statistics)
    return tuple(replace(o, stage=stages[o.instance]) for o in objects)


def attach_task_info(
    scene: Scene, instruction: str, proposed: Sequence[SceneObject], statistics: CategoryStatistics | None = None
) -> Scene:
    """A scene with its task info: the instruction, the objects of O^t, and what the instruction says of them at the start.

    Args:
        scene: The scene, staged.
        instruction: What is to be done there.
        proposed: The objects as they were proposed, whose boxes the relations are read from.
        statistics: What is known of categories, to read the instruction by; None: nothing, and there are no relations.
    """
    named = tuple(o.instance for o in scene.objects if o.stage is Stage.TASK)
    relations: tuple[Relation, ...] = ()
    if statistics is not None:
        task, _, _ = interpret_layout(proposed, scene.table, instruction, statistics)
        relations = tuple(r for r in task.relations if set(members(r)) <= set(named))
    return replace(scene, task=TaskInfo("", instruction, task_objects=named, relations=relations))


def _stages(
    objects: tuple[SceneObject, ...], ask: ReasonerQuestion, statistics: CategoryStatistics | None
) -> Mapping[str, Stage | None]:
    """The stages of a whole layout."""
    if statistics is None:
        statistics = CategoryStatistics.of_names(o.category for o in objects)
    task, _, _ = interpret_layout(objects, ask.table, ask.instruction, statistics)
    if not task.task_objects:
        return dict.fromkeys((o.instance for o in objects), Stage.TASK)
    scene = Scene("layout", ask.table, objects, task=task)
    return {o.instance: o.stage for o in stage_scene(scene).objects}
