"""Compares the relations that an instruction states about the initial scene with a layout."""

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
    """Finds the task objects and the stated relations of an instruction in a layout.

    Args:
        layout: The objects.
        table: The table.
        instruction: The instruction; characters beyond ``MAX_INSTRUCTION`` are not used.
        statistics: Statistics of the categories.

    Returns:
        The task info with its task objects and stated relations, a scene of the objects that its nouns can mean, and the scene
        graph of this scene, computed from boxes.
    """
    instruction = instruction[:MAX_INSTRUCTION]
    phrases = find_noun_phrases(words_of(instruction), statistics.nouns)
    meant = {c for p in phrases for c in statistics.nouns.categories_of(p.mention.noun)}
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
    """Returns the relations that an instruction states about the initial scene and that do not hold in a layout.

    If several objects match a noun, the relation must hold for as many of them as the phrase mentions. An object in another
    satisfies ``on``. An object to be emptied must support at least one object. A relation whose objects are missing in the
    layout is not reported.

    Args:
        layout: The objects.
        table: The table.
        instruction: The instruction.
        statistics: Statistics of the categories.
        on_in: The relations ``on`` and ``in`` of the layout; None computes them from boxes, as AwS does for a raw layout.
    """
    instruction = instruction[:MAX_INSTRUCTION]
    words = words_of(instruction)
    phrases = list(find_noun_phrases(words, statistics.nouns))
    text = number_phrases(instruction, words, phrases)
    # "Some soap from the dispenser" mentions no object of the scene; "some pens from the cup" does.
    parts = {k for k, p in enumerate(phrases) if words[p.first].text == "some" and not p.mention.is_plural}
    claims, empties = [claim for claim in read_claims(text) if claim.a not in parts], emptied_numbers(text)
    corners = {k: cell for k, p in enumerate(phrases) if (cell := _corner(p.clause)) is not None}
    if not (claims or empties or corners):
        return ()  # most instructions state nothing about the initial scene
    kinds = [set(statistics.nouns.categories_of(p.mention.noun)) for p in phrases]
    alike = [[o for o in layout if o.category in kind] for kind in kinds]
    if on_in is None:
        carrying = set(carriers_of(layout, table).values())
        graph = scene_graph(Scene("layout", table, tuple(layout)), {})
        on_in = {Relation(one, kind, other) for one, other, kind in graph.edges(keys=True) if kind in _CARRYING}
    else:
        carrying = {r.target for r in on_in}

    def holds(kind: RelationKind, one: SceneObject, other: SceneObject) -> bool:
        if kind in _CARRYING:
            return is_held(on_in, Relation(one.instance, kind, other.instance))
        dx, dy, _ = np.subtract(one.position, other.position)
        return direction_of(dx, dy) is kind

    not_held = []
    for claim in claims:
        kind = claim.kind or RelationKind.ON
        pairs = [(one, other) for one in alike[claim.a] for other in alike[claim.b] if one is not other]
        satisfied = {one.instance for one, other in pairs if holds(kind, one, other)}
        wrong = [pair for pair in pairs if pair[0].instance not in satisfied]
        if wrong and len(satisfied) < min(phrases[claim.a].count, len({one.instance for one, _ in pairs})):
            not_held.append(Relation(wrong[0][0].instance, kind, wrong[0][1].instance))
    not_held += [
        Relation(alike[k][0].instance, RelationKind.IS_AT, cell)
        for k, cell in corners.items()
        if alike[k] and not any(cell_of(o.position, table.size_xy) == cell for o in alike[k])
    ]
    not_held += [
        Relation("something", RelationKind.ON, alike[k][0].instance)
        for k in empties
        if alike[k] and not any(o.instance in carrying for o in alike[k])
    ]
    return tuple(not_held)


def _corner(clause: Sequence[str]) -> str | None:
    """The cell of the table that a clause such as ``that is in the back left corner`` means, or None."""
    row, column = (next((word for word in clause if word in names), None) for names in (("front", "back"), ("left", "right")))
    return f"{row}_{column}" if "corner" in clause and row and column else None


def reword_for_layout(layout: Sequence[SceneObject], instruction: str, statistics: CategoryStatistics) -> str:
    """Replaces each noun that can mean only one category of a layout by the words of this category."""
    present = {o.category for o in layout}
    words = words_of(instruction)
    text = instruction
    for phrase in reversed(list(find_noun_phrases(words, statistics.nouns))):
        mention = phrase.mention
        meant = present & set(statistics.nouns.categories_of(mention.noun))
        if len(meant) != 1 or statistics.is_doubtful(phrase):
            continue
        noun = own_noun(meant.pop())
        if noun != mention.noun:
            noun = plural(noun) if mention.is_plural else noun
            text = f"{text[: words[mention.first].start]}{noun}{text[words[mention.last].end :]}"
    return text
