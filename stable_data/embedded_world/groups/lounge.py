"""Leisure: reading, playing, decorating. Lengths in metres."""

from dataclasses import replace

from stable_data.embedded_world.groups.arrangement import (
    Group,
    GroupItem,
    GroupSampler,
    fill_container,
    place_on_carrier,
    row,
    scatter,
    stack,
)

DECOR = (
    "candle", "figurine", "vase", "flower_vase", "potted_plant", "hourglass", "snow_globe", "diffuser", "piggy_bank", "cactus",
)  # fmt: skip


def magazines(kit: GroupSampler) -> Group:
    """Magazines in a pile, a remote control or glasses on top."""
    pile = kit.items(2, 4, "magazine", "newspaper", "book")
    pile.sort(key=lambda o: -o.size[0] * o.size[1])
    group = stack(pile, kit, shift=0.012, turn=0.3)
    if kit.chance(0.5):
        item = kit.item(
            kit.key("remote_control", "sunglasses", "glasses_case", "phone"), group[-1].x, group[-1].y, kit.around(1)
        )
        if max(item.size[:2]) < 0.95 * max(group[-1].size[:2]):
            group.append(item)
    return group


def remotes(kit: GroupSampler) -> Group:
    """Remote controls and a game controller side by side."""
    items = [
        kit.item(kit.key(kit.pick("remote_control", "game_controller", "remote_control")), wobble=0.3)
        for _ in range(kit.count(1, 3))
    ]
    return row(items, kit.between(0.015, 0.04))


def decor(kit: GroupSampler) -> Group:
    """One to three ornaments close together, the tallest in the middle."""
    items = sorted((kit.item(kit.key(kind), wobble=0.6) for kind in kit.some(kit.count(1, 3), *DECOR)), key=lambda o: o.size[2])
    if len(items) == 3:
        items = [items[0], items[2], items[1]]
    return row([replace(o, y=kit.around(0.015)) for o in items], kit.between(0.012, 0.05))


def candle_tray(kit: GroupSampler) -> Group:
    """A small tray with candles and an ornament."""
    items = kit.loose_items(2, 3, "candle", "tea_light", "diffuser", "figurine")
    return place_on_carrier(kit.item(kit.key("decor_tray", "serving_tray")), items, kit, gap=0.015)


def toys(kit: GroupSampler) -> Group:
    """Scattered toys."""
    kinds = ("toy_car", "toy_block", "rubber_duck", "puzzle_cube", "ball", "dice", "toy_train", "toy_robot", "stacking_rings")
    items = [kit.loose_item(kind) for kind in kit.some(kit.count(2, 4), *kinds)]
    area = items[0].outline().buffer(0.16)
    return scatter(area, items, kit, gap=0.01)


def toy_bin(kit: GroupSampler) -> Group:
    """A bin or basket with toys in it."""
    kinds = ("toy_car", "toy_block", "rubber_duck", "puzzle_cube", "dice")
    items = kit.loose_items(2, 4, *kinds)
    return fill_container(kit.item(kit.key("storage_bin", "basket", "crate")), items, kit)


def blocks(kit: GroupSampler) -> Group:
    """Toy blocks on one another."""
    pile = [kit.item(kit.key("toy_block", "toy_block", "puzzle_cube"), yaw=kit.around(0.5)) for _ in range(kit.count(2, 3))]
    pile.sort(key=lambda o: -min(o.size[:2]))
    return stack(pile, kit, shift=0.003, turn=0.4)


def board_game(kit: GroupSampler) -> Group:
    """A game's box with cards or dice on it, or beside it."""
    box = kit.item(kit.key("board_game"), wobble=0.2)
    return place_on_carrier(box, kit.loose_items(1, 3, "card_deck", "dice", "chess_piece"), kit)


def chess(kit: GroupSampler) -> Group:
    """A few chess pieces."""
    items = kit.items(2, 4, "chess_piece")
    return scatter(items[0].outline().buffer(0.09), items, kit, gap=0.01)


def glasses_and_keys(kit: GroupSampler) -> Group:
    """Contents of pockets."""
    kinds = kit.some(kit.count(2, 3), "sunglasses", "wallet", "watch", "phone", "glasses_case")
    return row([kit.item(kit.key(kind), wobble=0.5) for kind in kinds], kit.between(0.015, 0.04))


def bedside(kit: GroupSampler) -> Group:
    """A book with glasses or a phone on it, and a glass of water."""
    book = kit.item(kit.key("book"), wobble=0.2)
    on_it = kit.item(kit.key("phone", "glasses_case", "sunglasses", "watch"), kit.around(0.01), kit.around(0.01), kit.around(1))
    glass = GroupItem(
        kit.key("drinking_glass", "mug", "water_bottle"), book.size[0] / 2 + 0.06, kit.around(0.04), kit.around(2)
    )
    small = max(on_it.size[:2]) < 0.95 * max(book.size[:2])
    return [book, on_it, glass] if small else [book, glass]
