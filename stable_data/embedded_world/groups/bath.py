"""Washing and dressing. Lengths in metres."""

from dataclasses import replace

from stable_data.embedded_world.groups.arrangement import (
    Group,
    GroupItem,
    GroupSampler,
    fill_container,
    lean_in_cup,
    place_on_carrier,
    row,
    stack,
)

BOTTLES = ("lotion_bottle", "shampoo_bottle", "soap_dispenser", "deodorant", "perfume", "cream_jar", "cotton_jar")
MAKEUP = ("lipstick", "nail_polish", "makeup_palette", "cream_jar", "perfume")


def toothbrushes(kit: GroupSampler) -> Group:
    """A cup with toothbrushes that lean in it, the tube beside it."""
    group = lean_in_cup(
        kit.item(kit.key("toothbrush_cup", "tumbler")), [kit.key("toothbrush") for _ in range(kit.count(1, 3))], kit
    )
    if kit.chance(0.6):
        tube = kit.item(kit.key("toothpaste"), wobble=0.4)
        group.append(tube.moved(group[0].size[0] / 2 + max(tube.size[:2]) / 2 + 0.02, -0.02))
    return group


def soap(kit: GroupSampler) -> Group:
    """A bar of soap on its dish."""
    dish = kit.item(kit.key("soap_dish"), wobble=0.3)
    return [dish, GroupItem(kit.key("soap"), dish.x, dish.y, dish.yaw + kit.around(0.15), scale=(0.9, 0.9, 0.9))]


def bottles(kit: GroupSampler) -> Group:
    """Bottles and jars in a row, tallest at one end."""
    items = sorted((kit.item(kit.key(*BOTTLES), wobble=0.2) for _ in range(kit.count(3, 5))), key=lambda o: -o.size[2])
    return row([replace(o, y=kit.around(0.006)) for o in items], kit.between(0.008, 0.025))


def tray_of_bottles(kit: GroupSampler) -> Group:
    """A tray with bottles and jars on it."""
    items = [kit.item(kit.key(*BOTTLES), yaw=kit.around(0.4)) for _ in range(kit.count(3, 5))]
    return place_on_carrier(kit.item(kit.key("decor_tray", "serving_tray")), items, kit, gap=0.01)


def perfumes(kit: GroupSampler) -> Group:
    """Perfumes and lipsticks in a vanity's row, evenly spaced."""
    kinds = kit.pick("perfume", "lipstick", "nail_polish", "cream_jar")
    items = kit.items(3, 5, kinds, wobble=0.15)
    return row(items, kit.between(0.01, 0.03))


def brushes(kit: GroupSampler) -> Group:
    """A holder with brushes that lean in it."""
    keys = [kit.key("makeup_brush") for _ in range(kit.count(2, 3))]
    return lean_in_cup(kit.item(kit.key("brush_holder", "pen_holder")), keys, kit)


def makeup(kit: GroupSampler) -> Group:
    """A makeup palette in a row with other cosmetics."""
    palette = kit.item(kit.key("makeup_palette"), wobble=0.3)
    items = [palette, *(kit.item(kit.key(*MAKEUP), wobble=0.4) for _ in range(kit.count(1, 3)))]
    return row(items, kit.between(0.015, 0.035))


def jewelry(kit: GroupSampler) -> Group:
    """A jewellery box with a dish or a perfume on its lid or beside it."""
    box = kit.item(kit.key("jewelry_box"), wobble=0.15)
    item = kit.item(kit.key("ring_dish", "watch", "perfume", "nail_polish"), wobble=1)
    if kit.chance(0.5):
        return place_on_carrier(box, [item], kit)
    return row([box, item], kit.between(0.02, 0.05))


def towels(kit: GroupSampler) -> Group:
    """Folded towels on one another."""
    key = kit.own("towel")
    pile = [GroupItem(key) for _ in range(kit.count(2, 3))]
    return stack(pile, kit, shift=0.006, turn=0.06)


def towel_basket(kit: GroupSampler) -> Group:
    """A basket with soap, brushes and small bottles."""
    items = [kit.loose_item("soap", "cream_jar", "comb", "deodorant", "nail_polish", "toothpaste") for _ in range(3)]
    return fill_container(kit.item(kit.key("basket", "storage_bin")), items, kit)


def hair(kit: GroupSampler) -> Group:
    """A brush and a comb, or a hair dryer."""
    items = [
        kit.item(kit.key(kind), wobble=0.3)
        for kind in kit.some(kit.count(1, 2), "hair_brush", "comb", "hair_dryer", "hand_mirror")
    ]
    return row(items, kit.between(0.02, 0.04))


def mirror(kit: GroupSampler) -> Group:
    """A mirror on its stand."""
    return [kit.item(kit.key("mirror"), wobble=0.15)]


def tissues(kit: GroupSampler) -> Group:
    """A box of tissues, sometimes with cotton beside it."""
    box = kit.item(kit.key("tissue_box"), wobble=0.15)
    return [box] if kit.chance(0.5) else row([box, kit.item(kit.key("cotton_jar", "lotion_bottle"))], kit.between(0.02, 0.05))
