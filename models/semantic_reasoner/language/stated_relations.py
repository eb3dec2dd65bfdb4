"""What an instruction says of the start, held against a layout: the reader of task infos, its words made those of the layout."""

from collections.abc import Sequence, Set

import numpy as np

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.noun_lookup import own_noun, words_of
from models.semantic_reasoner.language.noun_phrases import find_noun_phrases, number_phrases
from stable_data.instructions.claims import emptied_numbers, read_claims
from stable_data.instructions.task_info import resolve_task_objects
from stable_data.instructions.wording.words import plural
from stable_data.scene import MAX_INSTRUCTION, Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.scene_graph.relations import SceneGraph, cell_of, direction_of, is_held, scene_graph
from stable_data.scene_graph.support_from_boxes import carriers_of

_CARRYING = (RelationKind.IN, RelationKind.ON)


def interpret_layout(
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
    spoken = list(find_noun_phrases(words_of(instruction), statistics.nouns))
    meant = {c for p in spoken for c in statistics.nouns.categories_of(p.mention.noun)}
    scene = Scene("layout", table, tuple(o for o in layout if o.category in meant))
    graph = scene_graph(scene, {})
    task, _ = resolve_task_objects(TaskInfo("", reword_for_layout(layout, instruction, statistics)), scene, graph)
    return task, scene, graph


def relations_not_held(
    layout: Sequence[SceneObject],
    table: Tabletop,
    instruction: str,
    statistics: CategoryStatistics,
    on_in: Set[Relation] | None = None,
) -> tuple[Relation, ...]:
    """What an instruction says of the start that is true of no such objects of a layout.

    Of several alike any will do, as many as are spoken of. What shall be on a thing may be in it. What shall be emptied has
    something in or on it, whatever it is. Of what is not there at all nothing is said.

    Args:
        layout: The objects.
        table: The table.
        instruction: The instruction.
        statistics: What is known of categories.
        on_in: What is on and in what, where that is known; None: by boxes, as AwS judges a raw layout.
    """
    instruction = instruction[:MAX_INSTRUCTION]
    words = words_of(instruction)
    spoken = list(find_noun_phrases(words, statistics.nouns))
    text = number_phrases(instruction, words, spoken)
    # "Some soap from the dispenser" is no soap that is there; "some pens from the cup" are.
    parts = {k for k, p in enumerate(spoken) if words[p.first].text == "some" and not p.mention.is_plural}
    claims, empties = [claim for claim in read_claims(text) if claim.a not in parts], emptied_numbers(text)
    corners = {k: cell for k, p in enumerate(spoken) if (cell := _corner(p.clause)) is not None}
    if not (claims or empties or corners):
        return ()  # most instructions say nothing of the start
    kinds = [set(statistics.nouns.categories_of(p.mention.noun)) for p in spoken]
    alike = [[o for o in layout if o.category in kind] for kind in kinds]
    if on_in is None:
        carrying = set(carriers_of(layout, table).values())
        graph = scene_graph(Scene("layout", table, tuple(layout)), {})
        on_in = {Relation(one, kind, other) for one, other, kind in graph.edges(keys=True) if kind in _CARRYING}
    else:
        carrying = {r.target for r in on_in}

    def are_so(kind: RelationKind, one: SceneObject, other: SceneObject) -> bool:
        if kind in _CARRYING:
            return is_held(on_in, Relation(one.instance, kind, other.instance))
        dx, dy, _ = np.subtract(one.position, other.position)
        return direction_of(dx, dy) is kind

    broken = []
    for claim in claims:
        kind = claim.kind or RelationKind.ON
        pairs = [(one, other) for one in alike[claim.a] for other in alike[claim.b] if one is not other]
        so = {one.instance for one, other in pairs if are_so(kind, one, other)}
        wrong = [pair for pair in pairs if pair[0].instance not in so]
        if wrong and len(so) < min(spoken[claim.a].count, len({one.instance for one, _ in pairs})):
            broken.append(Relation(wrong[0][0].instance, kind, wrong[0][1].instance))
    broken += [
        Relation(alike[k][0].instance, RelationKind.IS_AT, cell)
        for k, cell in corners.items()
        if alike[k] and not any(cell_of(o.position, table.size_xy) == cell for o in alike[k])
    ]
    broken += [
        Relation("something", RelationKind.ON, alike[k][0].instance)
        for k in empties
        if alike[k] and not any(o.instance in carrying for o in alike[k])
    ]
    return tuple(broken)


def _corner(clause: Sequence[str]) -> str | None:
    """The ninth of the table that a clause such as ``that is in the back left corner`` means."""
    row, column = (next((word for word in clause if word in names), None) for names in (("front", "back"), ("left", "right")))
    return f"{row}_{column}" if "corner" in clause and row and column else None


def reword_for_layout(layout: Sequence[SceneObject], instruction: str, statistics: CategoryStatistics) -> str:
    """The instruction with a layout's own nouns, where a noun can mean only one of its categories."""
    there = {o.category for o in layout}
    words = words_of(instruction)
    text = instruction
    for phrase in reversed(list(find_noun_phrases(words, statistics.nouns))):
        mention = phrase.mention
        meant = there & set(statistics.nouns.categories_of(mention.noun))
        if len(meant) != 1 or statistics.is_doubtful(phrase):
            continue
        noun = own_noun(meant.pop())
        if noun != mention.noun:
            said = plural(noun) if mention.is_plural else noun
            text = f"{text[: words[mention.first].start]}{said}{text[words[mention.last].end :]}"
    return text
