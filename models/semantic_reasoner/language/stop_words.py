"""Common English words that do not name an object on a table, for parsers that know no grammar except word order."""

from collections.abc import Iterator


def word_set(text: str) -> frozenset[str]:
    """Splits a text at white space into a set of words."""
    return frozenset(text.split())


DETERMINERS = word_set(
    "the a an my your his her our their its this that these those each every another either some any no both all"
)
"""Words that open a noun phrase."""

_NUMBERS = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")

COUNTS = {
    **{w: n for n, w in enumerate(_NUMBERS, 2)},
    "both": 2,
    "pair": 2,
    "couple": 2,
}
"""Words that give a number of objects, with the number."""

NONE_OF = frozenset({"no", "any", "without", "neither"})
"""Words before a noun that deny it."""

PREPOSITIONS = word_set(
    """about above across after against along among around at before behind below beneath beside besides between beyond by
    down from in inside into near next of off on onto out outside over past through toward towards under underneath until
    up upon with within without"""
)

FUNCTION_WORDS = (
    DETERMINERS
    | PREPOSITIONS
    | NONE_OF
    | frozenset(COUNTS)
    | word_set(
        """i me myself mine you yours yourself he him himself she hers herself it itself we us ourselves ours they them
        themselves theirs who whom whose which what whatever whichever whoever someone somebody anyone anybody everyone everybody
        nobody something anything everything nothing one ones other others another such same own
        and or but nor so yet if because since although though while whereas whether unless until than as when whenever where
        wherever how why that then there here now again once twice never always often sometimes soon later already still just
        only even also too very quite rather really almost exactly well maybe perhaps please thanks thank yes ok okay hey hi hello
        not t s d ll re ve m don doesn didn isn aren wasn weren won wouldn can couldn shouldn hasn haven hadn cannot theres
        is am are was were be been being do does did done doing have has had having will would shall should may might must could
        ought need needs needed let lets to for like of away back forward forwards backwards together apart aside ahead
        more most less least much many few little bit lot enough several first second third last next half whole
        left right front rear top bottom side sides middle centre center corner edge end far near close closer nearer nearest
        farther farthest further furthest leftmost rightmost upper lower inner outer opposite
        upright upside sideways lengthwise crosswise clockwise anticlockwise counterclockwise diagonal horizontal vertical straight
        somewhere anywhere elsewhere everywhere nowhere instead otherwise careful sure afterwards beforehand meanwhile okay ugh
        oh ah wow oops pls ones"""
    )
)
"""Words of grammar, place and number, which are never the noun of an object."""

VERBS = word_set(
    """accept add adjust align allow appear arrange ask attach avoid belong bring build bump call care carry catch change check
    choose clean clear close collect come connect contain cook cover cut deal deliver detach dig disappear discard drag draw
    drink drop dust eat empty end ensure evict expose face fall feel fetch fill find finish fish fit fix flank flip fold follow
    gather get give glare go going gone grab grasp grip group guess hand hang happen help hide hold hover insert jam join keep
    kick know lay lean leave lets lie lift line load look lose love lower make mean measure meet mind mix mount move nudge offer
    open order organise organize own pack park pass perch pick pile place play plug point polish position pour present press
    prop pull push put raise reach read rearrange release remove reorder replace rescue reset rest retrieve return roll rotate
    scoop seat see seem select send separate serve set shake shift shove show sit slide smell sort space spin spoil spread
    squeeze stack stand start stay stick stop store stow straighten stretch swap sweep switch take tap tell tidy tilt tip touch
    trade transfer transport try tuck turn twist unpack unplug unstack upend use vanish wait wake walk wander want wash watch
    water wipe wish work wrap write spend got gotten stuck kept held took taken brought gave given came went gone made found lay
    laid lain lying sat stood left lost broke broken fell fallen forgot forgotten hung hid hidden knew known meant met read ran
    said saw seen sent set shook slid spilt spilled spoke spoilt spun stole stuck swept told thought threw thrown wore
    breathe check decide deserve forget hate hurry ignore knock print remember remind repeat reposition say speak spill steal
    think throw treat unload wear wobble worry"""
)
"""Verbs of everyday requests, in their first form."""

OFF_THE_TABLE = word_set(
    """person people man woman boy girl kid kids child children baby son daughter mother father mum mom dad brother sister wife
    husband friend friends guest guests visitor visitors boss colleague user human owner family anna cat dog pet robot gripper
    hand hands arm arms finger fingers head face eye eyes hair tooth teeth mouth foot feet body back neck skin nose ear ears lap
    table tabletop counter countertop desk desktop worktop nightstand bench surface shelf cupboard cabinet drawer floor wall
    ceiling window door room kitchen bathroom bedroom office house home sink stove oven fridge socket cable wire shade light sun
    shadow chair sofa bed time times moment minute minutes second seconds hour hours day days night tonight today tomorrow
    yesterday morning evening week year breakfast lunch dinner supper meal meals party movie film music song game work job task
    chance way ways place places spot spots position positions area areas space spaces room gap gaps distance order row rows line
    lines stack pile heap group pair set sets kind kinds sort sorts type types shape colour color size height width depth length
    angle direction degree degrees cm mm m centimetre centimetres centimeter centimeters millimetres inch inches metre metres
    view look sight reach use thing things object objects item items stuff piece pieces part parts rest bunch mess fire smoke
    ring stain stains dust water coffee tea milk juice wine drink drinks food snack content contents idea problem trouble reason
    question mind help hurry trip rush luck sense world life name word words number numbers heart peace morning sleep habit
    handle rim edge lid cap tip point base stand surface underside inside outside
    button buttons key keys pump switch lever arm shutter bar"""
)
"""Nouns of people, rooms, times and places in requests, not of objects on a table."""

HOMOGRAPHS = word_set(
    "can set watch plant light lock block box brush drill file iron stamp rest bin fan pan ruler marker train orange"
)
"""Nouns that are often another part of speech: they mean an object only after a determiner."""


def is_verb(word: str) -> bool:
    """Whether a word is a form of a common verb: ``wipes``, ``wiping``, ``grabbed``."""
    return any(stem in VERBS for stem in _stems(word))


def _stems(word: str) -> Iterator[str]:
    yield word
    for ending in ("s", "es", "ed", "ing", "d"):
        if word.endswith(ending) and len(word) > len(ending) + 1:
            stem = word[: -len(ending)]
            yield from (stem, f"{stem}e")
            if len(stem) > 2 and stem[-1] == stem[-2]:
                yield stem[:-1]
