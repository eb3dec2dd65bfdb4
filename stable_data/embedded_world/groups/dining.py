"""Eating and drinking: place settings, tea, centrepieces. Lengths in metres."""

import math

from stable_data.embedded_world.families.catalogue import asset
from stable_data.embedded_world.groups.arrangement import (
    Group,
    GroupItem,
    GroupSampler,
    fill_container,
    heap_in_bowl,
    lean_in_cup,
    place_on_carrier,
    row,
    scatter,
    stack,
)
from stable_data.embedded_world.modelling.family import LAID

FRUIT = ("apple", "orange", "lemon", "pear", "tomato", "avocado")
SWEET = ("muffin", "donut", "cookie", "croissant", "cake")


def place_setting(kit: GroupSampler) -> Group:
    """A plate with a bowl, napkin or bread on it, cutlery at its sides and a drink behind it; all from the variants of the scene."""
    plate = GroupItem(kit.own("plate"), yaw=kit.around(3))
    width = plate.size[0]
    group: Group = []
    if kit.decided("placemat", 0.4):
        group.append(GroupItem(kit.own("placemat")))
    group.append(plate)
    extra = kit.pick("bowl", "napkin", "none", "bread", "none") if not kit.decided("bowls", 0.4) else "bowl"
    if extra == "bowl" and GroupItem(kit.own("bowl")).size[0] < 0.9 * width:
        group.append(GroupItem(kit.own("bowl"), yaw=kit.around(3)))
    elif extra == "napkin" and max(GroupItem(kit.own("napkin")).size[:2]) < 0.8 * width:
        group.append(GroupItem(kit.own("napkin"), yaw=kit.around(0.1)))
    elif extra == "bread":
        group.append(kit.item(kit.key("bun", "croissant"), kit.around(0.01), kit.around(0.01), kit.around(3)))
    side = width / 2 + 0.018
    if kit.decided("chopsticks", 0.2):
        group.append(_upright_along_y(kit.own("chopsticks"), side + 0.01, kit))
    else:
        group.append(_upright_along_y(kit.own("fork"), -side - 0.008, kit))
        group.append(_upright_along_y(kit.own("table_knife"), side + 0.006, kit))
        if kit.chance(0.5):
            group.append(_upright_along_y(kit.own("spoon"), side + 0.042, kit))
    drink = kit.own(_drink(kit))
    reach = GroupItem(drink).size[0] / 2
    group.append(GroupItem(drink, side + reach * 0.4, width / 2 + reach + kit.between(0.0, 0.02), kit.around(0.6)))
    return group


def _drink(kit: GroupSampler) -> str:
    for category in ("wine_glass", "drinking_glass", "tumbler"):
        if kit.decided(f"drink {category}", 0.45):
            return category
    return "mug"


def _upright_along_y(key: str, x: float, kit: GroupSampler) -> GroupItem:
    """A flat item with its long side along y, beside a plate."""
    width, depth, _ = GroupItem(key).size
    return GroupItem(key, x, kit.around(0.008), (math.pi / 2 if width > depth else 0.0) + kit.around(0.05))


def tea_for_two(kit: GroupSampler) -> Group:
    """A teapot between two cups on saucers, sometimes with a sugar bowl."""
    pot = kit.item(kit.key("teapot"), yaw=kit.around(0.5))
    reach = max(pot.size[:2]) / 2 + 0.085
    group: Group = [pot]
    for side in (-1, 1):
        saucer = GroupItem(kit.own("saucer"), side * (reach + 0.01), -0.04 * kit.between(0.5, 1.5), kit.around(3))
        group += [saucer, GroupItem(kit.own("teacup"), saucer.x, saucer.y, kit.around(0.8))]
    if kit.chance(0.6):
        group.append(kit.item(kit.key("sugar_bowl"), kit.around(0.03), -reach - 0.02, kit.around(0.5)))
    return group


def tea_tray(kit: GroupSampler) -> Group:
    """A tray with a pot, cups and sugar or a sweet on it."""
    items = [kit.item(kit.key("teapot", "pitcher"), wobble=0.4)]
    items += [GroupItem(kit.own("teacup", "mug"), yaw=kit.around(0.6)) for _ in range(kit.count(1, 2))]
    items += [kit.item(kit.key("sugar_bowl", "muffin", "donut"), wobble=0.5)]
    return place_on_carrier(kit.item(kit.key("serving_tray")), items, kit)


def breakfast_tray(kit: GroupSampler) -> Group:
    """A tray with a drink and a plate that holds food: objects on objects on a tray."""
    tray, plate = kit.item(kit.key("serving_tray")), GroupItem(kit.own("saucer", "plate"), yaw=kit.around(3))
    placed = place_on_carrier(tray, [plate, GroupItem(kit.own("mug", "teacup"), yaw=kit.around(0.6))], kit)
    for there in placed[1:]:
        if there.key == plate.key:
            placed.append(kit.item(kit.key(*SWEET[:4], "apple", "bun"), there.x, there.y, kit.around(3)))
    return placed


def fruit_bowl(kit: GroupSampler) -> Group:
    """A bowl with two to five fruits."""
    kinds = [kit.key(*FRUIT) for _ in range(kit.count(2, 5))]
    return heap_in_bowl(kit.loose_item("bowl", "mixing_bowl", "colander"), [kit.item(key) for key in kinds], kit)


def bread_basket(kit: GroupSampler) -> Group:
    """A basket with buns or fruit side by side."""
    kinds = kit.pick("bun", "croissant", "apple", "orange", "egg", "muffin")
    basket = kit.item(kit.key("basket"))
    return fill_container(basket, kit.loose_items(2, 4, kinds), kit, gap=0.006)


def centrepiece(kit: GroupSampler) -> Group:
    """Flowers or a candle between two candles, symmetric."""
    middle = kit.item(kit.key("flower_vase", "vase", "potted_plant", "candlestick"), wobble=3)
    candle = kit.own("candle", "candlestick", "tea_light")
    return row([GroupItem(candle), middle, GroupItem(candle)], kit.between(0.03, 0.07))


def wine(kit: GroupSampler) -> Group:
    """A bottle and one to three glasses before it."""
    bottle = kit.loose_item("bottle")
    glasses = [GroupItem(kit.own("wine_glass", "drinking_glass"), yaw=kit.around(3)) for _ in range(kit.count(1, 3))]
    reach = bottle.size[0] / 2 + max(g.size[0] for g in glasses) / 2 + kit.between(0.02, 0.05)
    first = -math.pi / 2 + kit.around(0.5)
    spread = [first + (k - (len(glasses) - 1) / 2) * 1.15 for k in range(len(glasses))]
    return [bottle, *(g.moved(reach * math.cos(a), reach * math.sin(a)) for g, a in zip(glasses, spread, strict=True))]


def salt_and_pepper(kit: GroupSampler) -> Group:
    """The two mills, close together."""
    return row([kit.item(kit.key("salt_shaker")), kit.item(kit.key("pepper_mill"))], kit.between(0.01, 0.03))


def plates(kit: GroupSampler) -> Group:
    """A stack of equal plates or bowls."""
    key = kit.own("plate", "plate", "saucer", "bowl")
    return stack([GroupItem(key, yaw=kit.around(3)) for _ in range(kit.count(2, 5))], kit, shift=0.001, turn=3)


def cutlery(kit: GroupSampler) -> Group:
    """Spare cutlery side by side, not quite parallel."""
    keys = [kit.own(kind) for kind in kit.some(kit.count(2, 3), "fork", "spoon", "table_knife")]
    lying = [_upright_along_y(key, 0.0, kit) for key in keys]
    return row(lying, kit.between(0.008, 0.02))


def cake(kit: GroupSampler) -> Group:
    """A cake or buns on a stand or a plate."""
    sweet = kit.loose_item("cake", "muffin", "donut", "croissant")
    return place_on_carrier(kit.loose_item("cake_stand", "plate"), [sweet], kit, overhang=0.3)


def plate_of_sweets(kit: GroupSampler) -> Group:
    """A plate with two to four sweets side by side."""
    plate = GroupItem(kit.own("plate"), yaw=kit.around(3))
    kind = kit.pick("cookie", "donut", "muffin")
    return place_on_carrier(plate, kit.loose_items(2, 4, kind), kit, gap=0.003)


def cup_on_saucer(kit: GroupSampler) -> Group:
    """A cup on its saucer."""
    saucer = kit.item(kit.own("saucer"), yaw=kit.around(3))
    cup = GroupItem(kit.own("teacup"), yaw=kit.around(0.8), scale=saucer.scale)
    return [saucer, cup]


def mug_on_coaster(kit: GroupSampler) -> Group:
    """A mug or glass on a coaster, a little off its middle."""
    drink = kit.item(kit.key("mug", "tumbler", "drinking_glass"), kit.around(0.004), kit.around(0.004), kit.around(0.8))
    return [kit.item(kit.key("coaster"), wobble=0.3), drink]


def napkins(kit: GroupSampler) -> Group:
    """A pile of napkins."""
    return stack([GroupItem(kit.own("napkin")) for _ in range(kit.count(2, 3))], kit, shift=0.003, turn=0.08)


def lying_bottle(kit: GroupSampler) -> Group:
    """A bottle that lies on its side."""
    return [GroupItem(kit.key("bottle"), yaw=kit.between(0.5, 2.6), tilt_quat_xyzw=LAID)]


def spoons_in_cup(kit: GroupSampler) -> Group:
    """Wooden spoons or spatulas that lean in a cup."""
    return lean_in_cup(
        kit.item(kit.key("tumbler", "utensil_holder")), [kit.key("wooden_spoon", "spatula") for _ in range(2)], kit
    )


def leftovers(kit: GroupSampler) -> Group:
    """After a meal: a plate askew with cutlery on it, and a cup."""
    plate = GroupItem(kit.own("plate"), yaw=kit.around(3))
    top = asset(plate.key).hollow or asset(plate.key).top
    cutlery_on_it = [_upright_along_y(kit.own(kind), 0.02 * side, kit) for kind, side in (("fork", -1), ("table_knife", 1))]
    inside = [o for o in cutlery_on_it if top is not None and max(o.size[:2]) < 0.95 * top.width]
    cup = GroupItem(kit.own("mug", "tumbler"), plate.size[0] / 2 + 0.07, kit.around(0.05), kit.around(2))
    return [plate, *inside, cup]


def glasses(kit: GroupSampler) -> Group:
    """Equal glasses in a small cluster."""
    key = kit.own("drinking_glass", "tumbler", "wine_glass")
    area = GroupItem(key).outline().buffer(1.6 * GroupItem(key).size[0])
    return scatter(area, [GroupItem(key, yaw=kit.around(3)) for _ in range(kit.count(2, 4))], kit, gap=0.012)
