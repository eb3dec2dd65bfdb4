"""Classes and nouns of categories.

A category belongs to the classes of the longest entry that it ends with: a ``coffee_mug`` is a mug, but a ``toothbrush_cup`` is
not a drinking cup. A category without an entry has no class; only kinds of task for any object use it.
"""

from collections.abc import Mapping
from functools import cache, lru_cache
from types import MappingProxyType

from stable_data.instructions.wording.taxonomy import is_kind_of, is_listed
from stable_data.instructions.wording.words import category_words, singular_noun, type_words

_CLASSES: Mapping[str, str] = MappingProxyType(
    {
        # at the table
        "drinkware": "mug, cup, teacup, tumbler, glass, wine glass, goblet, beaker",
        "cup": "mug, cup, teacup",
        "saucer": "saucer, coaster",
        "plate": "plate, dinner plate",
        "bowl": "bowl",
        "fork": "fork",
        "knife": "knife, table knife, butter knife",
        "spoon": "spoon, teaspoon, tablespoon, soup spoon",
        "cutlery": "fork, knife, table knife, butter knife, spoon, teaspoon, tablespoon, soup spoon, chopsticks",
        "tableware": "mug, cup, teacup, tumbler, glass, wine glass, plate, dinner plate, saucer, bowl, fork, knife, table knife, "
        "butter knife, spoon, teaspoon, tablespoon, soup spoon, chopsticks",
        "serving": "plate, dinner plate, tray, serving tray, bowl",
        "pourer": "bottle, pitcher, jug, teapot, kettle, carafe, thermos, decanter, milk carton, juice carton, coffee pot",
        # plants
        "waterer": "watering can, pitcher, jug, carafe",
        "plant": "plant, potted plant, cactus, potted cactus, succulent, bonsai",
        # food and cooking
        "food": "apple, orange, lemon, lime, banana, pear, peach, plum, strawberry, mango, kiwi, avocado, bread, loaf, bun, "
        "roll, baguette, toast, cake, cookie, croissant, donut, muffin, sandwich, burger, cheese, ham, tomato, potato, onion, "
        "carrot, lettuce, steak, egg, bell pepper, cucumber, bun top, bun bottom, burger patty, vegetable patty, cheese slice",
        "fruit": "apple, orange, lemon, lime, banana, pear, peach, plum, strawberry, mango, kiwi",
        "choppable": "apple, orange, lemon, lime, banana, pear, peach, plum, bread, loaf, baguette, bun, tomato, potato, onion, "
        "carrot, lettuce, cheese, ham, cucumber, bell pepper, avocado",
        "fruit_place": "bowl, basket, crate",
        "board": "cutting board, chopping board",
        "blade": "kitchen knife, bread knife, knife",
        "pot": "pot, cooking pot, saucepan, stew pot, casserole, large pot, frying pan, skillet, pan",
        "lid": "lid, pot lid, pan lid, large lid",
        # desk
        "writing": "pen, pencil, marker, highlighter, crayon, paint brush",
        "writing_place": "pen holder, pencil holder, pen cup, pencil cup, pen pot, pencil case",
        "book": "book, notebook, magazine, notepad, novel, journal, cookbook",
        # bathroom and dressing table
        "toothbrush": "toothbrush",
        "toothbrush_place": "toothbrush cup, toothbrush holder",
        "soap": "soap",
        "soap_place": "soap dish",
        "cosmetics": "lipstick, perfume, cream jar, comb, hair brush, makeup brush, nail polish, mascara",
        "cosmetics_place": "jewelry box, storage box, basket, tray, serving tray, makeup bag, box",
        # toys and things to keep them in
        "toy": "car, toy, airplane, toy airplane, rubber duck, duck, puzzle cube, dice, marble, brick, toy brick, block, "
        "wooden block, nesting cup, teddy bear, spinning top, robot, train, ball, brick car, doll",
        "toy_place": "box, storage box, crate, basket, bin",
        "tidy_place": "box, storage box, crate, basket, bin, tray, serving tray, jewelry box",
        # what can be done with it
        "laptop": "laptop",
        "hinged": "jewelry box, lunch box, lunchbox, toolbox, music box, glasses case, lidded box, box with lid",
        "switched": "lamp, desk lamp, speaker, radio, monitor, fan, kettle, coffee machine, toaster",
        "with_front": "laptop, monitor, frame, photo frame, picture frame, clock, alarm clock, mirror, speaker, camera, "
        "television, radio, car, rubber duck, duck, toaster, robot, menu card",
        # shapes
        "stackable": "plate, dinner plate, saucer, bowl, book, notebook, magazine, notepad, novel, nesting cup, brick, "
        "toy brick, block, wooden block, box, storage box, tray, serving tray",
        "upright": "bottle, spray bottle, cleanser bottle, mustard bottle, sauce bottle, lotion bottle, shampoo bottle, can, "
        "watering can, vase, jar, cream jar, tumbler, mug, cup, glass, wine glass, perfume, soap dispenser, salt shaker, "
        "pepper mill, pitcher, jug, carafe, thermos, ketchup",
        "round": "ball, marble, apple, orange, lemon, lime, plum, peach, pear, tomato, potato, onion, egg, strawberry",
        "slender": "pen, pencil, marker, highlighter, crayon, toothbrush, fork, knife, table knife, spoon, chopsticks, whisk, "
        "ladle, spatula, turner, comb, makeup brush, paint brush, kitchen knife, teaspoon, screwdriver",
        "uneven": "fork, knife, table knife, butter knife, kitchen knife, bread knife, spoon, teaspoon, chopsticks, whisk, ladle, "
        "spatula, turner, scissors, pen, pencil, marker, comb, brush, hair brush, toothbrush, keyboard, mouse, remote control, "
        "phone, headphones, stapler, calculator, car, airplane, toy airplane, brick car, rubber duck, duck, banana, lipstick, "
        "plant, potted plant, potted cactus, cactus, frying pan, skillet, laptop, frame, photo frame, picture frame, mirror, "
        "chain, clamp, hammer, wrench, drill, apple, orange, lemon, lime, pear, peach, plum, strawberry, ball, soap, candle, "
        "lid, pot lid, large lid, rail, rack, set, ham, steak, cheese, lettuce, lamp, desk lamp, clock, alarm clock, marble, "
        "bottle, vase, flower vase, wine glass, glass, towel",
        "rubbish_place": "waste bin, trash can",
        "holder": "pen holder, pencil holder, pen cup, pencil cup, pen pot, toothbrush cup, toothbrush holder, utensil holder",
    }
)

_PRESSED: Mapping[str, str] = MappingProxyType(
    {
        "soap dispenser": "the pump",
        "hand sanitizer": "the pump",
        "calculator": "the equals key",
        "keyboard": "the space bar",
        "remote control": "the power button",
        "desk lamp": "the switch",
        "lamp": "the switch",
        "clock": "the button",
        "alarm clock": "the snooze button",
        "stapler": "the upper arm",
        "mouse": "the left button",
        "toaster": "the lever",
        "kettle": "the switch",
        "speaker": "the power button",
        "monitor": "the power button",
        "radio": "the power button",
        "phone": "the side button",
        "tablet": "the home button",
        "camera": "the shutter button",
        "spray bottle": "the spray head",
        "coffee machine": "the start button",
    }
)

_CALLED: Mapping[str, str] = MappingProxyType(
    {
        "mug": "cup, coffee mug",
        "teacup": "cup",
        "tumbler": "glass, drinking glass",
        "drinking glass": "glass",
        "pitcher": "jug",
        "jug": "pitcher",
        "water pitcher": "pitcher, water jug",
        "table knife": "knife, dinner knife",
        "dinner plate": "plate",
        "cereal bowl": "bowl",
        "serving tray": "tray",
        "storage box": "box, storage bin",
        "waste bin": "bin, wastebasket",
        "spice tray": "wire tray",
        "saucepan": "pot",
        "cooking pot": "pot",
        "stew pot": "pot",
        "large pot": "pot, big pot",
        "frying pan": "pan",
        "skillet": "pan, frying pan",
        "pot lid": "lid",
        "large lid": "lid",
        "cutting board": "chopping board",
        "notebook": "notepad",
        "laptop": "laptop computer",
        "monitor": "screen, computer screen",
        "mouse": "computer mouse",
        "phone": "mobile phone, smartphone",
        "tablet": "tablet computer",
        "remote control": "remote",
        "speaker": "loudspeaker",
        "desk lamp": "lamp",
        "table lamp": "lamp",
        "shelf lamp": "lamp",
        "security camera": "camera",
        "pen holder": "pen pot, pencil holder",
        "photo frame": "picture frame, framed photo",
        "picture frame": "photo frame, framed picture",
        "alarm clock": "clock",
        "hair brush": "hairbrush, brush",
        "perfume": "perfume bottle, bottle of perfume",
        "cream jar": "jar of cream",
        "tissue box": "box of tissues",
        "jewelry box": "jewellery box",
        "flower vase": "vase",
        "open vase": "vase",
        "potted plant": "plant, houseplant",
        "potted cactus": "cactus",
        "toy car": "car, model car",
        "rubber duck": "duck, toy duck",
        "puzzle cube": "cube",
        "toy brick": "brick, building brick",
        "toy airplane": "airplane, toy plane",
        "wooden block": "block",
        "soup can": "can of soup, soup tin",
        "tuna can": "can of tuna, tuna tin",
        "coffee can": "can of coffee, coffee tin",
        "meat tin": "tin of meat",
        "can": "tin",
        "sugar box": "box of sugar",
        "cracker box": "box of crackers",
        "gelatin box": "box of gelatin",
        "pudding box": "box of pudding",
        "ketchup": "ketchup bottle, bottle of ketchup",
        "mustard bottle": "bottle of mustard",
        "cleanser bottle": "bottle of cleanser",
        "spice jar": "jar of spice",
        "paper towel": "roll of paper towel, paper roll",
        "book set": "set of books",
        "cushion": "pillow",
        "tennis ball": "ball",
        "golf ball": "ball",
        "mini soccer ball": "soccer ball, ball",
        "sponge": "kitchen sponge",
        "soap": "bar of soap",
    }
)

_UNCOUNTED = frozenset(
    (
        "bread", "soap", "cheese", "ham", "lettuce", "ketchup", "mustard", "perfume", "stew", "meat", "steak", "toast", "mashed",
        "scissors", "headphones", "chopsticks", "glasses", "food", "pieces", "rings", "towel", "wood",
    )
)  # fmt: skip


@cache
def _by_words() -> dict[tuple[str, ...], frozenset[str]]:
    found: dict[tuple[str, ...], set[str]] = {}
    for name, entries in _CLASSES.items():
        for entry in entries.split(", "):
            found.setdefault(category_words(entry), set()).add(name)
    return {words: frozenset(names) for words, names in found.items()}


@lru_cache(maxsize=16384)
def classes_of(category: str) -> frozenset[str]:
    """Returns the classes of a category, possibly none."""
    words = category_words(category)
    ends = (words[start:] for start in range(len(words)))
    return next((_by_words()[end] for end in ends if end in _by_words()), frozenset())


@cache
def known_names() -> tuple[str, ...]:
    """Returns all names that the vocabulary knows, words joined by blanks, sorted."""
    entries = (entry for entries in _CLASSES.values() for entry in entries.split(", "))
    return tuple(sorted({*entries, *_CALLED}))


@lru_cache(maxsize=16384)
def control_part(category: str) -> str | None:
    """Returns the part of a category that can be pressed, such as ``the pump``; None if there is none."""
    words = type_words(category)
    ends = (" ".join(words[start:]) for start in range(len(words)))
    return next((_PRESSED[end] for end in ends if end in _PRESSED), None)


@lru_cache(maxsize=16384)
def nouns_of(category: str) -> tuple[str, ...]:
    """Returns the nouns of a category, its own words first; empty if it has no words."""
    noun = " ".join(type_words(category))
    others = _CALLED.get(noun, "")
    return tuple(n for n in (noun, *others.split(", ")) if n)


def is_counted(noun: str) -> bool:
    """Whether a noun is countable."""
    return noun.split(" ")[-1] not in _UNCOUNTED


@lru_cache(maxsize=16384)
def answers_to(category: str, noun: str) -> bool:
    """Whether a noun can mean an object of a category: ``glass`` can mean a ``wine_glass``, ``cup`` a mug."""
    asked = singular_noun(noun)
    return any(singular_noun(own).endswith(asked) for own in nouns_of(category))


@lru_cache(maxsize=16384)
def closeness(found: str, wanted: str) -> int:
    """How well a category fits a wanted one: 2 the same words, 1 a name of the wanted one or a kind of it, 0 something else.

    What is a kind of what follows from the :mod:`~stable_data.instructions.wording.taxonomy`; for a category that it does not list,
    from the last words. A name that the vocabulary has for the wanted category fits too: a ``cup`` for a ``mug``.
    """
    found_words, wanted_words = category_words(found), category_words(wanted)
    if not found_words or not wanted_words:
        return 0
    if found_words == wanted_words:
        return 2
    if is_kind_of(found, wanted):
        return 1
    names = _names_of(found)
    if is_listed(found) and is_listed(wanted):  # the taxonomy knows better than the last words
        is_name = wanted_words in names or found_words in _names_of(wanted)
    else:
        is_name = any(noun[-len(wanted_words) :] == wanted_words for noun in names) or found_words in _names_of(wanted)
    found_classes, wanted_classes = classes_of(found), classes_of(wanted)
    # A category that the vocabulary does not know has no classes, which must not exclude it.
    return int(is_name and (bool(found_classes & wanted_classes) or not (found_classes and wanted_classes)))


@lru_cache(maxsize=16384)
def _names_of(category: str) -> tuple[tuple[str, ...], ...]:
    return tuple(category_words(noun) for noun in nouns_of(category))
