"""Scenes of boxes for the tests of taste."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3

CUBE = (0.1, 0.1, 0.1)


def thing(name: str, x: float, y: float, size: Vec3 = CUBE, yaw: float = 0.0) -> SceneObject:
    return SceneObject(name, name.rpartition("_")[0], (x, y, size[2] / 2), math.radians(yaw), size)


def scene_of(*objects: SceneObject, relations: Sequence[tuple[str, RelationKind, str]] = (), kind: str = "desk") -> Scene:
    carried = [subject for subject, _, _ in relations]
    on_table = [(o.instance, RelationKind.ON, TABLE) for o in objects if o.instance not in carried]
    table = Tabletop(kind, (1.2, 0.6))
    return Scene("one", table, objects, relations=tuple(Relation(*r) for r in [*on_table, *relations]))


def scenes(count: int, kind: str = "desk", scale: float = 1.0) -> list[Scene]:
    """Scenes of one to four mugs and a book of varied sizes at varied places."""
    rng = np.random.default_rng(7)
    found = []
    for k in range(count):
        names = [*(f"mug_{n}" for n in range(1 + k % 4)), "book_0"]
        sides = [scale * float(rng.uniform(0.02, 0.06)) for _ in names]
        places = [(0.15 + 0.2 * n + float(rng.uniform(0, 0.1)), float(rng.uniform(0.1, 0.5))) for n in range(len(names))]
        things = [thing(o, *p, (s, s, s), float(rng.uniform(0, 90))) for o, p, s in zip(names, places, sides, strict=True)]
        found.append(replace(scene_of(*things, kind=kind), scene_id=f"{kind}_{k}"))
    return found
