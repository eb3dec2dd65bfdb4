"""Edits of a layout: the question that asks for an edit, and the scene after the reply.

An object that the reply does not name keeps its pose exactly. An object that it names keeps every number that the reply
repeats, and its asset unless the description changes. Objects move with their support, through stacks of any height. The
objects on a removed object are lowered to the height of its underside.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from models.semantic_reasoner.replies.checks import name_faults
from models.semantic_reasoner.staged_layout import table_with_zone
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, layout_names, layout_objects
from stable_data.errors import SceneError
from stable_data.scene import TABLE, Relation, Scene, SceneObject, Vec3
from stable_data.scene_graph.relations import supports
from stable_data.scene_graph.stage_samples import generation_order

_ARTICLES = frozenset(("a", "an", "the", "some"))


@dataclass(frozen=True, slots=True, eq=False)
class EditPrompt:
    """A scene in the form in which a model reads it to edit it.

    Attributes:
        scene: The scene; its objects have their supports if these are known.
        layout: Its objects that are not fixed as layout objects, in the order of generation.
        names: Instance -> its name in the layout.
    """

    scene: Scene
    layout: tuple[LayoutObject, ...]
    names: Mapping[str, str]

    def question(self, instruction: str) -> ReasonerQuestion:
        """Returns the question that asks for an edit."""
        return ReasonerQuestion(instruction, table_with_zone(self.scene.table, self.scene.surroundings), "edit", self.layout)


def edit_prompt_of(scene: Scene) -> EditPrompt:
    """Returns the prompt of a scene.

    Raises:
        SceneError: Its supports form a cycle (``support_circle``).
    """
    objects = generation_order(scene.scene_id, scene.movable)
    names = layout_names(objects)
    return EditPrompt(scene, layout_objects(objects, names), MappingProxyType(names))


@dataclass(frozen=True, slots=True, eq=False)
class EditResult:
    """A scene after an edit.

    Attributes:
        scene: The scene after the edit. New objects and those with another description have no asset yet; those with another
            size have no scale yet.
        added: New instances.
        changed: Instances that the reply changes.
        carried: Instances that moved with their support.
        removed: Removed instances.
        need_asset: Instances that need an asset: new ones, and those with another description.
        wanted: Relations that shall hold afterwards; they are among those of the scene.
    """

    scene: Scene
    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    carried: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    need_asset: tuple[str, ...] = ()
    wanted: tuple[Relation, ...] = ()

    @property
    def untouched(self) -> frozenset[str]:
        """Instances that the edit does not change."""
        return frozenset(o.instance for o in self.scene.objects) - {*self.added, *self.changed, *self.carried}

    @property
    def kind(self) -> str:
        """``add``, ``remove``, ``replace``, ``move`` or ``restyle``; else ``none`` or ``mixed``."""
        if self.changed:
            if self.added or self.removed:
                return "mixed"
            return "restyle" if set(self.changed) & set(self.need_asset) else "move"
        return {(0, 0): "none", (1, 0): "add", (0, 1): "remove"}.get((bool(self.added), bool(self.removed)), "replace")


def apply_edit(edited: EditPrompt | Scene, reply: LayoutReply) -> EditResult:
    """Applies a reply to an edit.

    Args:
        edited: The scene, or its prompt.
        reply: The reply, with the names of the layout.

    Returns:
        The scene after the edit, neither checked for collisions nor corrected; the scene itself if the reply changes nothing.

    Raises:
        SceneError: The names of the reply contradict each other or the layout (``edit_refused``). The message states why, for
            a model or a person.
    """
    prompt = edit_prompt_of(edited) if isinstance(edited, Scene) else edited
    return _EditApplication(prompt, reply).result()


class _EditApplication:
    """The application of one reply to one scene."""

    def __init__(self, prompt: EditPrompt, reply: LayoutReply) -> None:
        fault = next(name_faults(reply.objects, reply.removed, prompt.question("")), None)
        if fault is not None:
            raise SceneError(fault.message, "edit_refused")
        self.scene, self.reply = prompt.scene, reply
        self.instances = {name: instance for instance, name in prompt.names.items()}
        self.layout = {o.instance: o for o in prompt.layout}
        self.removed = {self.instances[name] for name in reply.removed}
        self.listed = {self.instances[o.instance]: o for o in reply.objects if o.instance in self.instances}
        self.done: dict[str, SceneObject] = {}

    def result(self) -> EditResult:
        for o in generation_order(self.scene.scene_id, self.scene.objects):  # supports before the objects on them
            self.done[o.instance] = self._after(o)
        remaining = tuple(self.done[o.instance] for o in self.scene.objects if o.instance not in self.removed)
        new = self._new()
        before = {o.instance: o for o in self.scene.objects}
        touched = {o.instance for o in remaining if o is not before[o.instance]}
        if not (touched or new or self.removed):
            return EditResult(self.scene)
        changed = tuple(o.instance for o in remaining if o.instance in touched and o.instance in self.listed)
        after = self._with_supports((*remaining, *new), {*changed, *(o.instance for o in new)})
        wanted = tuple(self._in_scene(r) for r in self.reply.relations)
        return EditResult(
            replace(self.scene, objects=after, relations=(*wanted, *self._relations(touched))),
            added=tuple(o.instance for o in new),
            changed=changed,
            carried=tuple(o.instance for o in remaining if o.instance in touched and o.instance not in self.listed),
            removed=tuple(o.instance for o in self.scene.objects if o.instance in self.removed),
            need_asset=(*(name for name in changed if self._is_reworded(self.listed[name])), *(o.instance for o in new)),
            wanted=wanted,
        )

    def _after(self, o: SceneObject) -> SceneObject:
        """An object after the edit; the object itself if it does not change."""
        if o.instance in self.listed:
            return self._changed(o, self.listed[o.instance])
        carrier = self.done.get(o.support or "")
        if carrier is None:
            return o
        before = self.scene[carrier.instance]
        moved = o if carrier is before else self._moved_with(o, before, carrier)
        if carrier.instance not in self.removed:
            return moved
        x, y, _ = moved.position  # the support is removed: down to its underside, never up
        return moved.moved((x, y, min(moved.bottom, carrier.bottom) + o.size[2] / 2), moved.yaw)

    def _changed(self, o: SceneObject, wanted: LayoutObject) -> SceneObject:
        """An object with the reply's changes; numbers that the reply repeats, and the height of the underside, do not change."""
        shown = self.layout[wanted.instance]
        # The layout has rounded numbers: a number that the reply repeats stands for the exact one.
        position, size = (
            _triple(old if new == rounded else new / 100 for old, rounded, new in zip(exact, before, after, strict=True))
            for exact, before, after in (
                (o.position, shown.position_cm, wanted.position_cm),
                (o.size, shown.size_cm, wanted.size_cm),
            )
        )
        if size[2] != o.size[2] and position[2] == o.position[2]:
            position = (*position[:2], o.bottom + size[2] / 2)  # another height does not lift or sink the underside
        yaw = o.yaw if wanted.z_rotation_deg == shown.z_rotation_deg else math.radians(wanted.z_rotation_deg)
        if self._is_reworded(wanted):
            return replace(o, position=position, yaw=yaw, size=size, description=wanted.description, asset_id=None, scale=None)
        if size != o.size:
            return replace(o, position=position, yaw=yaw, size=size, scale=None)  # the same mesh, fitted to the new size
        return o if (position, yaw) == (o.position, o.yaw) else o.moved(position, yaw)

    def _is_reworded(self, wanted: LayoutObject) -> bool:
        return _words(wanted.description) != _words(self.layout[wanted.instance].description)

    def _moved_with(self, o: SceneObject, was: SceneObject, now: SceneObject) -> SceneObject:
        """An object on or in a support that changes: over the same spot of it, at the same relative height in it or on it."""
        turn = now.yaw - was.yaw
        dx, dy = o.position[0] - was.position[0], o.position[1] - was.position[1]
        c, s = math.cos(turn), math.sin(turn)
        above = o.bottom - was.bottom
        # On top of the support the distance from its top is unchanged; inside it the height is scaled.
        if above >= was.size[2] > 0:
            above += now.size[2] - was.size[2]
        elif above > 0:
            above *= now.size[2] / was.size[2]
        x, y = now.position[0] + c * dx - s * dy, now.position[1] + s * dx + c * dy
        yaw = math.remainder(o.yaw + turn, 2 * math.pi) if turn else o.yaw
        return o.moved((x, y, now.bottom + above + o.size[2] / 2), yaw)

    def _new(self) -> tuple[SceneObject, ...]:
        """The objects that the reply adds, under instance names in the form of the scene's."""
        found: list[SceneObject] = []
        for o in self.reply.objects:
            if o.instance not in self.instances:
                here = (*self.scene.objects, *found)
                found.append(replace(o.to_scene_object(), instance=_instance(o.category, here)))
                self.instances[o.instance] = found[-1].instance
        return tuple(found)

    def _with_supports(self, objects: tuple[SceneObject, ...], moved: set[str]) -> tuple[SceneObject, ...]:
        """The objects with their supports, inferred from boxes for objects that moved or whose support is removed."""
        names = {o.instance for o in objects} | {TABLE}
        same = {o.instance for o in objects if o.instance not in moved and o.support in {*names, None}}
        contacts = {o.instance: (o.support,) for o in objects if o.instance in same and o.support is not None}
        carriers = supports(replace(self.scene, objects=objects, relations=()), contacts)
        return tuple(o if o.instance in same else replace(o, support=carriers[o.instance]) for o in objects)

    def _in_scene(self, r: Relation) -> Relation:
        """A relation of the reply with the scene's instances."""
        return replace(r, subject=self.instances[r.subject], target=self.instances.get(r.target, r.target))

    def _relations(self, touched: set[str]) -> tuple[Relation, ...]:
        """The requested relations of the scene, without those of objects that the edit moves, changes or removes."""
        gone = {*touched, *self.removed}
        return tuple(r for r in self.scene.relations if gone.isdisjoint((*r.subject.split(", "), r.target)))


def _instance(category: str, objects: Sequence[SceneObject]) -> str:
    """``<k>_<category>_<n>`` with the next free numbers."""
    names = [o.instance for o in objects]
    # The largest leading number plus one: gaps of removed objects are not used again.
    first = 1 + max(
        (int(head) for head, _, _ in (name.partition("_") for name in names) if head.isdecimal()), default=len(names)
    )
    pattern = re.compile(rf"(?:\d+_)?{re.escape(category)}_(\d+)")
    used = [int(match[1]) for match in map(pattern.fullmatch, names) if match]
    return f"{first}_{category}_{1 + max(used, default=-1)}"


def _words(description: str) -> tuple[str, ...]:
    """The words of a description without articles, casefolded."""
    return tuple(word for word in re.findall(r"\w+", description.casefold()) if word not in _ARTICLES)


def _triple(values: Iterable[float]) -> Vec3:
    x, y, z = values
    return x, y, z
