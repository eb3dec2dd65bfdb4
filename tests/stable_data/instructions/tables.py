"""Hand-made tables, together rich enough for every kind of task."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from stable_data.instructions.kind import TaskDraft
from stable_data.instructions.naming import ObjectNamer
from stable_data.instructions.situation import TaskContext
from stable_data.scene import UPRIGHT, QuatXyzw, Scene, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import SceneGraph, scene_graph

LYING: QuatXyzw = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


@dataclass(frozen=True)
class Thing:
    """An object in short: its category with a number, where its bottom is, its size."""

    name: str
    x: float
    y: float
    size: Vec3
    z: float = 0.0
    words: str = ""
    yaw: float = 0.0
    tilt: QuatXyzw = UPRIGHT
    container: bool = False

    @property
    def category(self) -> str:
        return self.name.rsplit("_", 1)[0]


@dataclass(frozen=True)
class Table:
    """A scene and its graph."""

    scene: Scene
    graph: SceneGraph

    def situation(self, rng: np.random.Generator) -> TaskContext:
        names = [o.instance for o in self.scene.objects]
        return TaskContext(self.scene, self.graph, rng, names, [n for n in names if self.namer.names(n)])

    @property
    def namer(self) -> ObjectNamer:
        return ObjectNamer(self.scene, self.graph)

    def instance(self, name: str) -> str:
        return next(o.instance for o in self.scene.objects if o.instance.split("_", 1)[1] == name)

    def words(self, name: str) -> list[str]:
        return [n.words for n in self.namer.names(self.instance(name))]


def table(scene_id: str, things: Iterable[Thing], size: tuple[float, float] = (1.4, 0.8)) -> Table:
    things = list(things)
    objects = tuple(
        SceneObject(
            f"{k}_{t.name}", t.category, (t.x, t.y, t.z + t.size[2] / 2), t.yaw, t.size, asset_id="a" * 32,
            tilt_quat_xyzw=t.tilt, description=t.words,
        )
        for k, t in enumerate(things, 1)
    )  # fmt: skip
    scene = Scene(scene_id, Tabletop(scene_id, size), objects)
    flags = {o.instance: t.container for o, t in zip(objects, things, strict=True)}
    return Table(scene, scene_graph(scene, {}, containers=flags))


PLATE, MUG, FORK, KNIFE = (0.22, 0.22, 0.02), (0.08, 0.08, 0.09), (0.02, 0.18, 0.015), (0.02, 0.2, 0.012)
PEN, BOOK, TRAY, BOX = (0.01, 0.14, 0.01), (0.14, 0.2, 0.03), (0.4, 0.3, 0.04), (0.3, 0.25, 0.15)

DINING = table(
    "dining_table",
    [
        Thing("plate_0", 0.35, 0.3, PLATE),
        Thing("plate_1", 1.05, 0.3, PLATE),
        Thing("fork_0", 0.6, 0.1, FORK),
        Thing("fork_1", 0.66, 0.1, FORK),
        Thing("table_knife_0", 0.72, 0.3, KNIFE),
        Thing("spoon_0", 0.78, 0.12, FORK),
        Thing("wine_glass_0", 0.6, 0.45, (0.07, 0.07, 0.15)),
        Thing("bottle_0", 0.1, 0.7, (0.07, 0.07, 0.28)),
        Thing("soup_bowl_0", 0.3, 0.68, (0.16, 0.16, 0.06), container=True),
        Thing("bread_0", 0.8, 0.5, (0.1, 0.08, 0.06)),
        Thing("basket_0", 1.2, 0.65, (0.3, 0.24, 0.12), container=True),
        Thing("mug_0", 0.9, 0.1, MUG, words="a tall red mug with a white rim", container=True),
        Thing("mug_1", 0.95, 0.72, (0.08, 0.08, 0.08), words="small blue mug", container=True),
        Thing("saucer_0", 0.55, 0.68, (0.14, 0.14, 0.02)),
    ],
)

DESK = table(
    "office_table",
    [
        Thing("laptop_0", 0.6, 0.4, (0.33, 0.23, 0.02)),
        Thing("phone_0", 0.6, 0.4, (0.07, 0.14, 0.01), z=0.02),
        Thing("pen_holder_0", 0.2, 0.65, (0.09, 0.09, 0.1), container=True),
        Thing("pen_0", 0.3, 0.15, PEN, words="blue ballpoint pen"),
        Thing("pen_1", 0.4, 0.12, PEN, words="red ballpoint pen"),
        Thing("pencil_0", 0.5, 0.13, PEN),
        Thing("desk_lamp_0", 1.2, 0.68, (0.15, 0.15, 0.4), yaw=1.6),
        Thing("calculator_0", 0.8, 0.12, (0.08, 0.14, 0.02)),
        Thing("photo_frame_0", 1.0, 0.6, (0.12, 0.05, 0.16), yaw=2.0),
        Thing("book_0", 1.2, 0.3, BOOK),
        Thing("magazine_0", 1.2, 0.3, BOOK, z=0.03),
        Thing("storage_box_0", 0.15, 0.35, (0.2, 0.2, 0.15), container=True),
        Thing("potted_plant_0", 0.4, 0.7, (0.12, 0.12, 0.2)),
        Thing("stapler_0", 1.37, 0.6, (0.04, 0.13, 0.05)),
    ],
)

SHELF = table(
    "coffee_table",
    [
        Thing("book_0", 0.2, 0.3, (0.14, 0.2, 0.03)),
        Thing("book_1", 0.5, 0.6, (0.13, 0.19, 0.025)),
        Thing("book_2", 0.9, 0.3, (0.15, 0.22, 0.04)),
        Thing("laptop_0", 1.15, 0.55, (0.33, 0.25, 0.22)),
        Thing("pitcher_0", 0.25, 0.65, (0.11, 0.11, 0.2)),
        Thing("potted_plant_0", 0.7, 0.7, (0.12, 0.12, 0.2)),
        Thing("candle_0", 0.6, 0.2, (0.06, 0.06, 0.09)),
        Thing("bottle_0", 0.7, 0.45, (0.07, 0.25, 0.07), tilt=LYING),
        Thing("jewelry_box_0", 0.38, 0.15, (0.12, 0.1, 0.07)),
        Thing("lunch_box_0", 1.25, 0.15, (0.18, 0.12, 0.07)),
        Thing("key_0", 1.25, 0.15, (0.05, 0.02, 0.01), z=0.07),
    ],
)

KITCHEN = table(
    "kitchen_counter",
    [
        Thing("cutting_board_0", 0.5, 0.35, (0.35, 0.22, 0.02)),
        Thing("kitchen_knife_0", 1.0, 0.15, (0.03, 0.25, 0.015)),
        Thing("apple_0", 0.8, 0.35, (0.07, 0.07, 0.07)),
        Thing("orange_0", 0.95, 0.5, (0.075, 0.075, 0.075)),
        Thing("lemon_0", 0.2, 0.15, (0.06, 0.08, 0.06)),
        Thing("fruit_bowl_0", 0.2, 0.6, (0.26, 0.26, 0.1), container=True),
        Thing("cooking_pot_0", 1.25, 0.6, (0.22, 0.22, 0.14), container=True),
        Thing("pot_lid_0", 1.2, 0.25, (0.23, 0.23, 0.05)),
        Thing("serving_tray_0", 0.65, 0.65, TRAY),
        Thing("can_0", 0.55, 0.65, (0.07, 0.07, 0.1), z=0.04),
        Thing("jar_0", 0.75, 0.65, (0.07, 0.07, 0.1), z=0.04),
        Thing("saucer_0", 0.2, 0.32, (0.14, 0.14, 0.02)),
    ],
)

VANITY = table(
    "bathroom_vanity",
    [
        Thing("soap_0", 0.3, 0.2, (0.08, 0.05, 0.03)),
        Thing("soap_dish_0", 0.5, 0.4, (0.12, 0.09, 0.025)),
        Thing("soap_dispenser_0", 0.9, 0.6, (0.07, 0.07, 0.18)),
        Thing("toothbrush_0", 0.8, 0.2, (0.015, 0.18, 0.015)),
        Thing("toothbrush_cup_0", 1.1, 0.6, (0.08, 0.08, 0.1), container=True),
        Thing("lipstick_0", 0.65, 0.15, (0.02, 0.02, 0.08)),
        Thing("comb_0", 0.45, 0.15, (0.03, 0.15, 0.005)),
        Thing("basket_0", 0.2, 0.6, (0.3, 0.24, 0.12), container=True),
        Thing("storage_box_0", 1.2, 0.25, (0.25, 0.25, 0.12), container=True),
        Thing("towel_0", 1.15, 0.22, (0.08, 0.06, 0.04), z=0.005),
        Thing("sponge_0", 1.24, 0.28, (0.06, 0.06, 0.05), z=0.005),
    ],
)

PLAYROOM = table(
    "coffee_table",
    [
        Thing("toy_box_0", 0.2, 0.55, BOX, container=True),
        Thing("toy_box_1", 1.2, 0.55, (0.28, 0.24, 0.16), container=True),
        Thing("duck_0", 0.5, 0.2, (0.06, 0.07, 0.06)),
        Thing("duck_1", 0.95, 0.25, (0.06, 0.07, 0.06)),
        Thing("dice_0", 0.75, 0.35, (0.03, 0.03, 0.03)),
        Thing("dice_1", 0.65, 0.62, (0.03, 0.03, 0.03)),
        Thing("duck_2", 0.6, 0.45, (0.09, 0.1, 0.09)),
    ],
)

STACKS = table(
    "dining_table",
    [
        Thing("plate_0", 0.2, 0.2, PLATE),
        Thing("plate_1", 0.2, 0.2, PLATE, z=0.02),
        Thing("napkin_0", 0.7, 0.3, (0.2, 0.2, 0.02)),
        Thing("cookie_0", 0.7, 0.3, (0.06, 0.06, 0.02), z=0.02),
        Thing("plate_2", 1.1, 0.55, PLATE),
        Thing("tray_0", 0.5, 0.62, TRAY),
        Thing("cake_0", 1.2, 0.2, (0.08, 0.08, 0.06)),
        Thing("mug_0", 0.4, 0.3, MUG, container=True),
        Thing("mug_1", 0.9, 0.6, MUG, container=True),
    ],
)

TABLES = (DINING, DESK, SHELF, KITCHEN, VANITY, PLAYROOM, STACKS)


def told_somewhere(kind_name: str) -> list[tuple[Table, TaskDraft]]:
    """What a kind of task tells of these tables, over several draws."""
    from stable_data.instructions.deriving import KINDS

    kind = next(k for k in KINDS if k.name == kind_name)
    draws = ((t, kind.draft(t.situation(np.random.default_rng(seed)), t.namer)) for t in TABLES for seed in range(8))
    return [(t, told) for t, told in draws if told is not None]
