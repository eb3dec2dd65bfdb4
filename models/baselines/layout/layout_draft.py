"""A draft from a layout of this project's reasoner, for models that know no other prompts than its own.

A small model that was trained on the prompts of this project cannot answer those of other systems. Their searches are exercised
nevertheless: the objects are those of its whole layout, and the relations those of the scene graph of that layout, after the ones that
the instruction states.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from models.baselines.layout.relation_checks import CheckedRelations, check_relations
from models.baselines.placement.problem import CARRYING, DIRECTIONS, Constraint, PlacementRelation
from models.semantic_reasoner.language.interpreter import (
    InstructionInterpreter,
    compare_with_instruction,
    relations_of_task,
)
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import relations_of, scene_graph

_KINDS: Mapping[RelationKind, PlacementRelation] = {
    RelationKind(str(kind)): kind for kind in PlacementRelation if str(kind) in set(map(str, RelationKind))
}
_FRONT = "front"
_BASE = 1.25  # most that an object may be wider than what carries it


def relations_of_layout(
    objects: Sequence[LayoutObject],
    instruction: str,
    table: Tabletop,
    interpret: InstructionInterpreter | None = None,
    holds: Callable[[str], bool | None] = lambda _: None,
) -> CheckedRelations:
    """Returns the relations of a layout that a search can use.

    Args:
        objects: The layout.
        instruction: The instruction.
        table: The table.
        interpret: Interprets the instruction; None: only the layout has relations.
        holds: Whether things of a category can contain others; None if it is not known.

    Returns:
        What the instruction states; what carries each object; one direction of each object on the table, to the nearest one of those
        before it; and where an object faces, if not the viewer. Faults are those of what the instruction states alone.
    """
    placed = [o.to_scene_object() for o in objects]
    stated: list[Constraint] = []
    if interpret is not None:
        found, _ = compare_with_instruction(placed, table, interpret(instruction))
        stated = list(_constraints(() if found is None else relations_of_task(found)))
    own = list(_of_graph(placed, table, {o.instance: holds(o.category) for o in placed}))
    checked = check_relations([*stated, *own], objects)
    told = [fault for fault in checked.faults if any(fault.message.startswith(f"{c}: ") for c in stated)]
    return replace(checked, faults=tuple(told))


def _constraints(relations: Sequence[Relation]) -> Iterator[Constraint]:
    return (Constraint(r.subject, _KINDS[r.kind], r.target) for r in relations if r.kind in _KINDS and r.target != TABLE)


def _of_graph(placed: Sequence[SceneObject], table: Tabletop, containers: Mapping[str, bool | None]) -> Iterator[Constraint]:
    scene = Scene("layout", table, tuple(placed))
    every = list(_constraints(relations_of(scene_graph(scene, {}, containers=containers))))
    carrying = [c for c in every if c.kind in CARRYING and _is_base(scene[c.target], scene[c.subject])]
    yield from carrying
    order = {o.instance: k for k, o in enumerate(placed)}
    carried = {c.subject for c in carrying}
    nearest: dict[str, tuple[float, Constraint]] = {}
    for c in every:
        if c.kind not in DIRECTIONS or not carried.isdisjoint(c.members):
            continue
        later = max(c.members, key=order.__getitem__)
        gap = _distance(scene, c)
        if later not in nearest or gap < nearest[later][0]:
            nearest[later] = gap, c
    yield from (c for _, c in nearest.values())
    yield from (c for c in every if c.kind is PlacementRelation.FACE_TO and c.target != _FRONT)


def _is_base(carrier: SceneObject, o: SceneObject) -> bool:
    """Whether an object is wide enough to carry another one: in a layout that nobody corrected, boxes also stand in each other."""
    return all(_BASE * a >= b for a, b in zip(sorted(carrier.size[:2]), sorted(o.size[:2]), strict=True))


def _distance(scene: Scene, c: Constraint) -> float:
    one, other = (scene[name].position for name in c.members)
    return float(((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2) ** 0.5)
