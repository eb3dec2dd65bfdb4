"""What a scene must have so that an instruction makes sense in it: the required objects, and the relations of its start."""

from collections.abc import Iterator, Set

from models.instruction_reader.nouns import is_hollow
from models.instruction_reader.reading import InstructionReading
from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Relation, RelationKind

_KINDS = {
    "in": RelationKind.IN,
    "on": RelationKind.ON,
    "left": RelationKind.LEFT_OF,
    "front": RelationKind.IN_FRONT_OF,
}
"""The relations of a reading between two objects that the scene graph has; ``near`` is not among them."""


def reference_of_reading(
    reading: InstructionReading, name: str, with_contradictions: bool = False
) -> AlignmentReference | None:
    """Returns the requirements that follow from a reading; None if it has no known object.

    Objects of no known category and new objects of an edit are not required, nor are their relations. An object that holds
    things without a name requires one thing of any category in or on it.

    Args:
        reading: The reading.
        name: Id of the requirements, such as that of the task.
        with_contradictions: Whether relations count that cannot hold together with the others.
    """
    known = {k: o for k, o in enumerate(reading.objects) if o.categories and o.change != "add"}
    if not known:
        return None
    required = [RequiredObject(str(k), o.categories) for k, o in known.items()]
    entailed = [
        Relation(str(r.subject), _KINDS[r.kind], str(r.target))
        for r in (*reading.start, *(reading.contradictions if with_contradictions else ()))
        if r.kind in _KINDS and {r.subject, r.target} <= known.keys()
    ]
    entailed += _between(reading, known.keys())
    held = {r.target for r in entailed if r.kind in (RelationKind.IN, RelationKind.ON)}
    for k, o in known.items():
        if o.region:
            entailed.append(Relation(str(k), RelationKind.IS_AT, o.region))
        if o.is_filled and str(k) not in held:
            required.append(RequiredObject(f"content of {k}", ()))
            kind = RelationKind.IN if all(map(is_hollow, o.categories)) else RelationKind.ON
            entailed.append(Relation(f"content of {k}", kind, str(k)))
    return AlignmentReference(name, tuple(required), tuple(entailed))


def _between(reading: InstructionReading, known: Set[int]) -> Iterator[Relation]:
    """That an object is between two others; a reading states it by a relation to each of them."""
    ends: dict[int, list[int]] = {}
    for r in reading.start:
        if r.kind == "between":
            ends.setdefault(r.subject, []).append(r.target)
    for subject, targets in ends.items():
        if len(targets) == 2 and {subject, *targets} <= known:
            yield Relation(str(subject), RelationKind.BETWEEN, ", ".join(map(str, sorted(targets))))
