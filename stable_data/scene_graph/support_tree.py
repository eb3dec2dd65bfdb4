"""Supports of a scene as a tree: traversal along the supports, up or down, and detection of cycles."""

from collections.abc import Hashable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import TypeVar

from stable_data.errors import SceneError
from stable_data.scene import SceneObject

Node = TypeVar("Node", bound=Hashable)


def ancestors(parents: Mapping[Node, Node | None], node: Node) -> Iterator[Node]:
    """Yields the supports of a node, direct and indirect, nearest first.

    Args:
        parents: Node -> its support. The mapping may be incomplete. A value that is not a key, such as the table or None, is
            not a node and ends the traversal. A cycle ends it before it would return to a node.
        node: The start; it is not part of the result.
    """
    seen = {node}
    above = parents.get(node)
    while above is not None and above in parents and above not in seen:
        yield above
        seen.add(above)
        above = parents[above]


class SupportTree:
    """The supports of some objects, as a tree for each object that no other object of them supports.

    Args:
        supports: Instance -> its support. A support that is not an instance of the mapping (``table``, None, an object that is
            left out) makes the instance a root.
        scene_id: The scene, for errors.
    """

    def __init__(self, supports: Mapping[str, str | None], scene_id: str = "") -> None:
        self._scene_id = scene_id
        self._parents = {name: parent if parent in supports else None for name, parent in supports.items()}
        self._children: dict[str | None, list[str]] = {}
        for name, parent in self._parents.items():
            self._children.setdefault(parent, []).append(name)

    @classmethod
    def of(cls, objects: Iterable[SceneObject], scene_id: str = "") -> "SupportTree":
        """The tree of objects, by their ``support``."""
        return cls({o.instance: o.support for o in objects}, scene_id)

    def parent(self, instance: str) -> str | None:
        """The object that supports an object directly; None for a root."""
        return self._parents[instance]

    def children(self, instance: str | None) -> tuple[str, ...]:
        """The objects that an object supports directly, in the given order; the roots for None."""
        return tuple(self._children.get(instance, ()))

    def ancestors(self, instance: str) -> Iterator[str]:
        """The objects that support an object, directly and through others, nearest first."""
        return ancestors(self._parents, instance)

    def root(self, instance: str) -> str:
        """The lowest object below an object, or the object itself."""
        return [instance, *self.ancestors(instance)][-1]

    def with_descendants(self, instances: AbstractSet[str]) -> set[str]:
        """Some objects and all that they support, directly or indirectly. An instance that is not in the tree supports none."""
        members, waiting = set(instances), list(instances)
        while waiting:
            new = [child for child in self.children(waiting.pop()) if child not in members]
            members.update(new)
            waiting += new
        return members

    def bottom_up(self) -> tuple[str, ...]:
        """All objects, each one before the objects that it supports; its reverse is the order from the top down.

        Each object is followed at once by the objects that it supports. Roots, and objects with the same parent, keep the given
        order.

        Raises:
            SceneError: Supports form a cycle (``support_circle``).
        """
        ordered: list[str] = []
        waiting = list(self.children(None))[::-1]
        while waiting:
            ordered.append(waiting.pop())
            waiting += self.children(ordered[-1])[::-1]
        if len(ordered) < len(self._parents):  # no root leads to the objects of a cycle
            first = next(name for name in self._parents if name not in set(ordered))
            walk = [first, *self.ancestors(first)]
            found = " -> ".join([*walk, str(self.parent(walk[-1]))])
            where = f"{self._scene_id}: " if self._scene_id else ""
            raise SceneError(f"{where}{found} form a cycle of supports; derive the supports again", "support_circle")
        return tuple(ordered)
