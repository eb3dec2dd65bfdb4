"""Judges each object of a reply as soon as it is written: a refused one gets another place, and the rest of the reply is kept.

The checks of whole replies stay the rule of what may enter a scene. This check finds early what they would find, and boxes that
reach deep into each other, which only cost the correction time and moves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.replies.checks import CheckSettings, overlap_depth, place_faults, same_place_faults
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, renumber_instances
from stable_data.metrics.alignment import AlignmentReference, align, members
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle
from stable_data.scene_graph.support_from_boxes import ON_TABLE, carriers_of
from stable_data.scene_graph.support_tree import ancestors


@dataclass(frozen=True, slots=True)
class ObjectCheck:
    """Judges the last of the objects that a reply has so far.

    Attributes:
        table: The table.
        layout: The layout so far.
        reference: What the instruction requires; None if relations are not judged, as after the first stage.
        settings: How strict the checks are.
    """

    table: Tabletop
    layout: tuple[LayoutObject, ...]
    reference: AlignmentReference | None
    settings: CheckSettings

    @classmethod
    def of_question(
        cls, question: ReasonerQuestion, interpret: InstructionInterpreter, settings: CheckSettings
    ) -> "ObjectCheck":
        """Returns the check for the replies to a question."""
        reference = interpret(question.instruction).reference if question.asks_for_task else None
        return cls(question.table, question.layout, reference if reference and reference.entailed else None, settings)

    def __call__(self, objects: Sequence[LayoutObject], /) -> bool:
        """Returns whether the place of the last object is refused.

        It is refused if it is off the table or in the restricted zone, where another object is, in the air, deep in an object
        that does not carry it, or breaks a relation that the instruction states between it and earlier objects.
        """
        named = renumber_instances(objects, [o.instance for o in self.layout])
        layout = [o.to_scene_object() for o in (*self.layout, *named)]
        last = layout[-1]
        return (
            any(True for _ in place_faults(last, self.table, self.settings))
            or any(True for _ in same_place_faults([last], layout, frozenset(), self.settings))
            or self._floats_or_collides(last, layout)
            or self._breaks_relation(last, layout)
        )

    def _floats_or_collides(self, last: SceneObject, layout: Sequence[SceneObject]) -> bool:
        near = [o for o in layout[:-1] if _may_touch(o, last)]  # others neither carry it nor collide with it
        if not near:
            return last.bottom > ON_TABLE
        carriers = carriers_of([*near, last], self.table)
        if carriers[last.instance] is None:
            return True
        deepest, outline = self.settings.deepest_cm / 100, yawed_rectangle(last)
        return any(
            min(last.top - o.bottom, o.top - last.bottom) > deepest
            and o.instance not in ancestors(carriers, last.instance)
            and last.instance not in ancestors(carriers, o.instance)
            and overlap_depth(outline, yawed_rectangle(o)) > deepest
            for o in near
        )

    def _breaks_relation(self, last: SceneObject, layout: Sequence[SceneObject]) -> bool:
        if self.reference is None:
            return False
        found = align(Scene("layout", self.table, tuple(layout)), self.reference)
        names = dict(found.matches)
        if last.instance not in names.values():
            return False
        judged = [[names.get(name) for name in members(r)] for r in found.broken or ()]
        return any(None not in instances and last.instance in instances for instances in judged)


def _may_touch(one: SceneObject, other: SceneObject) -> bool:
    """Whether the circles around two outlines overlap."""
    distance = math.hypot(one.position[0] - other.position[0], one.position[1] - other.position[1])
    return 2 * distance < math.hypot(*one.size[:2]) + math.hypot(*other.size[:2])
