"""What an instruction requires, by sizes: whether there is room for it, and the objects that a reply lacks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TypeAlias

from models.semantic_reasoner.language.category_statistics import Category, CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter, InterpretedInstruction
from models.semantic_reasoner.replies.checks import CROWDED, ReplyFault
from models.semantic_reasoner.replies.free_places import FreePlaces
from models.semantic_reasoner.replies.grammar import MOST_NAMES
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import DECIMALS, LayoutObject, LayoutReply, renumber_instances
from stable_data.errors import SceneError
from stable_data.instructions.wording.words import type_words
from stable_data.metrics.matching import RequiredObject, candidates, match
from stable_data.scene import RelationKind, Tabletop, Vec3

TOO_MANY = "too_many_objects"
"""Code of a question that requires more objects than there can be."""

PLACED = "placed_anew"
"""Code of the fault that reports a required object which was added to a reply."""

_GAPS = (0.02, 0.0)  # between an added object and others, metres; the second one if there is no room with the first

_CROWDED = "the table has no room for all where the answer has them"

RemovedObject: TypeAlias = tuple[LayoutObject, ReplyFault]
"""An object that was removed from a reply, and why."""

Carriers: TypeAlias = Mapping[str, tuple[str, RelationKind]]
"""The object that each of some objects is on or in, and which of the two."""


class RequiredObjects:
    """Judges whether there is room for the objects that an instruction requires, and adds those that a reply lacks.

    Args:
        statistics: The sizes of categories.
        interpret: Interprets instructions.
        most_objects: Largest number of objects of a reply.
    """

    def __init__(self, statistics: CategoryStatistics, interpret: InstructionInterpreter, most_objects: int) -> None:
        self._statistics, self._interpret, self._most_objects = statistics, interpret, most_objects

    # --- room ---

    def check_room(self, question: ReasonerQuestion) -> None:
        """Refuses a question whose objects have no room, however they are arranged.

        Objects are taken as small, and what carries them as large, as those of their categories are. An object of which the
        instruction does not say that it is on or in another one needs room on the table.

        Raises:
            SceneError: There are too many (``too_many_objects``).
        """
        if question.layout and not question.edits:
            return  # a later stage, whose objects are not required
        meant = self._interpret(question.instruction, question.edits)
        required, carriers = _added(meant) if question.edits else _required(meant)
        asked, most, setting = meant.num_objects, self._most_objects, " (reasoner.checks.most_objects)"
        if question.edits and asked > MOST_NAMES:  # an edit may name all objects of the largest layout
            most, setting = MOST_NAMES, ""
        elif question.edits:
            asked = len(required)
        if asked > most:
            found = f"instruction requires {asked:,} objects, expected at most {most:,}{setting}"
            raise SceneError(f"{found}; ask for fewer", TOO_MANY)
        self._check_table([r for r in required if r.instance not in carriers], question.table)
        for carrier in required:
            contents = [r for r in required if carriers.get(r.instance, ("",))[0] == carrier.instance]
            if contents:
                self._check_carrier(carrier, contents, carriers[contents[0].instance][1])

    def _check_table(self, standing: Iterable[RequiredObject], table: Tabletop) -> None:
        sizes, places = self._smallest(standing), FreePlaces(table)
        num_placed = sum(places.take(*size[:2]) is not None for size in sorted(sizes, key=_area, reverse=True))
        if num_placed < len(sizes):
            width, depth = (100 * s for s in table.size_xy)
            raise SceneError(
                f"instruction requires {len(sizes)} objects on the table, whose {width:.0f} x {depth:.0f} cm have room for "
                f"{num_placed}; ask for fewer, or for a larger table",
                TOO_MANY,
            )

    def _check_carrier(self, carrier: RequiredObject, contents: Sequence[RequiredObject], kind: RelationKind) -> None:
        sizes, large = self._smallest(contents), [known.largest_size for known in self._known(carrier).values()]
        if not sizes or not large:
            return
        # Contents reach beyond the edge by half their size at most, and a heap is at most half as high as its base is wide.
        width, depth, height = (max(size[axis] for size in sizes) for axis in range(3))
        space = max(
            (w + width) * (d + depth) * (h * (kind is RelationKind.IN) + max(height, min(w, d) / 2)) for w, d, h in large
        )
        room = int(len(sizes) * space / sum(_area(size) * size[2] for size in sizes))
        if room < len(sizes):
            found = f"instruction requires {len(sizes)} objects {kind} the {carrier}"
            raise SceneError(f"{found}, which has room for at most {room}; ask for fewer", TOO_MANY)

    # --- missing objects ---

    def completed(
        self, reply: LayoutReply, removed: Sequence[RemovedObject], question: ReasonerQuestion
    ) -> Iterator[tuple[LayoutReply, list[ReplyFault], list[RemovedObject]]]:
        """Yields replies with the required objects that a reply lacks, each where there is room on the table.

        First no other object changes; then those that are not required are removed; then all are placed anew; then as small ones.

        Args:
            reply: The reply.
            removed: Objects that were removed from it, and why; they are added again if they are required.
            question: The question.

        Yields:
            A reply, a soft fault for each added object, and the removed objects that were not added; nothing if there is no room,
            or if a size is not known.
        """
        reference = self._interpret(question.instruction, question.edits).reference
        required = () if reference is None else reference.required
        allowed = candidates(required, [o.to_scene_object() for o in reply.objects])
        matches = match(allowed).matches if any(allowed.values()) else {}
        left = list(removed)
        wanted = self._wanted([r for r in required if r.instance not in matches], reply, left)
        if wanted is None:
            return
        needed = tuple(o for o in reply.objects if o.instance in set(matches.values()))
        every = [*wanted, *((o, _CROWDED) for o in needed)]
        small = [(self._small(o), why) for o, why in every]
        for (there, added), gap in product(((reply.objects, wanted), (needed, wanted), ((), every), ((), small)), _GAPS):
            found = _placed(added, FreePlaces(question.table, [o.to_scene_object() for o in there], gap))
            if found is not None:
                new = renumber_instances((o for o, _ in found), (o.instance for o in there))
                messages = (f"{o.instance} is placed anew: {why}" for o, (_, why) in zip(new, found, strict=True))
                faults = [ReplyFault(PLACED, message, is_hard=False) for message in messages]
                gone = [] if there == reply.objects else [o for o in reply.objects if o not in needed]
                crowded = [(o, ReplyFault(CROWDED, f"{o.instance}: {_CROWDED}", instance=o.instance)) for o in gone]
                yield replace(reply, objects=(*there, *new)), faults, [*left, *crowded]

    def _wanted(
        self, lacking: Iterable[RequiredObject], reply: LayoutReply, removed: list[RemovedObject]
    ) -> list[tuple[LayoutObject, str]] | None:
        """The objects to add, and why; None if one of them has no known size.

        They are removed ones in their usual size, which are taken from ``removed``, or like one that is there, or usual ones.
        """
        found = []
        for r in lacking:
            known = self._known(r)
            if not known:
                return None
            old = next((pair for pair in removed if pair[0].category in known), None)
            like = next((o for o in reply.objects if o.category in known), None)
            if old is not None:
                removed.remove(old)
                found.append((replace(old[0], size_cm=_cm(known[old[0].category].usual_size)), old[1].message))
            elif like is not None:
                found.append((like, "the answer has too few of them"))
            else:
                category = self._statistics.most_frequent(known)
                words, size = f"a {' '.join(type_words(category))}", _cm(known[category].usual_size)
                found.append((LayoutObject(f"{category}_0", words, size, size, 0), "the answer lacks it"))
        return found

    def _small(self, o: LayoutObject) -> LayoutObject:
        """The object in the size of a small one of its category."""
        known = self._statistics.categories.get(o.category)
        return o if known is None or not known.sizes else replace(o, size_cm=_cm(known.smallest_size))

    def _known(self, required: RequiredObject) -> dict[str, Category]:
        """The categories of a required object whose sizes are known."""
        found = {c: self._statistics.categories[c] for c in required.categories if c in self._statistics.categories}
        return {c: known for c, known in found.items() if known.sizes}

    def _smallest(self, required: Iterable[RequiredObject]) -> list[Vec3]:
        """The size of a small object of each, as far as it is known."""
        known = (self._known(r).values() for r in required)
        return [min((c.smallest_size for c in categories), key=_area) for categories in known if categories]


def _required(meant: InterpretedInstruction) -> tuple[Sequence[RequiredObject], Carriers]:
    """The objects of the start."""
    if meant.reference is None:
        return (), {}
    names = {r.instance for r in meant.reference.required}
    carrying = (r for r in meant.reference.entailed if r.kind in (RelationKind.IN, RelationKind.ON) and r.target in names)
    return meant.reference.required, {r.subject: (r.target, r.kind) for r in carrying}


def _added(meant: InterpretedInstruction) -> tuple[Sequence[RequiredObject], Carriers]:
    """The new objects of an edit; those that go on or into another one need no room on the table."""
    carried = {r.subject for r in meant.reading.goal if r.kind in ("in", "on")}
    added = {k: o for k, o in enumerate(meant.reading.objects) if o.change == "add" and o.categories}
    return [RequiredObject(str(k), o.categories) for k, o in added.items()], {str(k): ("", RelationKind.ON) for k in carried}


def _placed(wanted: Iterable[tuple[LayoutObject, str]], places: FreePlaces) -> list[tuple[LayoutObject, str]] | None:
    """Objects at free places on the table, the largest first; None if there is no room for one of them."""
    found = []
    for o, why in sorted(wanted, key=lambda pair: -_area(pair[0].size_cm)):
        width, depth, height = o.size_cm
        place = places.take(width / 100, depth / 100)
        if place is None:
            return None
        x, y, is_turned = place
        found.append((replace(o, position_cm=_cm((x, y, height / 200)), z_rotation_deg=90 if is_turned else 0), why))
    return found


def _cm(lengths: Vec3) -> Vec3:
    x, y, z = (round(100 * v, DECIMALS) for v in lengths)
    return x, y, z


def _area(size: Vec3) -> float:
    return size[0] * size[1]
