"""A small world whose statistics are known by calculation, and layouts on its tables."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.text.prompt import ReasonerQuestion, Wanted
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.scene import Rectangle, Stage, Tabletop, Vec3

SIZES_CM: dict[str, Vec3] = {
    "mug": (11.0, 8.0, 9.5),
    "plate": (26.0, 26.0, 2.0),
    "cup": (8.0, 8.0, 8.0),
    "teacup": (10.0, 8.0, 6.0),
    "can": (7.0, 7.0, 11.0),
    "soda_can": (6.5, 6.5, 12.0),
    "spice_jar": (5.0, 5.0, 9.0),
    "serving_tray": (40.0, 30.0, 4.0),
    "cutting_board": (35.0, 22.0, 1.5),
    "laptop": (33.0, 23.0, 22.0),
    "pen": (14.0, 1.0, 1.0),
    "pen_holder": (8.0, 8.0, 11.0),
    "table_knife": (22.0, 2.0, 1.0),
    "butter_knife": (16.0, 2.0, 1.0),
    "wine_glass": (8.0, 8.0, 20.0),
    "drinking_glass": (7.0, 7.0, 12.0),
    "pitcher": (16.0, 11.0, 24.0),
    "orange": (8.0, 8.0, 8.0),
    "apple": (8.0, 8.0, 8.0),
    "camera": (12.0, 8.0, 8.0),
    "cake_stand": (25.0, 25.0, 12.0),
    "scissors": (18.0, 7.0, 1.5),
    "cookie": (6.0, 6.0, 1.2),
    "napkin": (20.0, 20.0, 0.5),
    "wooden_blocks": (20.0, 15.0, 6.0),
}
_TOLD = (
    "Move the mug next to the plate.",
    "Put the red mug on the cutting board and the blue one in the sink.",
    "Take the leftmost can of soup out of the large wooden tray that is on the left.",
    "Please hand me the white cup behind the laptop, then get the pen.",
)


def row(stage: Stage, scene_id: str, task: str, objects_out: Iterable[dict[str, Any]], split: str = "train") -> dict[str, Any]:
    """A row of ``samples``, with no objects of earlier stages."""
    return {
        "scene_id": scene_id,
        "split": split,
        "table_type": "office_table",
        "table_size": [1.2, 0.6],
        "restricted_zone": None,
        "task": {"task": task},
        "stage": str(stage),
        "objects_in": [],
        "objects_out": list(objects_out),
    }


def entry(category: str, size: Vec3, instance: str = "", support: str = "table", description: str = "") -> dict[str, Any]:
    """An object of such a row, metres."""
    return {
        "instance": instance or f"0_{category}_0",
        "category": category,
        "description": description or f"a {category.replace('_', ' ')}",
        "asset_id": None,
        "position": [0.5, 0.3, size[2] / 2],
        "yaw": 0.0,
        "tilt_quat_xyzw": [0.0, 0.0, 0.0, 1.0],
        "scale": None,
        "size": list(size),
        "stage": None,
        "support": support,
    }


def in_metres(size_cm: Vec3) -> Vec3:
    x, y, z = (v / 100 for v in size_cm)
    return x, y, z


def statistics() -> CategoryStatistics:
    """Forty scenes with one object of every category, 10 % smaller to 10 % larger."""
    rows = []
    for k in range(40):
        share = 0.9 + 0.2 * k / 39
        entries = [entry(c, in_metres((s[0] * share, s[1] * share, s[2] * share))) for c, s in SIZES_CM.items()]
        rows.append(row(Stage.SECONDARY, f"scene_{k}", "", entries))
    known = CategoryStatistics.of_rows(rows)
    told = CategoryStatistics.of_rows([row(Stage.TASK, "told", text, [entry("mug", (0.1, 0.1, 0.1))]) for text in _TOLD])
    return CategoryStatistics(known.categories, told.words)


STATISTICS = statistics()


@cache
def interpreter() -> InstructionInterpreter:
    """Interprets instructions for these categories."""
    return InstructionInterpreter(STATISTICS)


TABLE = Tabletop("office_table", (1.2, 0.6))


def thing(instance: str, x: float, y: float, bottom: float = 0.0, turned: int = 0, size: Vec3 | None = None) -> LayoutObject:
    """An object of the usual size at a place, centimetres, whose underside is so high."""
    size = size or SIZES_CM[instance.rpartition("_")[0]]
    words = instance.rpartition("_")[0].replace("_", " ")
    return LayoutObject(instance, f"a {words}", size, (x, y, round(bottom + size[2] / 2, 1)), turned)


def ask(
    instruction: str = "Move the mug next to the plate.",
    wanted: Wanted = Stage.TASK,
    layout: Iterable[LayoutObject] = (),
    size_xy: tuple[float, float] = (1.2, 0.6),
    zone: Rectangle | None = None,
    table_type: str = "office_table",
) -> ReasonerQuestion:
    return ReasonerQuestion(instruction, Tabletop(table_type, size_xy, zone), wanted, tuple(layout))
