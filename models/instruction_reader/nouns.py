"""Nouns for the slots of frames: names of known categories, of unknown objects, and of things that are not on the table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from random import Random

from models.instruction_reader.phrases import read_lines
from stable_data.instructions.wording.vocabulary import nouns_of
from stable_data.instructions.wording.words import type_words

_UNKNOWN_SHARE = 0.15  # of the objects have a noun of no known category
_ANY_SHARE = 0.2  # of the objects have any noun, so that a reader does not rely on what fits where


def _categories(text: str) -> tuple[str, ...]:
    return tuple(text.split())


_POOLS: Mapping[str, tuple[str, ...]] = {
    "container": _categories(
        "basket bowl brush_holder cooking_pot cotton_jar crate drinking_glass egg_cup file_tray flower_vase frying_pan gift_box"
        " glasses_case jar jewelry_box measuring_cup mixing_bowl mortar mug oven_dish paper_bag pen_holder ring_dish saucepan"
        " soap_dish storage_bin storage_box sugar_bowl teacup tin_box toothbrush_cup tumbler utensil_holder vase wine_glass colander"
    ),
    "carrier": _categories(
        "board_game book clipboard coaster cutting_board decor_tray file_tray kitchen_scale laptop magazine makeup_palette"
        " mouse_pad napkin newspaper notebook oven_dish paper_stack placemat plate saucer serving_tray storage_box tablet tin_box"
        " towel cake_stand tissue_box toaster radio speaker keyboard gift_box envelope"
    ),
    "small": _categories(
        "card_deck chess_piece coaster cookie dice egg eraser lipstick lemon nail_polish pen pencil ring_dish salt_shaker soap"
        " spoon sticky_notes tea_light toy_block toy_car watch wallet spice_jar rubber_duck puzzle_cube power_bank perfume"
        " highlighter scissors razor fork glasses_case mouse apple carrot potato onion orange banana tomato donut muffin bun"
        " remote_control phone calculator stapler toothpaste comb sunglasses table_knife marker toothbrush ruler cheese avocado"
    ),
    "long": _categories(
        "pen pencil marker highlighter spoon fork table_knife kitchen_knife whisk ladle spatula wooden_spoon toothbrush"
        " makeup_brush chopsticks ruler scissors comb razor rolling_pin baguette candle"
    ),
    "stackable": _categories(
        "plate bowl book notebook magazine saucer toy_block storage_box serving_tray coaster gift_box tin_box mug teacup placemat"
        " towel newspaper mixing_bowl crate oven_dish board_game dice cookie"
    ),
    "food": _categories(
        "apple avocado baguette banana bell_pepper bread bun cake carrot cheese cookie croissant cucumber donut egg eggplant"
        " lemon muffin onion orange pear potato pumpkin tomato watermelon"
    ),
    "drink": _categories(
        "mug teacup tumbler drinking_glass wine_glass bottle water_bottle soda_can milk_carton pitcher teapot thermos kettle"
    ),
    "device": _categories(
        "alarm_clock blender calculator camera coffee_maker desk_fan desk_lamp game_controller hair_dryer headphones kettle keyboard"
        " kitchen_scale laptop microphone monitor mouse phone power_bank radio remote_control speaker table_lamp tablet toaster webcam"
    ),
    "lid": _categories("pot_lid"),
}


def is_hollow(category: str) -> bool:
    """Returns whether objects are in an object of a category rather than on it."""
    return category in _POOLS["container"] and category not in _POOLS["carrier"]


def is_electric(category: str) -> bool:
    """Returns whether an object of a category runs on electricity."""
    return category in _POOLS["device"]


@dataclass(frozen=True)
class NounPools:
    """The nouns by pool.

    Attributes:
        nouns: The nouns of each known category.
        unknown: Nouns of objects of no known category.
        elsewhere: Noun phrases of things that are not on the table.
    """

    nouns: Mapping[str, tuple[str, ...]]
    unknown: Sequence[str]
    elsewhere: Sequence[str]

    def sample(self, pool: str, rng: Random) -> str:
        """Returns a noun of a pool, or of nouns separated by ``|``.

        Args:
            pool: A pool of :data:`models.instruction_reader.phrases.POOLS`, or nouns.
            rng: Source of randomness.
        """
        if pool == "unknown":
            return rng.choice(self.unknown)
        if pool not in _POOLS and pool != "any":
            return rng.choice(pool.split("|")).strip()
        chance = rng.random()
        if chance < _UNKNOWN_SHARE and pool != "lid":
            return rng.choice(self.unknown)
        is_any = pool == "any" or (chance < _UNKNOWN_SHARE + _ANY_SHARE and pool != "lid")
        category = rng.choice(self._categories if is_any else _POOLS[pool])
        return rng.choice(self.nouns.get(category) or (" ".join(type_words(category)),))

    @property
    def _categories(self) -> tuple[str, ...]:
        return tuple(self.nouns)


@cache
def read_nouns() -> NounPools:
    """Reads the nouns of the package."""
    synonyms: dict[str, tuple[str, ...]] = {}
    for line in read_lines("synonyms.txt"):
        category, _, names = line.partition(":")
        own = (" ".join(type_words(category)), *nouns_of(category))
        given = (name.strip() for name in names.split(",") if name.strip())
        synonyms[category] = tuple(dict.fromkeys((*own, *given)))
    return NounPools(synonyms, read_lines("unknown.txt"), read_lines("elsewhere.txt"))
