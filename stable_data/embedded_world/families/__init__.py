"""The families of the embedded world, ordered by room.

Each module defines the families of one kind of object: one design function per category, listed in ``FAMILIES``. Lengths are
metres; every solid rests on z = 0 and faces -y. Several modules share ``vessels``, ``displays``, ``wording`` and ``palette``.
"""

from stable_data.embedded_world.families import (
    appliances,
    baking,
    bottles,
    boxes,
    candles,
    clocks,
    computers,
    cutlery,
    devices,
    dishes,
    drinkware,
    figures,
    fruit,
    games,
    groceries,
    grooming,
    lamps,
    makeup,
    office,
    ornaments,
    paper,
    pens,
    personal,
    plants,
    pots,
    serving,
    sound,
    toys,
    utensils,
    vegetables,
    vehicles,
    washing,
)
from stable_data.embedded_world.modelling.family import Drawing

# The order of the modules and of their families is the order of the catalogue's keys: append, do not sort.
_MODULES = (
    drinkware, dishes, serving, cutlery, bottles, groceries, boxes, pots, utensils, appliances, fruit,
    vegetables, baking, paper, pens, office, clocks, computers, devices, sound, lamps, washing, grooming,
    makeup, personal, candles, plants, figures, ornaments, vehicles, toys, games,
)  # fmt: skip

FAMILIES: tuple[Drawing, ...] = tuple(design for module in _MODULES for design in module.FAMILIES)
"""The design function of every category; its name is the category."""

__all__ = ["FAMILIES"]
