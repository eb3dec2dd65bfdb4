"""Who supports whom: the one place that walks along the supports of a scene, up or down, and finds circles among them."""

from collections.abc import Hashable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import TypeVar

from stable_data.errors import SceneError
from stable_data.scene import SceneObject

Node = TypeVar("Node", bound=Hashable)


def ancestors(parents: Mapping[Node, Node | None], node: Node) -> Iterator[Node]:
    """What carries a node, directly and through others, nearest first.

    Args:
        parents: Node -> what carries it. The mapping may still be growing. A value that is not a key, such as the table or
            None, is not a node and ends the walk. A circle ends the walk where it would come back to a node.
        node: Where the walk starts; it is not part of the result.
    """
    seen = {node}
    above = parents.get(node)
    while above is not None and above in parents and above not in seen:
        yield above
        seen.add(above)
        above = parents[above]


class SupportTree:
    """The supports of some objects, as a tree for each object that no other object of them carries.

    Args:
        supports: Instance -> what carries it. A support that is not an instance of the mapping (``table``, None, an object
            that is left out) makes the instance a root.
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
        """The object that carries an object directly; None for a root."""
        return self._parents[instance]

    def children(self, instance: str | None) -> tuple[str, ...]:
        """The objects that an object carries directly, in the given order; the roots for None."""
        return tuple(self._children.get(instance, ()))

    def ancestors(self, instance: str) -> Iterator[str]:
        """The objects that carry an object, directly and through others, nearest first."""
        return ancestors(self._parents, instance)

    def root(self, instance: str) -> str:
        """The lowest object below an object, or the object itself."""
        return [instance, *self.ancestors(instance)][-1]

    def with_descendants(self, instances: AbstractSet[str]) -> set[str]:
        """Some objects and all that they carry, directly and through others. What is no object of the tree carries nothing."""
        members, waiting = set(instances), list(instances)
        while waiting:
            new = [child for child in self.children(waiting.pop()) if child not in members]
            members.update(new)
            waiting += new
        return members

    def bottom_up(self) -> tuple[str, ...]:
        """All objects, each one before the objects that it carries; its reverse is the order from the top down.

        Each object is followed at once by what it carries. Roots, and objects with the same parent, keep the given order.

        Raises:
            SceneError: Supports form a cycle (``support_circle``).
        """
        ordered: list[str] = []
        waiting = list(self.children(None))[::-1]
        while waiting:
            ordered.append(waiting.pop())
            waiting += self.children(ordered[-1])[::-1]
        if len(ordered) < len(self._parents):
            first = next(name for name in self._parents if name not in set(ordered))
            walk = [first, *self.ancestors(first)]
            found = " -> ".join([*walk, str(self.parent(walk[-1]))])
            where = f"{self._scene_id}: " if self._scene_id else ""
            raise SceneError(f"{where}{found} form a cycle of supports; derive the supports again", "support_circle")
        return tuple(ordered)
