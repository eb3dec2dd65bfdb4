"""Edits of a layout: how one is asked for, and what a reply makes of the scene.

What a reply does not name keeps its pose to the last digit. What it names under the instance that it has keeps every number
that the reply repeats, and its asset unless its words are others. What rests on a thing goes along with it, through stacks of
any height; what rested on a thing that goes comes down to where that one stood.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from models.semantic_reasoner.replies.checks import name_faults
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, layout_names, layout_objects
from stable_data.errors import SceneError
from stable_data.scene import TABLE, Relation, Scene, SceneObject, Vec3
from stable_data.scene_graph.relations import supports
from stable_data.scene_graph.staging import generation_order

_ARTICLES = frozenset(("a", "an", "the", "some"))


@dataclass(frozen=True, slots=True, eq=False)
class EditPrompt:
    """A scene as it is shown to a model that is to edit it.

    Attributes:
        scene: The scene; supports of its objects where they are known.
        layout: Its objects in the order of generation, in the words of a layout.
        names: Instance -> its name in the layout.
    """

    scene: Scene
    layout: tuple[LayoutObject, ...]
    names: Mapping[str, str]

    def ask(self, instruction: str) -> ReasonerQuestion:
        """What a model is asked."""
        return ReasonerQuestion(instruction, self.scene.table, "edit", self.layout)


def edit_prompt_of(scene: Scene) -> EditPrompt:
    """A scene to be edited.

    Raises:
        SceneError: Its supports form a cycle (``support_circle``).
    """
    objects = generation_order(scene.scene_id, scene.objects)
    names = layout_names(objects)
    return EditPrompt(scene, layout_objects(objects, names), MappingProxyType(names))


@dataclass(frozen=True, slots=True, eq=False)
class EditResult:
    """What became of a scene.

    Attributes:
        scene: The scene after the edit; objects that are new, or whose words or size are others, have no asset, or no scale,
            yet.
        added: Instances that are new.
        changed: Instances that the reply changes.
        carried: Instances that moved with what carries them.
        removed: Instances that are gone.
        wanting: Instances that want an asset: new ones, and those whose words are others.
    """

    scene: Scene
    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    carried: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    wanting: tuple[str, ...] = ()

    @property
    def untouched(self) -> frozenset[str]:
        """Instances that are as they were."""
        return frozenset(o.instance for o in self.scene.objects) - {*self.added, *self.changed, *self.carried}

    @property
    def kind(self) -> str:
        """``add``, ``remove``, ``replace``, ``move``, ``restyle``; ``none`` or ``mixed`` where it is not one of them."""
        if self.changed:
            if self.added or self.removed:
                return "mixed"
            return "restyle" if set(self.changed) & set(self.wanting) else "move"
        return {(0, 0): "none", (1, 0): "add", (0, 1): "remove"}.get((bool(self.added), bool(self.removed)), "replace")


def apply_edit(edited: EditPrompt | Scene, reply: LayoutReply) -> EditResult:
    """Carries out a reply to an edit.

    Args:
        edited: The scene that it was asked about.
        reply: The reply, in the names of the layout.

    Returns:
        The scene as the reply wants it, neither checked for collisions nor corrected. A reply that changes nothing gives the
        scene itself.

    Raises:
        SceneError: The reply cannot be meant (``edit_refused``); the message says why, for a model or a person to act on.
    """
    shown = edit_prompt_of(edited) if isinstance(edited, Scene) else edited
    return _Change(shown, reply).carried_out()


class _Change:
    """A reply being carried out."""

    def __init__(self, shown: EditPrompt, reply: LayoutReply) -> None:
        refused = next(name_faults(reply.objects, reply.removed, shown.ask("")), None)
        if refused is not None:
            raise SceneError(refused.message, "edit_refused")
        self.scene, self.reply = shown.scene, reply
        self.instances = {name: instance for instance, name in shown.names.items()}
        self.was = {o.instance: o for o in shown.layout}
        self.removed = {self.instances[name] for name in reply.removed}
        self.listed = {self.instances[o.instance]: o for o in reply.objects if o.instance in self.instances}
        self.done: dict[str, SceneObject] = {}

    def carried_out(self) -> EditResult:
        for o in generation_order(self.scene.scene_id, self.scene.objects):  # carriers come first
            self.done[o.instance] = self._after(o)
        kept = tuple(self.done[o.instance] for o in self.scene.objects if o.instance not in self.removed)
        new = self._new()
        before = {o.instance: o for o in self.scene.objects}
        touched = {o.instance for o in kept if o is not before[o.instance]}
        if not (touched or new or self.removed):
            return EditResult(self.scene)
        changed = tuple(o.instance for o in kept if o.instance in touched and o.instance in self.listed)
        reworded = {name for name in changed if self._is_reworded(self.listed[name])}
        after = self._supported((*kept, *new), {*changed, *(o.instance for o in new)})
        return EditResult(
            replace(self.scene, objects=after, relations=self._relations(touched)),
            added=tuple(o.instance for o in new),
            changed=changed,
            carried=tuple(o.instance for o in kept if o.instance in touched and o.instance not in self.listed),
            removed=tuple(o.instance for o in self.scene.objects if o.instance in self.removed),
            wanting=(*(name for name in changed if name in reworded), *(o.instance for o in new)),
        )

    def _after(self, o: SceneObject) -> SceneObject:
        """An object after the edit; the object itself where it is as it was."""
        if o.instance in self.listed:
            return self._changed(o, self.listed[o.instance])
        carrier = self.done.get(o.support or "")
        if carrier is None:
            return o
        was = self.scene[carrier.instance]
        along = o if carrier is was else self._along(o, was, carrier)
        if carrier.instance not in self.removed:
            return along
        x, y, _ = along.position
        return along.moved((x, y, min(along.bottom, carrier.bottom) + o.size[2] / 2), along.yaw)

    def _changed(self, o: SceneObject, wanted: LayoutObject) -> SceneObject:
        """An object as the reply has it; numbers that the reply repeats stay as they are, the height of its underside likewise."""
        shown = self.was[wanted.instance]
        position, size = (
            _triple(old if said == was else said / 100 for old, was, said in zip(exact, before, after, strict=True))
            for exact, before, after in (
                (o.position, shown.position_cm, wanted.position_cm),
                (o.size, shown.size_cm, wanted.size_cm),
            )
        )
        if size[2] != o.size[2] and position[2] == o.position[2]:
            position = (*position[:2], o.bottom + size[2] / 2)  # what is higher or lower stands where it stood
        yaw = o.yaw if wanted.z_rotation_deg == shown.z_rotation_deg else math.radians(wanted.z_rotation_deg)
        if self._is_reworded(wanted):
            return replace(o, position=position, yaw=yaw, size=size, description=wanted.description, asset_id=None, scale=None)
        if size != o.size:
            return replace(o, position=position, yaw=yaw, size=size, scale=None)  # the same mesh, fitted to the new size
        return o if (position, yaw) == (o.position, o.yaw) else o.moved(position, yaw)

    def _is_reworded(self, wanted: LayoutObject) -> bool:
        return _words(wanted.description) != _words(self.was[wanted.instance].description)

    def _along(self, o: SceneObject, was: SceneObject, now: SceneObject) -> SceneObject:
        """What rests on a thing, where it is once that thing is elsewhere or another: over the same spot, as high in it or on it."""
        turn = now.yaw - was.yaw
        dx, dy = o.position[0] - was.position[0], o.position[1] - was.position[1]
        c, s = math.cos(turn), math.sin(turn)
        above = o.bottom - was.bottom
        if above >= was.size[2] > 0:
            above += now.size[2] - was.size[2]
        elif above > 0:
            above *= now.size[2] / was.size[2]
        x, y = now.position[0] + c * dx - s * dy, now.position[1] + s * dx + c * dy
        yaw = math.remainder(o.yaw + turn, 2 * math.pi) if turn else o.yaw
        return o.moved((x, y, now.bottom + above + o.size[2] / 2), yaw)

    def _new(self) -> tuple[SceneObject, ...]:
        """What the reply adds, under names in the form of the scene's."""
        found: list[SceneObject] = []
        for o in self.reply.objects:
            if o.instance not in self.instances:
                here = (*self.scene.objects, *found)
                found.append(replace(o.to_scene_object(), instance=_instance(o.category, here)))
        return tuple(found)

    def _supported(self, objects: tuple[SceneObject, ...], elsewhere: set[str]) -> tuple[SceneObject, ...]:
        """The objects with what carries them now, by their boxes where that may be another thing than before."""
        names = {o.instance for o in objects} | {TABLE}
        same = {o.instance for o in objects if o.instance not in elsewhere and o.support in {*names, None}}
        contacts = {o.instance: (o.support,) for o in objects if o.instance in same and o.support is not None}
        carriers = supports(replace(self.scene, objects=objects, relations=()), contacts)
        return tuple(o if o.instance in same else replace(o, support=carriers[o.instance]) for o in objects)

    def _relations(self, touched: set[str]) -> tuple[Relation, ...]:
        """The relations that are asked for, without those of things that the edit has to do with."""
        gone = {*touched, *self.removed}
        return tuple(r for r in self.scene.relations if gone.isdisjoint((*r.subject.split(", "), r.target)))


def _instance(category: str, objects: Sequence[SceneObject]) -> str:
    """``<k>_<category>_<n>``, the next number of each that is free."""
    names = [o.instance for o in objects]
    first = 1 + max(
        (int(head) for head, _, _ in (name.partition("_") for name in names) if head.isdecimal()), default=len(names)
    )
    pattern = re.compile(rf"(?:\d+_)?{re.escape(category)}_(\d+)")
    used = [int(match[1]) for match in map(pattern.fullmatch, names) if match]
    return f"{first}_{category}_{1 + max(used, default=-1)}"


def _words(description: str) -> tuple[str, ...]:
    """The words of a description, articles left out."""
    return tuple(word for word in re.findall(r"\w+", description.casefold()) if word not in _ARTICLES)


def _triple(values: Iterable[float]) -> Vec3:
    x, y, z = values
    return x, y, z
