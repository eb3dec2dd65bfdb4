"""What an instruction says of the start, held against a layout: the reader of task infos, its words made those of the layout."""

from collections.abc import Iterator, Sequence

from models.semantic_reasoner.carrying import carriers_of
from models.semantic_reasoner.categories import CategoryStatistics
from models.semantic_reasoner.nouns import own_noun, words_of
from models.semantic_reasoner.phrases import marked, phrases
from models.semantic_reasoner.prompt import MAX_INSTRUCTION
from stable_data.instructions.claims import emptied, read_claims
from stable_data.instructions.situation import SIDES
from stable_data.instructions.words import plural
from stable_data.relations import SceneGraph, scene_graph
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.tasks import resolve_task_objects

_CARRYING = (RelationKind.IN, RelationKind.ON)


def understood(
    layout: Sequence[SceneObject], table: Tabletop, instruction: str, statistics: CategoryStatistics
) -> tuple[TaskInfo, Scene, SceneGraph]:
    """A layout with what an instruction means in it.

    Args:
        layout: The objects.
        table: The table.
        instruction: The instruction; of one that is too long to be asked, the beginning.
        statistics: What is known of categories.

    Returns:
        The task info with its task objects and what it says of the start, the objects that its nouns could mean as a scene, and
        their scene graph by boxes.
    """
    instruction = instruction[:MAX_INSTRUCTION]
    spoken = list(phrases(words_of(instruction), statistics.nouns))
    meant = {c for p in spoken for c in statistics.nouns.categories_of(p.mention.noun)}
    scene = Scene("layout", table, tuple(o for o in layout if o.category in meant))
    graph = scene_graph(scene, {})
    task, _ = resolve_task_objects(TaskInfo("", in_words_of(layout, instruction, statistics)), scene, graph)
    return task, scene, graph


def relations_not_held(
    layout: Sequence[SceneObject], table: Tabletop, instruction: str, statistics: CategoryStatistics
) -> tuple[Relation, ...]:
    """What an instruction says of the start that is true of no such objects of a layout.

    Of several alike any will do, and in and on are not told apart: without meshes nobody knows what is hollow. What shall be
    emptied has something in or on it, whatever it is.

    Args:
        layout: The objects.
        table: The table.
        instruction: The instruction.
        statistics: What is known of categories.
    """
    instruction = instruction[:MAX_INSTRUCTION]
    words = words_of(instruction)
    spoken = list(phrases(words, statistics.nouns))
    text = marked(instruction, words, spoken)
    nouns = [spoken[k].mention.noun for k in emptied(text)]
    empty = tuple(_left_empty(layout, table, [statistics.nouns.categories_of(noun) for noun in nouns])) if nouns else ()
    # Most instructions say nothing of the start, and this is quickly told.
    if not ("corner" in instruction or any(p.has_clause for p in spoken) or read_claims(text)):
        return empty
    task, scene, graph = understood(layout, table, instruction, statistics)
    return (*(r for r in task.relations if not any(_holds(scene, graph, one) for one in _alike(scene, r))), *empty)


def _left_empty(layout: Sequence[SceneObject], table: Tabletop, meant: Sequence[Sequence[str]]) -> Iterator[Relation]:
    """What shall be emptied and is, by the categories that each may have."""
    carriers = set(carriers_of(layout, table).values())
    for categories in meant:
        ones = [o.instance for o in layout if o.category in categories]
        if ones and not carriers & set(ones):
            yield Relation("something", RelationKind.ON, ones[0])


def _alike(scene: Scene, relation: Relation) -> Iterator[Relation]:
    """The relation, of all objects of the same categories."""
    ones, others = (
        [o.instance for o in scene.objects if o.category == scene[name].category]
        for name in (relation.subject, relation.subject if relation.kind is RelationKind.IS_AT else relation.target)
    )
    if relation.kind is RelationKind.IS_AT:
        yield from (Relation(one, relation.kind, relation.target) for one in ones)
    else:
        yield from (Relation(a, relation.kind, b) for a in ones for b in others if a != b)


def _holds(scene: Scene, graph: SceneGraph, relation: Relation) -> bool:
    a, kind, b = relation.subject, relation.kind, relation.target
    if kind is RelationKind.IS_AT:
        return bool(graph.nodes[a]["cell"] == b)
    if kind in SIDES:
        axis, sign = SIDES[kind]
        return sign * (scene[a].position[axis] - scene[b].position[axis]) > 0
    return any(graph.has_edge(a, b, key=k) for k in _CARRYING)


def in_words_of(layout: Sequence[SceneObject], instruction: str, statistics: CategoryStatistics) -> str:
    """The instruction with a layout's own nouns, where a noun can mean only one of its categories."""
    there = {o.category for o in layout}
    words = words_of(instruction)
    text = instruction
    for phrase in reversed(list(phrases(words, statistics.nouns))):
        mention = phrase.mention
        meant = there & set(statistics.nouns.categories_of(mention.noun))
        if len(meant) != 1 or statistics.is_doubtful(phrase):
            continue
        noun = own_noun(meant.pop())
        if noun != mention.noun:
            said = plural(noun) if mention.is_plural else noun
            text = f"{text[: words[mention.first].start]}{said}{text[words[mention.last].end :]}"
    return text
