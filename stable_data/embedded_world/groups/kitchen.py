"""Cooking and keeping food. Lengths in metres."""

import math
from dataclasses import replace

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

VEGETABLES = ("carrot", "cucumber", "onion", "potato", "tomato", "bell_pepper", "eggplant", "lemon", "avocado")
STANDING = ("jar", "can", "bottle", "spice_jar", "sauce_bottle", "milk_carton", "soda_can")


def chopping(kit: GroupSampler) -> Group:
    """A board with a knife and vegetables on it, more beside it."""
    board = kit.item(kit.key("cutting_board"), wobble=0.1)
    knife = kit.item(kit.key("kitchen_knife"))
    width, depth, _ = knife.size
    knife = replace(knife, yaw=(math.pi / 2 if width > depth else 0.0) + kit.around(0.25))
    kinds = kit.some(kit.count(1, 3), *VEGETABLES)
    on_board = [kit.loose_item(kind) for kind in kinds]
    group = place_on_carrier(board, [knife, *on_board], kit, overhang=0.3)
    if kit.chance(0.6):
        other = kit.loose_item(*VEGETABLES)
        reach = max(board.size[:2]) / 2 + max(other.size[:2]) / 2 + 0.02
        group.append(other.moved(reach * kit.between(0.7, 1.0) * (1 if kit.chance(0.5) else -1), kit.around(0.08)))
    return group


def bread_board(kit: GroupSampler) -> Group:
    """A board with a loaf and a knife or cheese."""
    board = kit.item(kit.key("cutting_board"), wobble=0.1)
    items = [
        kit.item(kit.key("bread", "baguette", "cheese"), wobble=0.3),
        kit.item(kit.key("cheese", "kitchen_knife", "tomato")),
    ]
    return place_on_carrier(board, items, kit, overhang=0.3)


def pan_with_spatula(kit: GroupSampler) -> Group:
    """A pan, sometimes with food in it."""
    pan = kit.item(kit.key("frying_pan"), wobble=0.6)
    if kit.chance(0.5):
        return fill_container(pan, kit.loose_items(1, 2, "egg", "tomato", "onion"), kit)
    return [pan]


def pot(kit: GroupSampler) -> Group:
    """A pot, open, with food in it, or with a ladle that leans in it."""
    vessel = kit.item(kit.key("cooking_pot", "saucepan"), wobble=0.5)
    choice = kit.pick("ladle", "food", "none")
    if choice == "ladle":
        return lean_in_cup(vessel, [kit.key("ladle", "wooden_spoon")], kit)
    if choice == "food":
        return fill_container(vessel, kit.loose_items(2, 3, "potato", "egg", "carrot"), kit)
    return [vessel]


def pot_and_lid(kit: GroupSampler) -> Group:
    """A pot with its lid beside it."""
    return row([kit.item(kit.key("cooking_pot", "saucepan")), kit.item(kit.key("pot_lid"))], kit.between(0.02, 0.05))


def mixing(kit: GroupSampler) -> Group:
    """A mixing bowl with a spatula that leans in it or eggs, and what goes into it beside it."""
    bowl = kit.loose_item("mixing_bowl")
    group = (
        lean_in_cup(bowl, [kit.key("spatula", "wooden_spoon")], kit) if kit.chance(0.4) else heap_in_bowl(bowl, _eggs(kit), kit)
    )
    beside = kit.item(kit.key("milk_carton", "measuring_cup", "jar"), wobble=0.6)
    reach = bowl.size[0] / 2 + max(beside.size[:2]) / 2 + kit.between(0.01, 0.04)
    return [*group, beside.moved(reach, kit.around(0.05))]


def _eggs(kit: GroupSampler) -> list[GroupItem]:
    return kit.items(2, 3, "egg")


def jars(kit: GroupSampler) -> Group:
    """Jars, tins and bottles in a row against the wall, some alike."""
    keys = [kit.key(*STANDING) if kit.chance(0.6) else kit.own("spice_jar", "jar") for _ in range(kit.count(3, 5))]
    return row([GroupItem(key, 0.0, kit.around(0.008), kit.around(0.4)) for key in keys], kit.between(0.008, 0.025))


def tray_of_bottles(kit: GroupSampler) -> Group:
    """A tray with oil, sauce and spices."""
    kinds = ("sauce_bottle", "bottle", "spice_jar", "salt_shaker", "pepper_mill", "jar")
    items = kit.loose_items(3, 5, *kinds)
    return place_on_carrier(kit.item(kit.key("serving_tray", "decor_tray")), items, kit, gap=0.012)


def crate(kit: GroupSampler) -> Group:
    """A crate with jars, tins and bottles, or with fruit."""
    if kit.chance(0.5):
        items = [kit.loose_item("jar", "can", "bottle", "sauce_bottle", "soda_can") for _ in range(5)]
    else:
        items = [kit.loose_item(kit.pick("apple", "orange", "potato", "onion")) for _ in range(4)]
    return fill_container(kit.item(kit.key("crate")), items[: kit.count(2, 5)], kit, gap=0.012)


def bowl_in_crate(kit: GroupSampler) -> Group:
    """A crate or tray that holds a bowl, which holds a fruit: nested three deep."""
    outer = kit.item(kit.key("crate", "serving_tray", "oven_dish"))
    bowl = kit.loose_item("bowl")
    group = fill_container(outer, [bowl], kit) if kit.chance(0.5) else place_on_carrier(outer, [bowl], kit)
    if len(group) == 2:
        inner = kit.key("apple", "orange", "lemon", "egg", "tomato", "muffin")
        group.append(kit.item(inner, group[1].x + kit.around(0.004), group[1].y + kit.around(0.004), kit.around(3)))
    return group


def utensils(kit: GroupSampler) -> Group:
    """A holder with spoons and spatulas that lean in it."""
    keys = [kit.key("wooden_spoon", "spatula", "ladle") for _ in range(kit.count(2, 3))]
    return lean_in_cup(kit.item(kit.key("utensil_holder")), keys, kit)


def appliance(kit: GroupSampler) -> Group:
    """A toaster, kettle, blender, coffee maker or scale, sometimes with what goes with it."""
    kind = kit.pick("toaster", "kettle", "blender", "coffee_maker", "kitchen_scale")
    machine = kit.item(kit.key(kind), wobble=0.12)
    company = {"toaster": ("bread", "bun"), "kettle": ("mug", "teapot"), "coffee_maker": ("mug", "teacup")}.get(kind)
    if kind == "kitchen_scale" and kit.chance(0.7):
        return place_on_carrier(machine, [kit.loose_item("bowl", "onion", "apple", "potato")], kit)
    if company is None or kit.chance(0.4):
        return [machine]
    return row([machine, kit.item(kit.key(*company), wobble=0.5)], kit.between(0.03, 0.07))


def vegetables(kit: GroupSampler) -> Group:
    """Vegetables in a colander, a basket or a baking dish."""
    dish = kit.item(kit.key("colander", "basket", "oven_dish"), wobble=0.4)
    return fill_container(dish, kit.loose_items(2, 4, *VEGETABLES), kit)


def loose_food(kit: GroupSampler) -> Group:
    """Two or three fruits or vegetables that lie together."""
    kind = kit.pick("apple", "orange", "lemon", "potato", "onion", "tomato", "pear", "egg", "banana")
    items = kit.loose_items(2, 3, kind)
    area = items[0].outline().buffer(1.3 * max(items[0].size[:2]))
    return scatter(area, items, kit, gap=0.006)


def shopping(kit: GroupSampler) -> Group:
    """A paper bag or a box with food beside it."""
    bag = kit.item(kit.key("paper_bag", "cereal_box", "storage_box"), wobble=0.2)
    items = [kit.item(kit.key("milk_carton", "can", "bread", "cereal_box", "watermelon"), wobble=0.5)]
    return row([bag, *items], kit.between(0.02, 0.05))


def mortar(kit: GroupSampler) -> Group:
    """A mortar with spices beside it."""
    return row([kit.loose_item("mortar"), kit.item(kit.key("spice_jar"))], kit.between(0.02, 0.04))


def bowls(kit: GroupSampler) -> Group:
    """Equal bowls in one another."""
    key = kit.own("bowl")
    return stack([GroupItem(key, yaw=kit.around(3)) for _ in range(kit.count(2, 4))], kit, shift=0.001, turn=3)


def cans(kit: GroupSampler) -> Group:
    """Tins on top of and beside each other."""
    key = kit.own("can")
    width = GroupItem(key).size[0]
    group = [GroupItem(key), GroupItem(key, width + kit.between(0.004, 0.02), kit.around(0.01))]
    return [*group, GroupItem(key, kit.around(0.004), kit.around(0.004), kit.around(3))] if kit.chance(0.6) else group
