"""Checks of a reply, before its objects enter a scene.

A reply with a hard fault is refused. A soft fault is reported only: the correction may repair it, or it cannot be judged. The
message of a fault is one line with the object, the finding and what to do, so that it can be shown to a language model.

In an edit only changes are judged: the place and the size of an object may be faulty before the edit. An object that loses its
support is a soft fault, since :func:`models.semantic_reasoner.editing.apply_edit` moves it with the support. A reply that
changes nothing is a soft fault too, since some instructions require no change (``take the cups away`` without cups).
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace

import numpy as np

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter, compare_with_instruction
from models.semantic_reasoner.replies.grammar import MOST_OBJECTS
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from models.settings import NonNegative, PositiveCount, Settings, Share
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import FloatArray, Relation, SceneObject, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle
from stable_data.scene_graph.support_from_boxes import ON_TABLE, carriers_of

CROWDED = "crowded"
"""Code of the fault that the objects of a reply have no room on the table."""

REQUIRED_MISSING = "required_missing"
"""Code of the fault that a reply lacks objects which the instruction requires."""

_SHOWN = 8  # names in a message

# The data on which these were tuned is not recorded.
_SUNK_CM = 0.5  # an underside may be this far below the table top, centimetres
_SIZE_SLACK = 2.0  # a side beyond this multiple of the sizes of its category is a hard fault,
_RARE_SIZE_SLACK = 3.0  # beyond this multiple if few objects of the category are known:
_RARE_COUNT = 20  # fewer than this
_UNUSUAL_SIZE = 1.4  # a side beyond this multiple is a soft fault
_MAX_COVERAGE = 1.1  # the largest sum of the areas of objects on the table, as a share of the table's area


@dataclass(frozen=True, slots=True)
class ReplyFault:
    """A fault of a reply.

    Attributes:
        code: Short machine-readable reason, such as ``floats``.
        message: One line.
        is_hard: Whether the reply is refused.
        instance: The object whose removal removes the fault; empty if there is none.
        relation: The relation that the instruction states and the layout violates; None for other faults.
    """

    code: str
    message: str
    is_hard: bool = True
    instance: str = ""
    relation: Relation | None = None


@dataclass(frozen=True, slots=True)
class CheckSettings(Settings):
    """How strict the checks are."""

    overhang_cm: NonNegative = 2.0
    """Centimetres; a box may reach this far over the table's edge or into the restricted zone. The correction moves it back."""

    same_place: Share = 0.85
    """Two boxes count as the same object if their intersection is more than this share of their union."""

    most_objects: PositiveCount = MOST_OBJECTS
    """Objects of one reply, at most."""

    deepest_cm: NonNegative = 1.0
    """Centimetres; while a reply is written, boxes of which none carries the other may reach this deep into each other. A
    reply that is complete is not judged by this."""

    def shaping(self) -> dict[str, float]:
        """Returns all settings and constants that verdicts depend on; a run resumes only with the same ones."""
        constants = {
            "sunk_cm": _SUNK_CM,
            "size_slack": _SIZE_SLACK,
            "rare_size_slack": _RARE_SIZE_SLACK,
            "rare": _RARE_COUNT,
            "unusual": _UNUSUAL_SIZE,
            "crowding": _MAX_COVERAGE,
        }
        return asdict(self) | constants


class ReplyCheck:
    """The checks of replies.

    Args:
        statistics: Statistics of the known categories.
        interpret: Interprets instructions; None: what an instruction requires is not judged.
        settings: How strict the checks are.
    """

    def __init__(
        self,
        statistics: CategoryStatistics,
        interpret: InstructionInterpreter | None = None,
        settings: CheckSettings = CheckSettings(),
    ) -> None:
        self._statistics, self._interpret, self._settings = statistics, interpret, settings

    def __call__(self, reply: LayoutReply, question: ReasonerQuestion, /) -> list[ReplyFault]:
        """Returns the faults of a reply to a question."""
        return check_reply(reply.objects, reply.removed, question, self._statistics, self._interpret, self._settings)


def form_check(reply: LayoutReply, question: ReasonerQuestion, /) -> list[ReplyFault]:
    """Returns the faults that need no statistics of categories: names, the unit, and edits that change nothing."""
    return [*name_faults(reply.objects, reply.removed, question), *_unit_fault(reply.objects, question)] or list(
        _no_change_fault(reply.objects, reply.removed, question)
    )


def check_reply(
    objects: Sequence[LayoutObject],
    removed: Sequence[str],
    question: ReasonerQuestion,
    statistics: CategoryStatistics,
    interpret: InstructionInterpreter | None = None,
    settings: CheckSettings = CheckSettings(),
) -> list[ReplyFault]:
    """Returns the faults of a reply.

    Args:
        objects: The reply's objects.
        removed: Instances that the reply removes; only edits do.
        question: The question, with the layout so far.
        statistics: Statistics of the known categories.
        interpret: Interprets the instruction; None: what it requires is not judged.
        settings: How strict the checks are.

    Returns:
        The faults, hard ones first. Deterministic.
    """
    if len(objects) > settings.most_objects:  # checked first, since the other checks compare all pairs
        return [ReplyFault("too_many", f"there are {len(objects)} objects; give at most {settings.most_objects}")]
    faults = [*name_faults(objects, removed, question), *_unit_fault(objects, question)]
    if any(f.is_hard for f in faults):
        return faults  # the other checks need unique names and centimetres
    unchanged = _unchanged_objects(objects, removed, question)
    was = _changeable(question)
    unmoved = {o.instance for o in objects if o.instance in was and _is_unmoved(o, was[o.instance])}
    new = [_with_same_underside(o, was).to_scene_object() for o in objects]
    layout = [*(o.to_scene_object() for o in unchanged), *new]
    faults += _count_faults(objects, new, layout, question)
    for one, item in zip(objects, new, strict=True):
        if one.instance not in unmoved:
            faults += place_faults(item, question.table, settings)
        if one.instance not in was or not _is_plausible_resize(one, was[one.instance]):
            faults += _size_faults(one, statistics)
    faults += _support_faults(new, layout, question, unmoved)
    faults += same_place_faults(new, layout, unmoved, settings)
    faults += _rename_faults(objects, removed, was)
    if interpret is not None and not question.edits:
        faults += _instruction_faults(layout, unchanged, question, interpret, any(f.is_hard for f in faults))
    return sorted(faults, key=lambda f: not f.is_hard) or list(_no_change_fault(objects, removed, question))


def _unchanged_objects(
    objects: Sequence[LayoutObject], removed: Sequence[str], question: ReasonerQuestion
) -> list[LayoutObject]:
    """The objects of the layout that the reply neither removes nor changes."""
    gone = {*removed, *(o.instance for o in objects)} if question.edits else set()
    return [o for o in question.layout if o.instance not in gone]


def _changeable(question: ReasonerQuestion) -> dict[str, LayoutObject]:
    """The objects of the layout that a reply may change, by instance; none unless it is an edit."""
    return {o.instance: o for o in question.layout} if question.edits else {}


def _is_unmoved(one: LayoutObject, was: LayoutObject) -> bool:
    return (one.position_cm, one.z_rotation_deg, one.size_cm) == (was.position_cm, was.z_rotation_deg, was.size_cm)


def _with_same_underside(one: LayoutObject, was: Mapping[str, LayoutObject]) -> LayoutObject:
    """The object; if its height changes and its z does not, with its old underside, as an edit is applied."""
    old = was.get(one.instance)
    if old is None or one.size_cm[2] == old.size_cm[2] or one.position_cm[2] != old.position_cm[2]:
        return one
    x, y, z = one.position_cm
    return replace(one, position_cm=(x, y, z + (one.size_cm[2] - old.size_cm[2]) / 2))


def _is_plausible_resize(one: LayoutObject, was: LayoutObject) -> bool:
    """Whether an object has its old size, or one that another tilt may give: as long, and no thicker."""
    now, before = np.array(sorted(one.size_cm)), np.array(sorted(was.size_cm))
    return bool((now <= _UNUSUAL_SIZE * before).all() and now[-1] * _UNUSUAL_SIZE >= before[-1])


def name_faults(objects: Sequence[LayoutObject], removed: Sequence[str], question: ReasonerQuestion) -> Iterator[ReplyFault]:
    """Yields the faults of the names of a reply's new, changed and removed objects; all are hard, since the reply is ambiguous."""
    layout = [o.instance for o in question.layout]
    names = [o.instance for o in objects]
    for name, count in _repeated(names):
        yield ReplyFault("instance_twice", f"{name} appears {count} times; give every object its own number")
    for name in dict.fromkeys(names):
        if name in layout and not question.edits:
            yield ReplyFault(
                "instance_repeated", f"{name} is in the layout already; leave it out, or number a new one differently"
            )
    for name in sorted(set(removed) - set(layout)):
        yield ReplyFault(
            "removed_unknown", f"{name} is to be removed, but is not in the layout, which has {_suggestions(layout, name)}"
        )
    for name, count in _repeated(removed):
        yield ReplyFault("removed_twice", f"{name} is removed {count} times; name it once")
    for name in sorted(set(removed) & set(names)):
        yield ReplyFault(
            "removed_and_there", f"{name} is removed and given anew; do one of the two, or give the new object another number"
        )
    if removed and not question.edits:
        yield ReplyFault("removed_unasked", "nothing may be removed here; leave out remove")


def _repeated(names: Sequence[str]) -> list[tuple[str, int]]:
    """Names that appear more than once, with their counts."""
    return [(name, count) for name, count in Counter(names).items() if count > 1]


def are_metres(objects: Sequence[LayoutObject], table: Tabletop) -> bool:
    """Returns whether all objects would be in a corner of the table that is as many centimetres wide as the table is metres."""
    largest = max((max(*o.size_cm, *map(abs, o.position_cm)) for o in objects), default=math.inf)
    return largest <= max(1.0, *table.size_xy)


def _unit_fault(objects: Sequence[LayoutObject], question: ReasonerQuestion) -> Iterator[ReplyFault]:
    if are_metres(objects, question.table):
        yield ReplyFault("unit", "no size and no position is longer than the table in metres; give centimetres")


def _suggestions(known: Sequence[str], wanted: str) -> str:
    """Known instances, those of the same category if there are any."""
    category = wanted.rpartition("_")[0]
    similar = [name for name in known if name.rpartition("_")[0] == category] or known
    return (", ".join(similar[:_SHOWN]) + (", …" if len(similar) > _SHOWN else "")) or "no objects"


def _count_faults(
    objects: Sequence[LayoutObject],
    new: Sequence[SceneObject],
    layout: Sequence[SceneObject],
    question: ReasonerQuestion,
) -> Iterator[ReplyFault]:
    if not objects and question.asks_for_task:
        yield ReplyFault("empty", "there are no objects; give those that the instruction names and what carries them")
    width, depth = question.table.size_xy
    covered = _standing_area(layout) / (width * depth)
    before = _standing_area([o.to_scene_object() for o in question.layout]) / (width * depth) if question.edits else 0.0
    if new and covered > max(_MAX_COVERAGE, before):  # an edit of a crowded table may not make it more crowded
        yield ReplyFault(
            CROWDED,
            f"the objects cover {100 * covered:.0f} % of the {100 * width:.0f} x {100 * depth:.0f} cm of the table; give fewer objects",
        )


def _standing_area(layout: Sequence[SceneObject]) -> float:
    """Sum of the areas of the boxes on the table, square metres."""
    return sum(o.size[0] * o.size[1] for o in layout if o.bottom <= ON_TABLE)


# --- the table ----------------------------------------------------------------------------------------------------------------


def place_faults(item: SceneObject, table: Tabletop, s: CheckSettings) -> Iterator[ReplyFault]:
    """Yields the faults of an object's place on the table; all are hard."""
    corners = yawed_rectangle(item)
    (width, depth), (x, y, _) = table.size_xy, item.position
    # The centre has to be on the table too, so that a thin object cannot hang over the edge.
    over = 100 * max(-float(corners.min()), float(corners[:, 0].max()) - width, float(corners[:, 1].max()) - depth)
    if not (0 <= x <= width and 0 <= y <= depth) or over > s.overhang_cm:
        yield ReplyFault(
            "off_table",
            f"{item.instance} leaves the table by {over:.1f} cm; move it into 0 to {100 * width:.0f} by 0 to {100 * depth:.0f} cm, "
            "or leave it out",
            instance=item.instance,
        )
    if table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = table.restricted_zone
        zone = np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)])
        deep = 100 * overlap_depth(corners, zone)
        if (x_min < x < x_max and y_min < y < y_max) or deep > s.overhang_cm:
            shown = ", ".join(f"{100 * v:.0f}" for v in table.restricted_zone)
            yield ReplyFault(
                "in_restricted_zone",
                f"{item.instance} reaches {deep:.1f} cm into [{shown}], where nothing may stand; put it elsewhere",
                instance=item.instance,
            )
    if table.clearance is not None and item.top > table.clearance:
        yield ReplyFault(
            "too_tall",
            f"{item.instance} is {100 * item.top:.1f} cm high, but only {100 * table.clearance:.0f} cm are free above the table; "
            "give a lower object, or leave it out",
            instance=item.instance,
        )
    if 100 * item.bottom < -_SUNK_CM:
        sunk = -100 * item.bottom
        yield ReplyFault(
            "below_table",
            f"{item.instance} is {sunk:.1f} cm below the table top; its z must be half its height on the table",
            instance=item.instance,
        )


def overlap_depth(one: FloatArray, other: FloatArray) -> float:
    """Penetration of two rectangles, (4, 2) each, by their separating axes; 0 or less if they are apart."""
    depth = np.inf
    for outline in (one, other):
        for edge in (outline[1] - outline[0], outline[2] - outline[1]):
            normal = np.array((-edge[1], edge[0])) / np.hypot(*edge)
            a, b = one @ normal, other @ normal
            depth = min(depth, a.max() - b.min(), b.max() - a.min())
    return float(depth)


# --- sizes --------------------------------------------------------------------------------------------------------------------


def _size_faults(item: LayoutObject, statistics: CategoryStatistics) -> Iterator[ReplyFault]:
    known = statistics.categories.get(item.category)
    if known is None or not known.count:
        words = item.category.replace("_", " ")
        yield ReplyFault("category_unknown", f"{item.instance}: no {words} is known, its size is not judged", is_hard=False)
        return
    # Sorted, since the same object may lie on any of its sides.
    own, least, most = sorted(item.size_cm), [100 * v for v in known.least], [100 * v for v in known.most]
    beyond = max(max(low / v, v / high) for v, low, high in zip(own, least, most, strict=True))
    if beyond > _UNUSUAL_SIZE:
        is_hard = beyond > (_SIZE_SLACK if known.count >= _RARE_COUNT else _RARE_SIZE_SLACK)
        found, low, high = (" x ".join(f"{v:.1f}" for v in sides) for sides in (own, least, most))
        yield ReplyFault(
            "size_implausible" if is_hard else "size_unusual",
            f"{item.instance} is {found} cm, such objects are {low} to {high} cm, shortest side first; give it such a size",
            is_hard,
            item.instance,
        )


# --- one another --------------------------------------------------------------------------------------------------------------


def _support_faults(
    new: Sequence[SceneObject], layout: Sequence[SceneObject], question: ReasonerQuestion, unmoved: Set[str]
) -> Iterator[ReplyFault]:
    carriers = carriers_of(layout, question.table)
    names = {o.instance for o in new} - unmoved
    before: dict[str, str | None] = {}
    if question.edits and len(layout) > len(names):
        before = carriers_of([o.to_scene_object() for o in question.layout], question.table)
    for item in layout:
        if carriers[item.instance] is not None:
            continue
        below = _highest_below(item, layout)
        if item.instance in names:
            yield ReplyFault(
                "floats",
                f"{item.instance} is {100 * (item.bottom - below):.1f} cm above everything; put it on the table or on another "
                "object",
                instance=item.instance,
            )
        elif before.get(item.instance) is not None:  # objects that floated before an edit are not its fault
            yield ReplyFault(
                "loses_carrier",
                f"{item.instance} rested on {before[item.instance]}, which is no longer under it; move or remove it too",
                is_hard=False,
            )


def _highest_below(item: SceneObject, layout: Sequence[SceneObject]) -> float:
    """Height of the highest top under an object's centre, metres; 0, the table's, if there is none."""
    heights = [0.0]
    for o in layout:
        distance = np.hypot(o.position[0] - item.position[0], o.position[1] - item.position[1])
        if o is not item and distance <= min(o.size[:2]) / 2 and o.top <= item.bottom:
            heights.append(o.top)
    return max(heights)


def same_place_faults(
    new: Sequence[SceneObject], layout: Sequence[SceneObject], unmoved: Set[str], s: CheckSettings
) -> Iterator[ReplyFault]:
    """Yields a hard fault for each pair of objects that are the same by their boxes.

    Args:
        new: New and changed objects.
        layout: All objects; the last ones are ``new``.
        unmoved: Instances of ``new`` that an edit leaves where they were.
        s: How strict the check is.
    """
    if len(layout) < 2 or not new:
        return
    size = np.array([o.size for o in layout])
    centre = np.array([o.position for o in layout])
    low, high = centre - size / 2, centre + size / 2  # without the yaw, which is enough to find duplicates
    volume = size.prod(1)
    first = len(layout) - len(new)
    common = np.maximum(0.0, np.minimum(high[first:, None], high) - np.maximum(low[first:, None], low)).prod(2)
    share = common / (volume[first:, None] + volume - common)
    unchanged = {o.instance for o in layout[:first]} | unmoved
    for i, j in np.argwhere(share > s.same_place):
        # Each pair once, and in an edit only if one of the two is new or moved.
        if j < first + i and not {layout[first + i].instance, layout[j].instance} <= unchanged:
            name = layout[first + i].instance
            message = f"{name} is where {layout[j].instance} is; leave it out or put it elsewhere"
            yield ReplyFault("same_place", message, instance=name)


# --- edits --------------------------------------------------------------------------------------------------------------------


def _rename_faults(
    objects: Sequence[LayoutObject], removed: Sequence[str], was: Mapping[str, LayoutObject]
) -> Iterator[ReplyFault]:
    """Objects that are removed and given again under another name."""
    gone = {(was[name].category, was[name].description): name for name in removed if name in was}
    for o in objects:
        name = gone.get((o.category, o.description))
        if o.instance not in was and name is not None:
            yield ReplyFault(
                "renamed",
                f"{o.instance} is {name} under another name; give it as {name}, and leave {name} out of remove",
                is_hard=False,
            )


def _no_change_fault(
    objects: Sequence[LayoutObject], removed: Sequence[str], question: ReasonerQuestion
) -> Iterator[ReplyFault]:
    was = _changeable(question)
    if question.edits and not removed and all(was.get(o.instance) == o for o in objects):
        yield ReplyFault(
            "nothing_changed", "nothing is changed; give what the instruction asks for as it is afterwards", is_hard=False
        )


# --- the instruction ----------------------------------------------------------------------------------------------------------


def _instruction_faults(
    layout: Sequence[SceneObject],
    unchanged: Sequence[LayoutObject],
    question: ReasonerQuestion,
    interpret: InstructionInterpreter,
    has_hard_faults: bool,
) -> Iterator[ReplyFault]:
    """The required objects that a layout of task objects lacks, and the relations of the start that do not hold in it.

    A relation is judged in a layout without hard faults; in a later stage only if it held before.
    """
    meant = interpret(question.instruction)
    found, broken = compare_with_instruction(layout, question.table, meant)
    if found is None:
        return
    if question.asks_for_task:
        for categories, missing in _by_categories(found.missing).items():
            wanted = " or ".join(c.replace("_", " ") for c in categories[:5]) or "something in or on it"
            has_hard_faults = True
            yield ReplyFault(REQUIRED_MISSING, f"the instruction requires {wanted}: give {len(missing)} more")
    elif broken:
        before = [o.to_scene_object() for o in unchanged]
        was = set(compare_with_instruction(before, question.table, meant)[1])
        broken = tuple(r for r in broken if r not in was)
    for r in () if has_hard_faults else broken:
        message = f"the instruction says {r}; place them so"
        yield ReplyFault("relation_not_held", message, is_hard=False, relation=r)


def _by_categories(required: Sequence[RequiredObject]) -> dict[tuple[str, ...], list[RequiredObject]]:
    found: dict[tuple[str, ...], list[RequiredObject]] = {}
    for one in required:
        found.setdefault(one.categories, []).append(one)
    return found
