"""What is wrong with a reply, before it enters a scene.

Hard faults keep a reply out. Soft ones are named: the correction may mend them, or nobody can tell. A fault's message is one
line that says which thing, what was found and what to do, so that it can be said to a language model as it is.

Of an edit only what it brings is judged: a thing that stays where it was, or is as large as it was, was there before. That a
thing is left behind by what carried it is soft, for :func:`models.semantic_reasoner.editing.apply_edit` takes it along; so is
a reply that changes nothing, for there are instructions that ask for nothing (``take the cups away`` where there are none).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.required_objects import ObjectRequirement, required_objects
from models.semantic_reasoner.language.stated_relations import relations_not_held
from models.semantic_reasoner.replies.grammar import MOST_OBJECTS
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from models.settings import NonNegative, PositiveCount, Settings, Share
from stable_data.scene import FloatArray, Relation, SceneObject, Stage, Tabletop
from stable_data.scene_graph.relations import yawed_rectangle
from stable_data.scene_graph.support_from_boxes import ON_TABLE, carriers_of

_SHOWN = 8  # names in a message

# What these were tuned on is not recorded.
_SUNK_CM = 0.5  # an underside may be this far below the table top, centimetres
_SIZE_SLACK = 2.0  # a side is refused beyond this many times the sizes of its category ...
_RARE_SIZE_SLACK = 3.0  # ... and beyond this many times where few objects of the category are known:
_RARE = 20  # fewer than this
_UNUSUAL_SIZE = 1.4  # beyond this many times a side is named, though it may pass
_CROWDING = 1.1  # what stands on the table covers at most this share of its area


@dataclass(frozen=True, slots=True)
class ReplyFault:
    """Something wrong with a reply.

    Attributes:
        code: Short machine-readable reason, such as ``floats``.
        message: One line.
        is_hard: Whether it keeps the reply out.
        instance: The object without which it would not be there; empty where there is none such.
        relation: What the instruction says and is not so; None for other faults.
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
    """Two boxes are the same object twice where their intersection is at least this share of their union."""

    most_objects: PositiveCount = MOST_OBJECTS
    """Objects of one reply, at most."""

    def shaping(self) -> dict[str, float]:
        """All that verdicts depend on, the constants too: a run is resumed only under the same."""
        constants = {
            "sunk_cm": _SUNK_CM,
            "size_slack": _SIZE_SLACK,
            "rare_size_slack": _RARE_SIZE_SLACK,
            "rare": _RARE,
            "unusual": _UNUSUAL_SIZE,
            "crowding": _CROWDING,
        }
        return asdict(self) | constants


class ReplyCheck:
    """The checks with all that they need to know but the question and the reply.

    Args:
        statistics: What is known of categories.
        settings: How strict to be.
    """

    def __init__(self, statistics: CategoryStatistics, settings: CheckSettings = CheckSettings()) -> None:
        self._statistics, self._settings = statistics, settings
        self._required = lru_cache(maxsize=512)(lambda instruction: required_objects(instruction, statistics))

    def __call__(self, reply: LayoutReply, ask: ReasonerQuestion, /) -> list[ReplyFault]:
        """The faults of a reply to a question."""
        return check_reply(reply.objects, reply.removed, ask, self._statistics, self.asks(ask), self._settings)

    def asks(self, ask: ReasonerQuestion) -> tuple[ObjectRequirement, ...]:
        """What must be among the objects when the task objects are there."""
        return self._required(ask.instruction) if _asks_for_task(ask) else ()


def form_check(reply: LayoutReply, ask: ReasonerQuestion, /) -> list[ReplyFault]:
    """The faults that can be told without knowing anything of categories: names, and edits that change nothing."""
    return list(name_faults(reply.objects, reply.removed, ask)) or list(_unchanged(reply.objects, reply.removed, ask))


def check_reply(
    objects: Sequence[LayoutObject],
    removed: Sequence[str],
    ask: ReasonerQuestion,
    statistics: CategoryStatistics,
    asked_for: Sequence[ObjectRequirement],
    settings: CheckSettings = CheckSettings(),
) -> list[ReplyFault]:
    """What is wrong with a reply.

    Args:
        objects: The reply's objects.
        removed: What it takes away; only edits do.
        ask: What it answers, the layout so far included.
        statistics: What is known of categories.
        asked_for: What the instruction asks for; looked at where the task objects are wanted, alone or with all else.
        settings: How strict to be.

    Returns:
        The faults, hard ones first; empty where there is nothing to say. The same for the same input.
    """
    if len(objects) > settings.most_objects:  # the other checks compare each object with each
        return [ReplyFault("too_many", f"there are {len(objects)} objects; give at most {settings.most_objects}")]
    faults = list(name_faults(objects, removed, ask))
    if any(f.is_hard for f in faults):
        return faults  # without names nothing else can be told
    kept = _kept(objects, removed, ask)
    was = _changed(ask)
    still = {o.instance for o in objects if o.instance in was and _is_still(o, was[o.instance])}
    new = [_standing_still(o, was).to_scene_object() for o in objects]
    layout = [*(o.to_scene_object() for o in kept), *new]
    faults += _numbers(objects, new, layout, ask)
    for one, item in zip(objects, new, strict=True):
        if one.instance not in still:
            faults += _place(item, ask.table, settings)
        if one.instance not in was or not _may_be_laid_so(one, was[one.instance]):
            faults += _size(one, statistics)
    faults += _carried(new, layout, ask, still)
    faults += _twice(new, layout, still, settings)
    faults += _renamed(objects, removed, was)
    if _asks_for_task(ask):
        faults += _missing(layout, asked_for)
    if not (ask.edits or any(f.is_hard for f in faults)):
        faults += _not_as_said(layout, kept, ask, statistics)
    return sorted(faults, key=lambda f: not f.is_hard) or list(_unchanged(objects, removed, ask))


def _asks_for_task(ask: ReasonerQuestion) -> bool:
    return ask.wanted in (Stage.TASK, "whole")


def _not_as_said(
    layout: Sequence[SceneObject], kept: Sequence[LayoutObject], ask: ReasonerQuestion, statistics: CategoryStatistics
) -> Iterator[ReplyFault]:
    """What the instruction says of the start and a layout breaks; of a later stage, what was so before it."""
    broken = relations_not_held(layout, ask.table, ask.instruction, statistics)
    if broken and ask.wanted in (Stage.IMPORTANT, Stage.SECONDARY):
        before = [o.to_scene_object() for o in kept]
        was = set(relations_not_held(before, ask.table, ask.instruction, statistics))
        broken = tuple(r for r in broken if r not in was)
    for r in broken:
        message = f"the instruction says {r}; place them so"
        yield ReplyFault("relation_not_held", message, is_hard=False, relation=r)


def _kept(objects: Sequence[LayoutObject], removed: Sequence[str], ask: ReasonerQuestion) -> list[LayoutObject]:
    """What stays of the layout so far as it is."""
    gone = {*removed, *(o.instance for o in objects)} if ask.edits else set()
    return [o for o in ask.layout if o.instance not in gone]


def _changed(ask: ReasonerQuestion) -> dict[str, LayoutObject]:
    """What a reply may name as it is in the layout: only edits do."""
    return {o.instance: o for o in ask.layout} if ask.edits else {}


def _is_still(one: LayoutObject, was: LayoutObject) -> bool:
    return (one.position_cm, one.z_rotation_deg, one.size_cm) == (was.position_cm, was.z_rotation_deg, was.size_cm)


def _standing_still(one: LayoutObject, was: Mapping[str, LayoutObject]) -> LayoutObject:
    """The object; where another height is given it and the same z, with its underside where it was, as an edit has it."""
    old = was.get(one.instance)
    if old is None or one.size_cm[2] == old.size_cm[2] or one.position_cm[2] != old.position_cm[2]:
        return one
    x, y, z = one.position_cm
    return replace(one, position_cm=(x, y, z + (one.size_cm[2] - old.size_cm[2]) / 2))


def _may_be_laid_so(one: LayoutObject, was: LayoutObject) -> bool:
    """Is it as large as it was, or as it would be where it leans less: as long, and no thicker?"""
    now, before = np.array(sorted(one.size_cm)), np.array(sorted(was.size_cm))
    return bool((now <= _UNUSUAL_SIZE * before).all() and now[-1] * _UNUSUAL_SIZE >= before[-1])


def name_faults(objects: Sequence[LayoutObject], removed: Sequence[str], ask: ReasonerQuestion) -> Iterator[ReplyFault]:
    """What is wrong with the names of a reply, all of it hard: nobody can tell what such a reply means.

    Args:
        objects: The reply's objects.
        removed: What it takes away.
        ask: What it answers.
    """
    layout = [o.instance for o in ask.layout]
    names = [o.instance for o in objects]
    for name, count in _repeated(names):
        yield ReplyFault("instance_twice", f"{name} is there {count} times; give every object a number of its own")
    for name in dict.fromkeys(names):
        if name in layout and not ask.edits:
            yield ReplyFault(
                "instance_repeated", f"{name} is in the layout already; leave it out, or number a new one differently"
            )
    for name in sorted(set(removed) - set(layout)):
        yield ReplyFault(
            "removed_unknown", f"{name} is to be removed, but is not in the layout, which has {_some(layout, name)}"
        )
    for name, count in _repeated(removed):
        yield ReplyFault("removed_twice", f"{name} is removed {count} times; name it once")
    for name in sorted(set(removed) & set(names)):
        yield ReplyFault(
            "removed_and_there", f"{name} is removed and given anew; do one of the two, or give what is new another number"
        )
    if removed and not ask.edits:
        yield ReplyFault("removed_unasked", "nothing may be removed here; leave out remove")


def _repeated(names: Sequence[str]) -> list[tuple[str, int]]:
    """Names that are there more than once, and how often."""
    return [(name, count) for name, count in Counter(names).items() if count > 1]


def _some(known: Sequence[str], wanted: str) -> str:
    """Instances to choose from, those of the same kind if there are any."""
    kind = wanted.rpartition("_")[0]
    near = [name for name in known if name.rpartition("_")[0] == kind] or known
    return (", ".join(near[:_SHOWN]) + (", …" if len(near) > _SHOWN else "")) or "no objects"


def _numbers(
    objects: Sequence[LayoutObject],
    new: Sequence[SceneObject],
    layout: Sequence[SceneObject],
    ask: ReasonerQuestion,
) -> Iterator[ReplyFault]:
    if not objects and ask.wanted in (Stage.TASK, "whole"):
        yield ReplyFault("empty", "there are no objects; give those that the instruction names and what carries them")
    width, depth = ask.table.size_xy
    taken = _standing(layout) / (width * depth)
    before = _standing([o.to_scene_object() for o in ask.layout]) / (width * depth) if ask.edits else 0.0
    if new and taken > max(_CROWDING, before):
        yield ReplyFault(
            "crowded",
            f"what stands on the table takes {100 * taken:.0f} % of its {100 * width:.0f} x {100 * depth:.0f} cm; give fewer objects",
        )


def _standing(layout: Sequence[SceneObject]) -> float:
    """Area that stands on the table, square metres."""
    return sum(o.size[0] * o.size[1] for o in layout if o.bottom <= ON_TABLE)


# --- the table ----------------------------------------------------------------------------------------------------------------


def _place(item: SceneObject, table: Tabletop, s: CheckSettings) -> Iterator[ReplyFault]:
    corners = yawed_rectangle(item)
    (width, depth), (x, y, _) = table.size_xy, item.position
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
        deep = 100 * _common_depth(corners, zone)
        if (x_min < x < x_max and y_min < y < y_max) or deep > s.overhang_cm:
            shown = ", ".join(f"{100 * v:.0f}" for v in table.restricted_zone)
            yield ReplyFault(
                "in_restricted_zone",
                f"{item.instance} reaches {deep:.1f} cm into [{shown}], where nothing may stand; put it elsewhere",
                instance=item.instance,
            )
    if 100 * item.bottom < -_SUNK_CM:
        sunk = -100 * item.bottom
        yield ReplyFault(
            "below_table",
            f"{item.instance} is {sunk:.1f} cm below the table top; its z must be half its height on the table",
            instance=item.instance,
        )


def _common_depth(one: FloatArray, other: FloatArray) -> float:
    """How far two convex outlines, (4, 2) each, reach into each other, 0 or less where they do not."""
    depth = np.inf
    for outline in (one, other):
        for edge in (outline[1] - outline[0], outline[2] - outline[1]):
            normal = np.array((-edge[1], edge[0])) / np.hypot(*edge)
            a, b = one @ normal, other @ normal
            depth = min(depth, a.max() - b.min(), b.max() - a.min())
    return float(depth)


# --- sizes --------------------------------------------------------------------------------------------------------------------


def _size(item: LayoutObject, statistics: CategoryStatistics) -> Iterator[ReplyFault]:
    known = statistics.categories.get(item.category)
    if known is None or not known.count:
        words = item.category.replace("_", " ")
        yield ReplyFault("category_unknown", f"{item.instance}: no {words} is known, its size is not judged", is_hard=False)
        return
    own, least, most = sorted(item.size_cm), _in_cm(known.least), _in_cm(known.most)
    beyond = max(max(low / v, v / high) for v, low, high in zip(own, least, most, strict=True))
    if beyond > _UNUSUAL_SIZE:
        is_hard = beyond > (_SIZE_SLACK if known.count >= _RARE else _RARE_SIZE_SLACK)
        found, low, high = (" x ".join(f"{v:.1f}" for v in sides) for sides in (own, least, most))
        yield ReplyFault(
            "size_implausible" if is_hard else "size_unusual",
            f"{item.instance} is {found} cm, such things are {low} to {high} cm, shortest side first; give it such a size",
            is_hard,
            item.instance,
        )


def _in_cm(lengths: Sequence[float]) -> list[float]:
    return [100 * v for v in lengths]


# --- one another --------------------------------------------------------------------------------------------------------------


def _carried(
    new: Sequence[SceneObject], layout: Sequence[SceneObject], ask: ReasonerQuestion, still: Set[str]
) -> Iterator[ReplyFault]:
    carriers = carriers_of(layout, ask.table)
    names = {o.instance for o in new} - still
    before: dict[str, str | None] = {}
    if ask.edits and len(layout) > len(names):
        before = carriers_of([o.to_scene_object() for o in ask.layout], ask.table)
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
        elif before.get(item.instance) is not None:
            yield ReplyFault(
                "loses_carrier",
                f"{item.instance} rested on {before[item.instance]}, which is no longer under it; move or remove it too",
                is_hard=False,
            )


def _highest_below(item: SceneObject, layout: Sequence[SceneObject]) -> float:
    """Height of the highest top under an object's centre, metres; the table's where there is none."""
    heights = [0.0]
    for o in layout:
        away = np.hypot(o.position[0] - item.position[0], o.position[1] - item.position[1])
        if o is not item and away <= min(o.size[:2]) / 2 and o.top <= item.bottom:
            heights.append(o.top)
    return max(heights)


def _twice(
    new: Sequence[SceneObject], layout: Sequence[SceneObject], still: Set[str], s: CheckSettings
) -> Iterator[ReplyFault]:
    if len(layout) < 2 or not new:
        return
    size = np.array([o.size for o in layout])
    centre = np.array([o.position for o in layout])
    low, high = centre - size / 2, centre + size / 2
    volume = size.prod(1)
    first = len(layout) - len(new)
    common = np.maximum(0.0, np.minimum(high[first:, None], high) - np.maximum(low[first:, None], low)).prod(2)
    share = common / (volume[first:, None] + volume - common)
    kept = {o.instance for o in layout[:first]} | still
    for i, j in np.argwhere(share > s.same_place):
        if j < first + i and not {layout[first + i].instance, layout[j].instance} <= kept:
            name = layout[first + i].instance
            message = f"{name} is where {layout[j].instance} is; leave it out or put it elsewhere"
            yield ReplyFault("same_place", message, instance=name)


# --- edits --------------------------------------------------------------------------------------------------------------------


def _renamed(objects: Sequence[LayoutObject], removed: Sequence[str], was: Mapping[str, LayoutObject]) -> Iterator[ReplyFault]:
    """Things that are taken away and given anew, though they are the same."""
    gone = {(was[name].category, was[name].description): name for name in removed if name in was}
    for o in objects:
        name = gone.get((o.category, o.description))
        if o.instance not in was and name is not None:
            yield ReplyFault(
                "renamed",
                f"{o.instance} is {name} by another name; give it as {name}, and leave that out of remove",
                is_hard=False,
            )


def _unchanged(objects: Sequence[LayoutObject], removed: Sequence[str], ask: ReasonerQuestion) -> Iterator[ReplyFault]:
    was = _changed(ask)
    if ask.edits and not removed and all(was.get(o.instance) == o for o in objects):
        yield ReplyFault(
            "nothing_changed", "nothing is changed; give what the instruction asks for as it is afterwards", is_hard=False
        )


# --- the instruction ----------------------------------------------------------------------------------------------------------


def _missing(layout: Sequence[SceneObject], required: Sequence[ObjectRequirement]) -> Iterator[ReplyFault]:
    categories = [o.category for o in layout]
    for asked in required:
        if asked.is_met_by(categories):
            continue
        there = sum(c in asked.categories for c in categories)
        wanted = " or ".join(c.replace("_", " ") for c in asked.categories[:5]) or "something in or on it"
        yield ReplyFault(
            "required_missing",
            f'the instruction speaks of "{asked.words}": give {asked.at_least} ({wanted}), {there if asked.categories else 0} found',
        )
