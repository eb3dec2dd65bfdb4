"""Work at a desk. Lengths in metres."""

import math
from dataclasses import replace

from stable_data.embedded_world.families.catalogue import asset
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
from stable_data.embedded_world.modelling.family import ON_EDGE

WRITING = ("pen", "pencil", "marker", "highlighter")
SMALL = ("eraser", "sticky_notes", "stapler", "tape_dispenser", "calculator", "hole_punch", "glasses_case")
TOPPERS = ("mug", "glasses_case", "phone", "apple", "calculator", "alarm_clock", "puzzle_cube", "sticky_notes", "candle")


def workstation(kit: GroupSampler) -> Group:
    """A monitor, a keyboard before it, a mouse on the right, sometimes on a pad."""
    monitor, keyboard = kit.item(kit.key("monitor"), wobble=0.03), kit.item(kit.key("keyboard"), wobble=0.04)
    gap = monitor.size[1] / 2 + keyboard.size[1] / 2 + kit.between(0.05, 0.12)
    keyboard = keyboard.moved(kit.around(0.02), -gap)
    mouse = kit.item(kit.key("mouse"), wobble=0.2)
    group: Group = [monitor, keyboard]
    if kit.chance(0.5):
        pad = kit.item(kit.key("mouse_pad"), wobble=0.04)
        x = keyboard.x + keyboard.size[0] / 2 + pad.size[0] / 2 + kit.between(0.02, 0.04)
        pad = pad.moved(x, keyboard.y)
        return [*group, pad, mouse.moved(x + kit.around(0.02), keyboard.y + kit.around(0.02))]
    x = keyboard.x + keyboard.size[0] / 2 + mouse.size[0] / 2 + kit.between(0.03, 0.07)
    return [*group, mouse.moved(x, keyboard.y + kit.around(0.02))]


def laptop(kit: GroupSampler) -> Group:
    """A laptop, often with a mouse."""
    machine = kit.item(kit.key("laptop"), wobble=0.1)
    if kit.chance(0.45):
        return [machine]
    mouse = kit.item(kit.key("mouse"), wobble=0.25)
    x = max(machine.size[:2]) / 2 + mouse.size[0] / 2 + kit.between(0.03, 0.06)
    return [machine, mouse.moved(x, -machine.size[1] * kit.between(0.05, 0.25))]


def books(kit: GroupSampler) -> Group:
    """A stack of books, the largest at the bottom, sometimes with an object on top."""
    count = kit.count(2, 5)
    volumes = [kit.item(kit.key("book", "book", "notebook", "magazine")) for _ in range(count)]
    volumes = [replace(o, tilt_quat_xyzw=asset(o.key).tilts[0]) for o in volumes]
    volumes.sort(key=lambda o: -o.size[0] * o.size[1])
    pile = stack(volumes, kit, shift=0.008, turn=0.12 if kit.chance(0.6) else 0.4)
    return _topped(pile, kit) if kit.chance(0.45) else pile


def _topped(pile: Group, kit: GroupSampler) -> Group:
    last = pile[-1]
    item = kit.item(kit.key(*TOPPERS), wobble=3)
    width, depth, _ = item.size
    if max(width, depth) > 0.95 * min(last.size[:2]):
        return pile
    return [*pile, replace(item, x=last.x + kit.around(0.01), y=last.y + kit.around(0.01))]


def standing_books(kit: GroupSampler) -> Group:
    """Books on their edge, side by side between bookends."""
    volumes = [GroupItem(kit.key("book"), tilt_quat_xyzw=ON_EDGE) for _ in range(kit.count(3, 5))]
    volumes.sort(key=lambda o: -o.size[2])
    end = kit.key("bookend")
    right = GroupItem(end)
    left = GroupItem(end, yaw=math.pi)
    return row([left, *volumes, right], 0.0006)


def cup_of_pens(kit: GroupSampler) -> Group:
    """A holder with two to four pens."""
    keys = [kit.key(*WRITING) for _ in range(kit.count(2, 4))]
    return lean_in_cup(kit.item(kit.key("pen_holder")), keys, kit)


def mug_of_pens(kit: GroupSampler) -> Group:
    """A mug that serves as a holder."""
    return lean_in_cup(kit.item(kit.key("mug"), yaw=kit.around(2)), [kit.key(*WRITING) for _ in range(kit.count(1, 3))], kit)


def writing(kit: GroupSampler) -> Group:
    """A notebook or papers with a pen across, a pencil beside it."""
    sheet = kit.item(kit.key("notebook", "paper_stack", "clipboard", "magazine"), wobble=0.2)
    group: Group = [sheet]
    if kit.chance(0.8):
        pen = kit.item(kit.key(*WRITING), sheet.x + kit.around(0.02), sheet.y + kit.around(0.03), kit.between(0.3, 1.1))
        group.append(pen)
    if kit.chance(0.5):
        other = kit.item(kit.key("pencil", "ruler", "eraser", "highlighter"))
        reach = sheet.size[0] / 2 + min(other.size[:2]) / 2 + kit.between(0.02, 0.04)
        turn = math.pi / 2 if other.size[0] > other.size[1] else 0.0
        group.append(replace(other.moved(reach, kit.around(0.03)), yaw=turn + kit.around(0.12)))
    return group


def office_bits(kit: GroupSampler) -> Group:
    """Two or three small objects side by side."""
    items = [kit.item(kit.key(kind), wobble=0.25) for kind in kit.some(kit.count(2, 3), *SMALL)]
    return row(items, kit.between(0.015, 0.04))


def file_tray(kit: GroupSampler) -> Group:
    """A tray with papers or magazines in it or on it."""
    tray = kit.item(kit.key("file_tray"), wobble=0.05)
    return place_on_carrier(tray, [kit.item(kit.key("notebook", "envelope", "paper_stack", "magazine"))], kit)


def organizer(kit: GroupSampler) -> Group:
    """A storage bin with small objects in it."""
    items = [kit.loose_item("eraser", "sticky_notes", "tape_dispenser", "calculator", "mouse") for _ in range(3)]
    return fill_container(kit.item(kit.key("storage_bin", "basket")), items, kit)


def boxes(kit: GroupSampler) -> Group:
    """A smaller box on a larger one, sometimes on a third."""
    pile = kit.items(2, 3, "storage_box", "gift_box", "tin_box", "board_game")
    pile.sort(key=lambda o: -min(o.size[:2]))
    return stack(pile, kit, shift=0.008, turn=0.25)


def papers(kit: GroupSampler) -> Group:
    """Envelopes, papers and a clipboard on one another."""
    pile = kit.items(2, 3, "paper_stack", "envelope", "clipboard", "newspaper", "notebook")
    pile.sort(key=lambda o: -o.size[0] * o.size[1])
    return stack(pile, kit, shift=0.015, turn=0.3)


def phone_dock(kit: GroupSampler) -> Group:
    """A phone, a power bank or headphones lying together."""
    items = [
        kit.item(kit.key(kind), wobble=0.2)
        for kind in kit.some(2, "phone", "power_bank", "headphones", "charger_dock", "tablet")
    ]
    return row(items, kit.between(0.02, 0.04))


def ornaments(kit: GroupSampler) -> Group:
    """A frame, a plant, a clock: personal objects on a desk."""
    kinds = ("photo_frame", "cactus", "potted_plant", "desk_clock", "figurine", "globe", "puzzle_cube", "snow_globe")
    return row([kit.item(kit.key(kind), wobble=0.3) for kind in kit.some(kit.count(1, 2), *kinds)], kit.between(0.02, 0.06))
