"""What the words of an edit say more surely than the network: contrasts, places of others, turns, things without a name, details.

Each rule changes the reading of an instruction by what a fixed turn of phrase says. The rules name no objects of a scene, so they
hold for any scene. The reader may have found the same; then a rule changes nothing.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise

from models.instruction_reader.lexicon import Lexicon
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reading import InstructionReading, MentionedRelation
from models.instruction_reader.sentences import split_words
from models.instruction_reader.spoken_cells import spoken_cells
from models.semantic_reasoner.edit_planning.candidates import adjectives_of
from models.semantic_reasoner.edit_planning.spoken_mentions import EXCHANGE, LOOK_WORDS, SpokenMentions
from models.semantic_reasoner.edit_planning.spoken_text import IsDetail
from models.semantic_reasoner.edit_planning.turns import yaw_after_turn

OTHER = "other"
"""Kind of a stated relation whose subject is none of its target's objects."""

PLACE = "place"
"""Kind of a goal whose subject goes where its target was."""

_INSTEAD = re.compile(r"\b(?:inst\w{1,4}d of|in place of|in lieu of|rather than) ")
_TURN = re.compile(
    r"\b(?:turn|rotate|spin|swivel|twist) (?!off|on|down|up|out|into)(?:the |my |that |this )?(?![^.,;!?]* into )"
)
_BY = re.compile(r"(?: that is (?:[\w-]+ ){1,6}?)? ?(?<= )(?:for|with|by) (?P<one>one\b(?! of)|some\b)?")
_ADJECTIVE_ONES = re.compile(r"((?:[\w-]+ ){1,3})ones?\b")
_MAKE = re.compile(r"\bmake (?:that|it|this|them|those) (?:into )?(?:a|an|some) ")
_WAS = re.compile(r"\bwhere (?:the|that|my|those|these) (?:[\w-]+ ){0,2}$")
_IS_THERE = re.compile(r"^ ?(?:now )?(?:is|are|was|were|used to|has been|had been|stood|stands|sat|sits|lay|lies)\b")
_ITS_PLACE = re.compile(
    r"\b(?:have|take|takes|get|gets|in|into|to) (?:its|their|his|her|that|the same|the freed|the free) (?:place|spot)\b"
)
_PLACE_OF = re.compile(r"\b(?:have|take|takes|get|gets) the (?:place|spot) of ")
_ACROSS = re.compile(r"\b(?:the )?(?:other|opposite) side of (?:the |that |my |this )?$")
_GOES = re.compile(
    r"(?:\b(?:have|has|need|needs|ought) to|\b(?:can|must|should|may|could))(?: \w+ly)?(?: all| both)? "
    r"(?:go|disappear|vanish|be (?:removed|deleted|taken away|thrown (?:out|away)|binned))\b\s*(?=[.,;:!?)]|and\b|because\b|$)"
)
_REMOVED = re.compile(
    r"\b(?:delete|remove|bin|ditch|scrap|trash|lose|(?:get|be) rid of|throw (?:\w+ )?(?:out|away)|chuck (?:\w+ )?out|toss (?:\w+ )?out"
    r"|off with|out with|away with|take (?:it|that|them) away|clear (?:it|that|them) away|don't want (?:it|that|them))\b"
)
_KEEP = re.compile(r"\b(?:keep|leave|spare)(?: only| just)?(?: the| my| those| these| both| all)*(?: \w+)? $")
_BUT = re.compile(r"\b(?:everything|all|anything)(?: else)? (?:but|except(?: for)?|apart from|other than) (?:the |my |that )?$")
_THERE = re.compile(r" (?:there|in (?:its|their|that) place|instead)\b")
_TABLES = frozenset({"counter", "countertop", "desk", "desktop", "table", "tabletop", "vanity", "worktop"})
"""Nouns of the table itself."""
_LEAD = 12  # characters before a mention that may say that it goes: "bin the perfume"
_STAYS = re.compile(r"^ ?(?:can |may |should |must |will )?stays?\b")
_TAKE_OUT = re.compile(
    r"\b(?:take (?:out|away)|get rid of|throw (?:out|away)|clear (?:away|off)|bin|remove|delete) "
    r"(?:the|my|our|both|all|those|these|that|this)(?: [\w-]+){0,2} $"
)
_ALONG = re.compile(
    r"^,? (?:(?:along|together) with (?:its|their|the|that|all)(?: the)?|(?:plus|as well as|with) (?:its|their)) "
)
_IT_HAS = (
    r"(?:what(?:ever)?|everything|anything|all|the stuff|the things)(?:'s| is| that is| that's)? (?:in|on|inside) (?:it|them)"
)
_CONTENTS = re.compile(
    rf"\b(?:and|with|plus)(?: all)? (?:{_IT_HAS}|(?:its|their|the) (?:whole |entire )?contents)\b|\bcontents and all\b"
)
_WHERE_IT_WAS = re.compile(
    r"\b(?:to|into|over) where (?:it|that|this|they|those)(?: one)? (?:is|are|was|were|stood|stands|sat|sits|lay|lies|used to be)\b"
)
_REST = re.compile(
    r"\bthe (?:others?(?: ones?)?|rest(?: of \w+)?|third(?: one)?|fourth(?: one)?|remaining (?:ones?|two|three|four))\b"
    r"(?! side| end| hand)"
)
_AS_WELL = re.compile(r"\b(?:as well|too|also|in addition|additionally|another|one more)\b")
_REPLACING = re.compile(
    r"\b(?:inst\w{1,4}d|rather|replac\w*|swap\w*|exchang\w*|switch\w*|trad\w*|substitut\w*|chang\w*|mak\w*|turn\w*|in place|place|spot|"
    r"where|for|out|could (?:that|it|this) be|over)\b"
)


@cache
def _elsewhere() -> re.Pattern[str]:
    """Places off the table that something goes to; the nouns are read when an edit first needs them."""
    nouns = "|".join(sorted({re.escape(noun) for noun in read_nouns().elsewhere}))
    return re.compile(rf"\b(?:back )?(?:in|into|to|on|onto|inside) (?:the|my|our|your) (?:[\w-]+ )??(?:{nouns})\b")


def with_spoken_changes(reading: InstructionReading, text: str, lexicon: Lexicon, is_detail: IsDetail) -> InstructionReading:
    """Returns a reading with what fixed turns of phrase say.

    Args:
        reading: The reading of an edit.
        text: The edit.
        lexicon: The known nouns.
        is_detail: Whether a word describes objects of a category.
    """
    found = _SpokenChanges(reading, text, lexicon, is_detail)
    for rule in (
        found.corrected,
        found.without_verbs,
        found.without_colours,
        found.looks,
        found.heads,
        found.things,
        found.unnamed,
        found.details,
        found.purposes,
        found.turns,
        found.instead,
        found.exchanged,
        found.made,
        found.where_it_was,
        found.its_place,
        found.other_side,
        found.on_the_table,
        found.there,
        found.goes,
        found.kept,
        found.put_away,
        found.rest,
        found.as_well,
        found.owned,
        found.removed,
        found.taken_out,
        found.with_contents,
        found.placed,
        found.moved,
        found.along,
    ):
        rule()
    return replace(reading, objects=tuple(found.objects), start=tuple(found.start), goal=tuple(found.goal))


class _SpokenChanges(SpokenMentions):
    """The rules for changes."""

    def turns(self) -> None:
        """Finds turns: "give it a quarter turn", "turn the kettle round"."""
        for m in _TURN.finditer(self._text):
            turned = self._at(m.end(), 2)
            if turned is None or self._has_role(turned):
                continue
            end = next(b for a, b, k in self._places() if k == turned and a >= m.end())
            clause = re.split(r"[.,;!?:]| and | so ", self._text[end:])[0]
            look = self._add(f"{m[0].strip()} {clause.strip()}".strip(), (m.start(), m.end()))
            self.goal.append(MentionedRelation(turned, "style", look))
        for start, _, k in self._places():
            one = self.objects[k]
            if one.categories or yaw_after_turn(one.words.split(), 0) is None or any(r.target == k for r in self.goal):
                continue
            turned = next((r.target for r in self.goal if r.subject == k), self._before(start, same_sentence=False))
            if turned is not None and turned != k:
                self._forget(k)
                self.goal.append(MentionedRelation(turned, "style", k))

    def instead(self) -> None:
        """Finds what comes, and what it replaces: "a mug instead of the glass"."""
        for m in _INSTEAD.finditer(self._text):
            old = self._at(m.end(), 2)
            if old is None or any(r.kind == "style" and r.target == old for r in self.goal):
                continue
            before = self._before(m.start())
            new = self._last_new(m.start()) if before is not None else self._after(self.objects[old].mentions[-1][1])
            if new is None or old in self._family(new) or any(r.kind == "style" and r.subject == new for r in self.goal):
                continue
            self._forget_between(new, old)
            self._change(old, "")
            self.goal.append(MentionedRelation(new, "replace", old))

    def exchanged(self) -> None:
        """Finds exchanges: "swap the can for a bottle", "we want steak, exchange the patty for one"."""
        for m in EXCHANGE.finditer(self._text):
            old = self._at(m.end(), 1)
            if old is None or self._has_exchange(old):
                continue
            end = next(b for a, b, k in self._places() if k == old and a >= m.end())
            by = _BY.match(self._text[end:])
            if by is None:
                continue
            own = self._family(old)
            self.goal = [r for r in self.goal if r.kind != "replace" or r.subject not in own]  # it goes, so it does not come
            earlier = [k for start, _, k in self._places() if start < m.start() and k != old and not self._has_role(k)]
            new = (earlier[-1] if earlier else None) if by["one"] else self._at(end + by.end(), 2)
            ones = _ADJECTIVE_ONES.match(self._text[end + by.end() :])
            if new is None and ones is not None and set(ones[1].split()) <= LOOK_WORDS:
                new = self._add(ones[1].strip(), (end + by.end(), end + by.end() + ones.end()))
            if new is not None and new not in self._family(old):
                self._forget_between(new, old)
                is_look = set(self.objects[new].words.split()) <= LOOK_WORDS  # "all jars for clear ones"
                self.goal.append(MentionedRelation(old, "style", new) if is_look else MentionedRelation(new, "replace", old))

    def _has_exchange(self, number: int) -> bool:
        """Whether an object is known to be exchanged; one that is read as coming is not, as it is what goes."""
        own = self._family(number)
        return any(
            (r.kind in ("swap", "style", PLACE) and {r.subject, r.target} & {*own}) or (r.kind == "replace" and r.target in own)
            for r in self.goal
        )

    def made(self) -> None:
        """Replaces what was spoken of: "No wine at lunch! Make that a jug of water"."""
        for m in _MAKE.finditer(self._text):
            new = self._at(m.end(), 3)
            if new is None or not self.objects[new].categories or self._has_role(new):
                continue
            old = self._before(m.start(), same_sentence=False)
            if old is None:
                nouns = [n for n in re.finditer(r"[a-z]+", self._text[: m.start()]) if self._lexicon.is_noun(n[0])]
                if not nouns:  # "make it a steel kettle"
                    one = self.objects[new]
                    old = self._add(one.words.split()[-1], one.mentions[0], one.categories)
                    self.goal.append(MentionedRelation(old, "style", new))
                    continue
                old = self._add(nouns[-1][0], nouns[-1].span(), self._lexicon.categories([nouns[-1][0]]))
            if not set(self.objects[old].categories) & set(self.objects[new].categories):
                self.goal.append(MentionedRelation(new, "replace", old))

    def _last_new(self, position: int) -> int | None:
        """The last new object before a position in its sentence; the thing that moves in "the mug on the tray" if it is new."""
        least = max((m.end() for m in re.finditer(r"[.!?;]", self._text[:position])), default=0)
        aims = {r.target for r in self.goal}
        found = [k for start, end, k in self._places() if least <= start and end <= position and self._is_new(k)]
        movers = [k for k in found if k not in aims]
        return movers[-1] if movers else None

    def _forget_between(self, one: int, other: int) -> None:
        own, its = set(self._family(one)), set(self._family(other))
        keep = [r for r in self.goal if not ({r.subject, r.target} & own and {r.subject, r.target} & its)]
        self.goal = keep
        self.start = [r for r in self.start if not ({r.subject, r.target} & own and {r.subject, r.target} & its)]

    def where_it_was(self) -> None:
        """Finds places of what goes or moves: "where the loaf was, lay a knife"."""
        for start, end in sorted({place for one in self.objects for place in one.mentions}):
            if not _WAS.search(self._text[:start]) or not _IS_THERE.match(self._text[end:]):
                continue
            old = next(k for a, b, k in self._places() if (a, b) == (start, end))
            clause = _WAS.search(self._text[:start])
            assert clause is not None
            new = self._before(clause.start())
            lead = self._text[: clause.start()]
            if new is None or re.search(r"(?:^|[.,;!?] ?)(?:and |then |and then )?$", lead):
                new = self._after(end)
            if new is not None and old in self._family(new) and len(self.objects[old].mentions) > 1:
                old = self._apart(old, (start, end))  # "put a hand mirror where the mirror is"
            if new is not None and old not in self._family(new):
                self._to_place(new, old)

    def _apart(self, number: int, place: tuple[int, int]) -> int:
        """Makes one of the mentions of an object an object of its own."""
        for k in self._family(number):
            rest = tuple(other for other in self.objects[k].mentions if other != place)
            self.objects[k] = replace(self.objects[k], mentions=rest)
        words = split_words(self._text[slice(*place)])
        return self._add(" ".join(words), place, self._lexicon.categories(words))

    def its_place(self) -> None:
        """Finds the place of what was last said to go: "the plant can have its place"."""
        for m in [*_ITS_PLACE.finditer(self._text), *_WHERE_IT_WAS.finditer(self._text)]:
            new = self._before(m.start())
            if new is None:
                continue
            gone = [k for start, _, k in self._places() if start < m.start() and k != new and self._has_role(k)]
            if gone:
                self._to_place(new, gone[-1])

        for m in _PLACE_OF.finditer(self._text):
            new, old = self._before(m.start()), self._at(m.end(), 2)
            if new is not None and old is not None and old not in self._family(new):
                self._to_place(new, old)

    def there(self) -> None:
        """Puts something new where something goes: "bin the perfume and put a deodorant there"."""
        for start, end, new in self._places():
            old = self._before(start, same_sentence=False)
            if old is None or old in self._family(new) or not self._is_new(new) or not _THERE.match(self._text[end:]):
                continue
            old_start = min(a for a, _, k in self._places() if k == old)
            goes = any(self.objects[k].change == "remove" for k in self._family(old))
            if goes or _REMOVED.search(self._text[max(0, old_start - _LEAD) : start]):
                self._forget_between(new, old)
                self.goal.append(MentionedRelation(new, "replace", old))

    def on_the_table(self) -> None:
        """Takes a place of the table for one of an object: "in the front middle of the vanity"."""
        cells = spoken_cells(split_words(self._text))
        for r in list(self.goal):
            for table, other in ((r.target, r.subject), (r.subject, r.target)):
                if set(self.objects[table].words.split()[-1:]) <= _TABLES and not self.objects[table].categories:
                    self.goal.remove(r)
                    if not cells and r.kind == "on" and not self._has_role(other) and not self._is_new(other):
                        self._change(other, "away")  # it was on something else
                    elif len(cells) == 1 and not self.objects[other].goal_region:
                        self.objects[other] = replace(self.objects[other], goal_region=next(iter(cells)))
                    break

    def kept(self) -> None:
        """Keeps what is said to stay: "the red one may go, the yellow one stays", "all but the notebook"."""
        for start, end, k in self._places():
            stays = _STAYS.match(self._text[end:]) or _KEEP.search(self._text[:start]) or _BUT.search(self._text[:start])
            if stays and self.objects[k].change == "remove":
                self._change(k, "")

    def _to_place(self, new: int, old: int) -> None:
        if any(r.kind in ("replace", "swap") and {r.subject, r.target} == {new, old} for r in self.goal):
            return
        own = self._family(old)
        leaves = any(self.objects[k].change == "remove" or self.objects[k].goal_region for k in own)
        leaves = leaves or any(r.subject in own and r.target not in self._family(new) for r in self.goal)
        self._forget_between(new, old)
        self.goal.append(MentionedRelation(new, PLACE if leaves else "replace", old))

    def other_side(self) -> None:
        """Finds the other side of an object: "the box would be handier on the other side of the mirror"."""
        for start, _, target in self._places():
            clause = _ACROSS.search(self._text[:start])
            if clause is None or any(r.kind == "near" and target in (r.subject, r.target) for r in self.goal):
                continue
            looks = {r.target for r in self.goal if r.kind == "style"}
            movers = [k for a, _, k in self._places() if a < clause.start() and k != target and k not in looks]
            if movers and not any(r.subject == movers[-1] and r.kind != "style" for r in self.goal):
                self.goal = [r for r in self.goal if r.subject != movers[-1]]
                self.goal.append(MentionedRelation(movers[-1], "near", target))

    def goes(self) -> None:
        """Removes what goes without a place: "the marbles have to go"."""
        for m in _GOES.finditer(self._text):
            one = self._before(m.start())
            if one is not None and not any({r.subject, r.target} & {*self._family(one)} for r in self.goal):
                for k in list(self._named_alike(one)):
                    self.objects[k] = replace(self.objects[k], change="remove", name=self.objects[one].name)

    def _named_alike(self, number: int) -> Iterator[int]:
        """The objects with the same mention: a plural and its parts."""
        mentions = self.objects[number].mentions
        return (k for k, one in enumerate(self.objects) if one.mentions == mentions)

    def put_away(self) -> None:
        """Removes what goes to a place off the table: "the beans can go back in the larder"."""
        for m in _elsewhere().finditer(self._text):
            one = self._before(m.start())
            inside = [k for start, end, k in self._places() if start < m.end() and end > m.start()]
            if one is None or any(self.objects[k].categories for k in inside) or "from" in self._text[: m.start()].split()[-4:]:
                continue
            for k in inside:
                self._forget(k)
            if not self._has_role(one):
                self._change(one, "remove")

    def rest(self) -> None:
        """Removes the others of a kind: "keep the two pink ones, drop the third"."""
        for m in _REST.finditer(self._text):
            kept = [
                k
                for start, end, k in self._places()
                if end <= m.start() and (_KEEP.search(self._text[:start]) or _STAYS.match(self._text[end:]))
            ]
            if not kept or not self.objects[kept[-1]].categories:
                continue
            self._split(kept[-1], m)
        for m in re.finditer(r"\b(?:keep|leave|only)(?: \w+)? ", self._text):
            kept_after = self._at(m.end(), 3)
            if kept_after is None:
                continue
            lead = _REST.search(self._text[: m.start()])
            if lead is not None and self.objects[kept_after].categories:
                self._split(kept_after, lead)

    def _split(self, kept: int, m: re.Match[str]) -> None:
        """Lets an object stay, with all that is called the same, and adds the others of its kind, which go."""
        one = self.objects[kept]
        adjectives = adjectives_of(one)
        noun = [word for word in one.words.split() if word not in adjectives]
        alike = list(self._named_alike(kept))
        if any(one.mentions and m.start() <= one.mentions[0][0] < m.end() for one in self.objects):
            return  # the reader found them
        for k in alike:
            self.objects[k] = replace(self.objects[k], change="", name=one.name, is_one_of_many=one.is_one_of_many)
        self.goal = [r for r in self.goal if r.subject not in alike]
        rest = self._add(" ".join(noun), (m.start(), m.end()), one.categories, is_open=True)
        self.objects[rest] = replace(self.objects[rest], change="remove")
        self.start.append(MentionedRelation(rest, OTHER, kept))

    def as_well(self) -> None:
        """Lets what comes in addition replace nothing: "toss a lemon in as well"; what is replaced is not new."""
        replaced = [r for r in self.goal if r.kind == "replace"]
        for r in replaced:
            if any(other.target == r.subject and other.score > r.score for other in replaced):
                self.goal.remove(r)
        placed = {r.subject for r in self.goal if r.kind not in ("replace", "style", "swap", PLACE)}
        if _AS_WELL.search(self._text) and not _REPLACING.search(self._text):
            self.goal = [r for r in self.goal if r.kind != "replace" or r.subject not in placed]

    def owned(self) -> None:
        """Keeps, of two with one place, the new one: "where do I keep my toothbrush? A cup in front of the soap"."""
        coming = {
            (r.kind, r.target): self.objects[r.subject].name for r in self.goal if self.objects[r.subject].change == "add"
        }
        self.goal = [
            r
            for r in self.goal
            if self.objects[r.subject].change
            or self._is_new(r.subject)
            or coming.get((r.kind, r.target), self.objects[r.subject].name) == self.objects[r.subject].name
        ]

    def removed(self) -> None:
        """Removes what is mentioned before such words, if nothing else is understood: "Is that a duck? Off with it"."""
        if self.goal or any(one.change or one.goal_region for one in self.objects):
            return
        for m in _REMOVED.finditer(self._text):
            unnamed = [k for k, one in enumerate(self.objects) if not one.words]
            one = unnamed[0] if unnamed else self._before(m.start(), same_sentence=False)
            if one is not None:
                self._change(one, "remove")

    def taken_out(self) -> None:
        """Removes what is taken out, if nothing else is said of it: "take out the two candles and move the vase"."""
        for start, _, k in self._places():
            if not self._has_role(k) and _TAKE_OUT.search(self._text[:start]):
                self._change(k, "remove")

    def moved(self) -> None:
        """Lets an object stay that has a place: "palette: gone. Jar: to the left of the lipstick"."""
        for r in self.goal:
            if r.kind not in ("replace", "style", "swap", PLACE) and self.objects[r.subject].change == "remove":
                self._change(r.subject, "")

    def along(self) -> None:
        """Removes two that go together: "the tumbler along with its coaster"."""
        for (_, end, k), (start, _, other) in pairwise(self._places()):
            if _ALONG.match(self._text[end:start]):
                changes = {self.objects[k].change, self.objects[other].change}
                for number in (k, other) if changes == {"", "remove"} else ():
                    if not self._has_role(number):
                        self._change(number, "remove")

    def with_contents(self) -> None:
        """Removes what a removed object carries too: "take the crate and whatever is in it"."""
        for m in _CONTENTS.finditer(self._text):
            carrier = self._before(m.start(), same_sentence=False)
            if carrier is not None and self.objects[carrier].change == "remove":
                content = self._add("", m.span(), is_open=True)
                self._change(content, "remove")
                self.start.append(MentionedRelation(content, "on", carrier))

    def placed(self) -> None:
        """Puts a new object of which no place is read into the only place of the table that is spoken of."""
        cells = spoken_cells(split_words(self._text))
        new = {one.name for one in self.objects if one.change == "add"}
        if len(cells) != 1 or len(new) != 1:
            return
        for k, one in enumerate(self.objects):
            is_placed = one.goal_region or one.region or any(k in (r.subject, r.target) for r in self.goal)
            if one.change == "add" and not is_placed:
                self.objects[k] = replace(one, goal_region=next(iter(cells)))
