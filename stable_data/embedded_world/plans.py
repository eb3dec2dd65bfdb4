"""Plans of the kinds of table: the themes of each kind and the other groups that may stand on it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

from stable_data.embedded_world.groups import bath, desk, dining, kitchen, lounge
from stable_data.embedded_world.groups.arrangement import Arrange, Group, GroupSampler
from stable_data.scene import Tabletop


@dataclass(frozen=True, slots=True)
class Slot:
    """A group and the region for it.

    Attributes:
        arrange: Draws the group.
        x: Lowest and highest position of its origin, shares of the width of the table.
        y: Lowest and highest position of its origin, shares of the depth of the table.
        yaw: Its yaw, radians.
    """

    arrange: Arrange
    x: tuple[float, float] = (0.05, 0.95)
    y: tuple[float, float] = (0.08, 0.92)
    yaw: float = 0.0


Theme: TypeAlias = Callable[[GroupSampler, Tabletop], Sequence[Slot]]
"""Draws the main groups of a table, the most important first."""


@dataclass(frozen=True, slots=True)
class TablePlan:
    """A kind of table.

    Attributes:
        width: Smallest and largest width, metres.
        depth: Smallest and largest depth, metres.
        themes: The possible themes, each drawn as often as it is listed.
        others: Groups that may stand beside the theme, each as often as it is listed.
        has_sink: Whether a rectangle in the middle stays free.
        density: Mean number of objects per square metre.
    """

    width: tuple[float, float]
    depth: tuple[float, float]
    themes: tuple[Theme, ...]
    others: tuple[Arrange, ...]
    has_sink: bool = False
    density: float = 19.0


def single(*categories: str, wobble: float = 0.4) -> Arrange:
    """Returns a function that draws a single item."""

    def arrange(kit: GroupSampler) -> Group:
        return [kit.single(*categories, wobble=wobble)]

    return arrange


_BACK, _FRONT, _MIDDLE = (0.68, 0.92), (0.08, 0.35), (0.35, 0.65)
_LEFT, _CENTRE, _RIGHT = (0.06, 0.32), (0.38, 0.62), (0.68, 0.94)
_SEAT = 0.19  # distance of the middle of a plate from the edge of the table, metres


def seats(kit: GroupSampler, table: Tabletop, most: int = 6) -> list[Slot]:
    """Slots for one to six place settings that face each other, as many as the table has room for."""
    width, depth = table.size_xy
    on_a_side = max(1, min(2, int(width / 0.52)))
    has_back, has_ends = depth > 0.68, width > 1.35 and depth > 0.7
    count = kit.count(1, min(most, on_a_side * (1 + has_back) + 2 * has_ends))
    spread = 0.25 if has_ends else 0.24
    front, back = _SEAT / depth, 1 - _SEAT / depth
    across = (0.5,) if on_a_side == 1 or count <= 1 + has_back else (0.5 - spread, 0.5 + spread)
    places = [(x, y, yaw) for x in across for y, yaw in (((front, 0.0), (back, math.pi)) if has_back else ((front, 0.0),))]
    if has_ends:
        places += [(_SEAT / width, 0.5, -math.pi / 2), (1 - _SEAT / width, 0.5, math.pi / 2)]
    return [_exact(dining.place_setting, x, y, yaw) for x, y, yaw in places[:count]]


def _exact(arrange: Arrange, x: float, y: float, yaw: float = 0.0) -> Slot:
    """A slot with little play."""
    return Slot(arrange, (x - 0.012, x + 0.012), (y - 0.012, y + 0.012), yaw)


def _meal(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    middle = kit.rng.permutation(5)
    dishes = (dining.fruit_bowl, dining.centrepiece, dining.wine, dining.bread_basket, dining.cake)
    spots = [*seats(kit, table), Slot(dishes[middle[0]], _CENTRE, (0.42, 0.58))]
    if kit.chance(0.6):
        spots.append(Slot(dining.salt_and_pepper, (0.3, 0.7), _MIDDLE))
    return [*spots, Slot(dishes[middle[1]], (0.25, 0.75), (0.3, 0.7))]


def _after_meal(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(dining.leftovers, (0.15, 0.45), _FRONT), Slot(dining.leftovers, (0.55, 0.85), _BACK, math.pi),
            Slot(dining.plates, _CENTRE, _MIDDLE), Slot(dining.wine, (0.2, 0.8), _MIDDLE), Slot(dining.glasses)]  # fmt: skip


def _tea(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(dining.tea_for_two, _CENTRE, _MIDDLE), Slot(dining.plate_of_sweets, (0.2, 0.8), (0.2, 0.8)),
            Slot(dining.centrepiece, (0.2, 0.8), _BACK), Slot(dining.napkins)]  # fmt: skip


def _buffet(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(dining.plates, _LEFT, _BACK), Slot(dining.glasses, _RIGHT, _BACK), Slot(dining.cake, _CENTRE, _MIDDLE),
            Slot(dining.fruit_bowl, (0.2, 0.8), _BACK), Slot(dining.cutlery, _LEFT, _FRONT), Slot(dining.napkins, _LEFT, _FRONT),
            Slot(dining.bread_basket)]  # fmt: skip


def _computer(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(desk.workstation, (0.3, 0.55), (0.66, 0.86)), Slot(desk.cup_of_pens, _RIGHT, _BACK),
            Slot(dining.mug_on_coaster, (0.1, 0.9), _FRONT), Slot(desk.books, _LEFT, (0.3, 0.9))]  # fmt: skip


def _laptop(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(desk.laptop, (0.35, 0.6), (0.3, 0.55)), Slot(desk.writing, (0.1, 0.9), _FRONT),
            Slot(single("desk_lamp"), (0.08, 0.25) if kit.chance(0.5) else (0.75, 0.92), _BACK),
            Slot(desk.cup_of_pens, (0.1, 0.9), _BACK)]  # fmt: skip


def _study(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(desk.writing, _CENTRE, (0.2, 0.45)), Slot(desk.standing_books, (0.2, 0.8), _BACK),
            Slot(single("desk_lamp"), _LEFT, _BACK), Slot(desk.mug_of_pens, (0.1, 0.9), (0.5, 0.9)),
            Slot(desk.books, (0.1, 0.9), (0.3, 0.8))]  # fmt: skip


def _paperwork(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(desk.papers, (0.3, 0.7), (0.2, 0.5)), Slot(desk.file_tray, _LEFT, _BACK), Slot(desk.office_bits, _RIGHT, _MIDDLE),
            Slot(desk.cup_of_pens, _RIGHT, _BACK), Slot(desk.boxes, (0.1, 0.9), _BACK)]  # fmt: skip


def _reading(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(lounge.magazines, (0.2, 0.5), _MIDDLE), Slot(dining.mug_on_coaster, (0.5, 0.9), _FRONT),
            Slot(lounge.candle_tray, (0.5, 0.8), _MIDDLE), Slot(lounge.remotes, (0.1, 0.9), _FRONT)]  # fmt: skip


def _coffee(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    first = dining.tea_tray if kit.chance(0.5) else dining.breakfast_tray
    return [Slot(first, (0.35, 0.65), _MIDDLE), Slot(dining.plate_of_sweets), Slot(desk.books, (0.1, 0.9), _BACK),
            Slot(lounge.decor, (0.1, 0.9), _BACK)]  # fmt: skip


def _playing(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(lounge.board_game, (0.3, 0.7), _MIDDLE), Slot(lounge.toys, (0.1, 0.9), _FRONT), Slot(lounge.blocks),
            Slot(lounge.toy_bin, (0.1, 0.9), _BACK), Slot(lounge.chess)]  # fmt: skip


def _cooking(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(kitchen.chopping, (0.3, 0.7), _FRONT), Slot(kitchen.pot, (0.1, 0.9), _BACK), Slot(kitchen.utensils, (0.05, 0.95), _BACK),
            Slot(kitchen.vegetables, (0.1, 0.9), (0.4, 0.9)), Slot(kitchen.jars, (0.1, 0.9), _BACK)]  # fmt: skip


def _baking(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(kitchen.mixing, (0.3, 0.7), (0.25, 0.6)), Slot(single("rolling_pin", wobble=0.5), (0.2, 0.8), _FRONT),
            Slot(kitchen.appliance, (0.1, 0.9), _BACK), Slot(kitchen.jars, (0.1, 0.9), _BACK), Slot(kitchen.bowls)]  # fmt: skip


def _pantry(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(kitchen.crate, (0.15, 0.4), _BACK), Slot(kitchen.jars, (0.4, 0.9), _BACK), Slot(kitchen.shopping, (0.3, 0.8), _MIDDLE),
            Slot(dining.fruit_bowl, (0.1, 0.9), _FRONT), Slot(kitchen.cans)]  # fmt: skip


def _breakfast(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(kitchen.appliance, (0.1, 0.9), _BACK), Slot(kitchen.bread_board, (0.25, 0.75), _FRONT),
            Slot(dining.breakfast_tray, (0.2, 0.8), _MIDDLE), Slot(kitchen.shopping, (0.1, 0.9), _BACK)]  # fmt: skip


def _vanity_row(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(bath.mirror, (0.4, 0.6), _BACK), Slot(bath.perfumes, (0.15, 0.85), _MIDDLE), Slot(bath.brushes, (0.05, 0.95), _BACK),
            Slot(bath.makeup, (0.2, 0.8), _FRONT), Slot(bath.jewelry, (0.05, 0.95), _MIDDLE)]  # fmt: skip


def _hairdressing(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(bath.mirror, (0.4, 0.6), _BACK), Slot(bath.hair, (0.2, 0.8), _FRONT), Slot(bath.tray_of_bottles, (0.1, 0.9), _MIDDLE),
            Slot(single("table_lamp"), _LEFT, _BACK), Slot(bath.tissues, (0.05, 0.95), _MIDDLE)]  # fmt: skip


def _basin(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    one, other = ((0.05, 0.25), (0.75, 0.95)) if kit.chance(0.5) else ((0.75, 0.95), (0.05, 0.25))
    return [Slot(bath.toothbrushes, one, (0.4, 0.9)), Slot(bath.soap, other, _FRONT), Slot(bath.bottles, other, _BACK),
            Slot(single("soap_dispenser"), one, (0.2, 0.8)), Slot(bath.towels, one, _FRONT)]  # fmt: skip


def _spa(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(bath.towels, (0.05, 0.25), _MIDDLE), Slot(bath.tray_of_bottles, (0.75, 0.95), _MIDDLE),
            Slot(lounge.decor, (0.05, 0.95), _BACK), Slot(bath.towel_basket, (0.05, 0.95), _MIDDLE), Slot(bath.soap)]  # fmt: skip


def _night(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(single("table_lamp", "desk_lamp"), (0.2, 0.8), _BACK), Slot(lounge.bedside, (0.3, 0.7), _FRONT),
            Slot(single("alarm_clock", "desk_clock"), (0.1, 0.9), _MIDDLE)]  # fmt: skip


def _television(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(single("monitor", wobble=0.05), (0.4, 0.6), _BACK), Slot(lounge.remotes, (0.1, 0.9), _FRONT),
            Slot(single("speaker", wobble=0.1), (0.06, 0.2), _BACK), Slot(desk.standing_books, (0.05, 0.95), _MIDDLE),
            Slot(lounge.decor, (0.75, 0.95), _BACK)]  # fmt: skip


def _side(kit: GroupSampler, table: Tabletop) -> list[Slot]:
    return [Slot(desk.books, (0.2, 0.8), _MIDDLE), Slot(lounge.decor, (0.2, 0.8), _BACK), Slot(dining.cup_on_saucer)]


_OFFICE = (
    desk.office_bits, desk.phone_dock, desk.ornaments, desk.papers, desk.organizer, desk.books, desk.boxes, desk.cup_of_pens,
    dining.mug_on_coaster, desk.file_tray, desk.writing, single("headphones", "speaker", "microphone", "webcam"),
    single("water_bottle", "thermos", "mug", "soda_can"), single("tissue_box", "potted_plant", "cactus"), desk.ornaments,
    lounge.glasses_and_keys, single("apple", "donut", "banana"), single("scissors", "ruler", "stapler"), single("desk_fan", "radio"),
)  # fmt: skip
_DINING = (
    dining.salt_and_pepper, dining.napkins, dining.wine, dining.glasses, dining.bread_basket, dining.fruit_bowl, dining.plates,
    dining.plate_of_sweets, dining.centrepiece, dining.cup_on_saucer, dining.lying_bottle, single("pitcher", "teapot"),
    dining.cutlery, single("napkin", "butter_dish", "egg_cup"), kitchen.bowl_in_crate, kitchen.tray_of_bottles, kitchen.loose_food,
    single("candle", "candlestick", "flower_vase"), dining.cake,
)  # fmt: skip
_COFFEE = (
    lounge.decor, lounge.remotes, lounge.magazines, lounge.candle_tray, dining.mug_on_coaster, dining.fruit_bowl, desk.books,
    lounge.glasses_and_keys, dining.cup_on_saucer, dining.wine, dining.plate_of_sweets, lounge.chess, lounge.toys, desk.laptop,
    single("tablet", "phone", "camera"), single("tissue_box", "table_lamp"), lounge.blocks, dining.lying_bottle,
    single("remote_control", "game_controller"), single("coaster", "book"),
)  # fmt: skip
_KITCHEN = (
    kitchen.jars, kitchen.tray_of_bottles, kitchen.utensils, kitchen.pan_with_spatula, kitchen.pot_and_lid, kitchen.pot,
    kitchen.vegetables, kitchen.loose_food, kitchen.appliance, kitchen.bowls, kitchen.cans, kitchen.mortar, dining.plates,
    dining.glasses, dining.bread_basket, kitchen.bowl_in_crate, dining.lying_bottle, dining.spoons_in_cup, kitchen.crate,
    single("dish_sponge", "grater", "measuring_cup", "whisk"), single("milk_carton", "cereal_box", "paper_bag"), dining.mug_on_coaster,
    single("bottle", "sauce_bottle", "thermos"), single("watermelon", "pumpkin", "bread"),
)  # fmt: skip
_DRESSING = (
    bath.perfumes, bath.makeup, bath.brushes, bath.jewelry, bath.hair, bath.tissues, bath.tray_of_bottles, lounge.candle_tray,
    desk.boxes, single("perfume", "lipstick", "nail_polish"), single("watch", "sunglasses", "phone"), lounge.decor,
    single("cream_jar", "lotion_bottle"), single("photo_frame", "flower_vase", "vase"), bath.bottles, desk.books,
    single("hair_brush", "comb", "hand_mirror"), single("ring_dish", "cotton_jar"), single("mug", "water_bottle"),
)  # fmt: skip
_BATH = (
    bath.bottles, bath.toothbrushes, bath.soap, bath.towels, bath.tray_of_bottles, bath.tissues, bath.hair, bath.towel_basket,
    single("lotion_bottle", "shampoo_bottle"), single("soap_dispenser"), single("candle", "potted_plant", "diffuser"),
    single("razor", "comb", "toothpaste"), single("cream_jar", "cotton_jar", "deodorant"), bath.perfumes, bath.brushes,
    single("tumbler", "mug"), single("rubber_duck"), lounge.candle_tray,
)  # fmt: skip
_BEDROOM = (
    lounge.glasses_and_keys, dining.mug_on_coaster, single("tissue_box", "photo_frame"), single("candle", "cactus"), desk.books,
    single("cream_jar", "water_bottle"), lounge.magazines, single("watch", "phone", "sunglasses"), single("book"),
)  # fmt: skip
_LIVING = (lounge.decor, lounge.remotes, desk.books, lounge.magazines, single("router", "game_controller", "camera"),
           lounge.candle_tray, desk.ornaments, single("photo_frame", "globe"), lounge.blocks, desk.boxes)  # fmt: skip

TABLES: Mapping[str, TablePlan] = MappingProxyType(
    {
        "bathroom_vanity": TablePlan((0.95, 1.5), (0.46, 0.62), (_basin, _basin, _spa), _BATH, has_sink=True, density=20),
        "coffee_table": TablePlan((0.75, 1.2), (0.45, 0.72), (_reading, _coffee, _playing, _tea), _COFFEE, density=20),
        "dining_table": TablePlan(
            (1.0, 1.6), (0.72, 1.0), (_meal, _meal, _meal, _after_meal, _tea, _buffet), _DINING, density=16
        ),
        "dressing_table": TablePlan(
            (0.75, 1.15), (0.42, 0.56), (_vanity_row, _vanity_row, _hairdressing), _DRESSING, density=26
        ),
        "kitchen_counter": TablePlan((0.9, 1.6), (0.54, 0.72), (_cooking, _baking, _pantry, _breakfast), _KITCHEN, density=19),
        "office_table": TablePlan((0.85, 1.5), (0.52, 0.78), (_computer, _laptop, _study, _paperwork), _OFFICE, density=17),
    }
)
"""The six kinds of table of the format, by name."""

UNSEEN_TABLES: Mapping[str, TablePlan] = MappingProxyType(
    {
        "nightstand": TablePlan((0.40, 0.58), (0.36, 0.46), (_night,), _BEDROOM, density=32),
        "side_table": TablePlan((0.42, 0.6), (0.42, 0.6), (_side, _reading, _coffee), _COFFEE, density=26),
        "tv_stand": TablePlan((1.1, 1.6), (0.34, 0.45), (_television,), _LIVING, density=20),
    }
)
"""Kinds of table that training does not use."""
