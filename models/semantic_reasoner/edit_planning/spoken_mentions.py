"""What the words of an edit say of its mentions: which are objects, by what they are called, and what is a part of another one."""

import re
from dataclasses import replace
from itertools import pairwise

from models.instruction_reader.phrases import ADJECTIVES
from models.instruction_reader.reading import MentionedRelation
from models.instruction_reader.sentences import split_words
from models.semantic_reasoner.edit_planning.spoken_text import SpokenText

LOOK_WORDS = frozenset(word for phrase in ADJECTIVES for word in phrase.split())
"""Words of adjectives."""

_THING = re.compile(
    r"\b(?P<head>(?:the|that|this|a|those|these)(?P<adjectives>(?: (?!a\b|an\b|the\b)[\w-]+){0,2}?)"
    r" (?:things?|thingy|object|item|gadget|contraption))\b"
    r"(?: with (?:the|a|an|its|that) (?P<detail>[\w-]+(?: [\w-]+)??)"
    r"(?=[.,;:!?]| (?:in|on|at|by|is|makes|looks|has|can|should|and|out)\b|$))?"
)
_NOTHING = frozenset({"thing", "gadget", "contraption", "item", "object", "thingy"})
_CARRIES = re.compile(r"^\s*(?:in|on|inside) it\b")
_UNNAMED = re.compile(
    r"\b(?:what(?:'s| is| are)?|whatever(?: is|'s)?|the thing|that|something|anything)(?: that| lying| sitting| standing| stuff)?"
    r" (?P<where>(?:in )?between|behind|in front of|next to|beside|on top of) (?:the |my |that )"
)
_WHERE = {
    "between": "between",
    "in between": "between",
    "in front of": "front",
    "next to": "near",
    "beside": "near",
    "on top of": "on",
}
_ON_SECOND_THOUGHT = re.compile(r"[.!?;] (?:actually,? no|no,? actually|no,? wait|on second thoughts?|wait,? no)\b,?")
_NO_I_MEAN = re.compile(
    r"(?:\.\.\.? ?|, ?| [-–—] ?)(?:no,? wait|wait,? no|no,? i mean|i mean|no,? sorry|sorry,? i mean|no,|or rather)\b ?,?"
)
_LAST_OF_VERB = frozenset({"stand", "sit", "lie", "rest", "hang", "go", "live"})
_AFTER_VERB = re.compile(r"^ (?:there|here|in|on|at|behind|beside|next|by|instead)\b")
_DETAIL = re.compile(r"^,? (?:with|without|full of|(?P<of>of)) (?:(?:a|an|its|the|\d+|two|three|four|six|eight|twelve) )?$")
_AND_DETAIL = re.compile(r"^,? and (?:(?:a|an|its|two|three|four) )?$")
_PURPOSE = re.compile(r"^ for (?:under )?(?:a|an|my|the|our|her|his)? ?(?:\w+ing |red |white )?$")

_CONTENTS = re.compile(r"^ (?:for|with|of|holding|full of) (?:the |my |all the |our )?$")

EXCHANGE = re.compile(
    r"\b(?:exchange|swap|replace|trade|switch|substitute|change) (?:all |both )?(?:the |that |this |my |these |those )?"
)
"""Verbs of exchanges."""


class SpokenMentions(SpokenText):
    """The rules for mentions."""

    def corrected(self) -> None:
        """Forgets what is taken back: "behind the cards... no, I mean behind the ball"."""
        found = [*_NO_I_MEAN.finditer(self._text), *_ON_SECOND_THOUGHT.finditer(self._text)]
        for m in found:
            wrong, right = self._before(m.start()), self._after(m.end())
            if wrong is None or right is None or wrong in self._family(right):
                continue
            if len(self.objects[wrong].mentions) == 1:
                self._forget(wrong)

    def without_verbs(self) -> None:
        """Takes verbs from mentions: "could a framed picture stand there"."""
        for start, end, k in self._places():
            words = self.objects[k].words.split()
            if len(words) > 1 and words[-1] in _LAST_OF_VERB and _AFTER_VERB.match(self._text[end:]):
                noun = words[:-1]
                cut = (start, end - len(words[-1]) - 1)
                for n in self._family(k):
                    self.objects[n] = replace(
                        self.objects[n], words=" ".join(noun), categories=self._lexicon.categories(noun), mentions=(cut,)
                    )

    def without_colours(self) -> None:
        """A mention of adjectives alone is no object that comes or goes."""
        looks = {r.target for r in self.goal if r.kind == "style"}
        for k, one in enumerate(self.objects):
            if k not in looks and not self._lexicon.categories(one.words.split()) and set(one.words.split()) <= LOOK_WORDS:
                self.objects[k] = replace(one, change="", goal_region="")
                self.goal = [r for r in self.goal if k not in (r.subject, r.target)]

    def looks(self) -> None:
        """Joins the words of a look, as in "mint green", and gives it to a carrier alone: "the cup for the brushes in green"."""
        looks = {r.target for r in self.goal if r.kind == "style"}
        for (start, end, k), (first, stop, other) in pairwise(self._places()):
            more = self.objects[other].words.split()
            if k in looks - {other} and self._text[end:first] == " " and set(more) <= LOOK_WORDS and not self._has_role(other):
                words = " ".join([*self.objects[k].words.split(), *more])
                self.objects[k] = replace(self.objects[k], words=words, mentions=((start, stop),))
                self.goal = [r for r in self.goal if other not in (r.subject, r.target)]
                self._forget(other)
        styled = {r.subject for r in self.goal if r.kind == "style"}
        for (_, end, k), (first, _, other) in pairwise(self._places()):
            own = self._family(other)
            is_content = any(r.subject in own and r.target == k for r in self.start) and _CONTENTS.match(self._text[end:first])
            if {k, other} <= styled and is_content:
                self.goal = [r for r in self.goal if r.kind != "style" or r.subject not in own]

    def heads(self) -> None:
        """Finds the noun of a phrase: after ``of`` in "two bits of toy plane", but before ``with`` in "a radio with a handle"."""
        for k, one in enumerate(self.objects):
            words = one.words.split()
            if not one.categories and "with" in words[1:]:
                self.objects[k] = replace(one, categories=self._lexicon.categories(words[: words.index("with")]))
        places = self._places()
        for (_, end, k), (start, stop, other) in pairwise(places):
            of, one = self.objects[other], self.objects[k]
            if self._text[end:start] != " of " or one.categories or one.name == of.name:
                continue
            for n in self._family(k):
                self.objects[n] = replace(self.objects[n], words=of.words, categories=of.categories)
                self.objects[n] = replace(self.objects[n], mentions=((self.objects[n].mentions[0][0], stop),))
            if not self._has_role(k):
                self._change(k, of.change)
            self._forget(other)

    def things(self) -> None:
        """Finds objects that are called by their look and by a part: "the white thing with the pestle"."""
        for start, _, k in self._places():
            meant = self._before(start, same_sentence=False)
            if meant is not None and self.objects[k].words in _NOTHING:  # "no need for scales, delete that gadget"
                if not self._has_role(meant):
                    self._change(meant, self.objects[k].change)
                self._forget(k)
        for m in _THING.finditer(self._text):
            detail = m["detail"] or ""
            content = self._at(m.start("detail"), 0) if detail else None
            carries = _CARRIES.match(self._text[m.end() :])
            if content is not None and carries:  # "the thing with the mug on it"
                one = self._add(m["adjectives"].strip(), (m.start(), m.end() + carries.end()))
                self._change(one, self.objects[content].change)
                self._change(content, "")
                self.start.append(MentionedRelation(content, "on", one))
                continue
            words = f"{m['adjectives']} {detail}".strip()
            if not words:
                continue
            end = m.end() if detail else m.end("head")
            inside = [(start, k) for start, stop, k in self._places() if m.start() <= start and stop <= end]
            heads = [k for start, k in inside if start < m.end("head")]
            parts = [k for start, k in inside if start >= m.end("head")]
            if not heads and parts:
                heads, parts = parts[:1], parts[1:]
            one = heads[0] if heads else self._add(words, (m.start(), end))
            for k in self._family(one):
                self.objects[k] = replace(self.objects[k], words=words, categories=(), mentions=((m.start(), end),))
            for part in parts:
                if (change := self.objects[part].change) and not self._has_role(one):
                    self._change(one, change)
                self._forget(part)

    def unnamed(self) -> None:
        """Finds objects that only their place tells: "what's that between the sunglasses and the watch"."""
        for m in _UNNAMED.finditer(self._text):
            first = self._at(m.end(), 2)
            if first is None or any(start <= m.start() < end for start, end, _ in self._places()):
                continue
            change = self.objects[first].change
            one = self._add("", (m.start(), m.end("where")))
            kind = _WHERE.get(m["where"], "behind")
            targets = [first]
            if kind == "between":
                ends = [end for _, end, k in self._places() if k == first]
                also = re.match(r" and (?:the |my |that )?", self._text[ends[0] :])
                second = self._at(ends[0] + also.end(), 1) if also else None
                targets += [second] if second is not None else []
            if change == "remove":
                self._change(first, "")
                self._change(one, change)
            for target in targets:
                self.start = [r for r in self.start if {r.subject, r.target} != {first, target}]
                relation = (target, "front", one) if kind == "behind" else (one, kind, target)
                self.start.append(MentionedRelation(*relation))

    def details(self) -> None:
        """Makes parts of a new object words of its look: "a jar with a gold lid and a clasp"."""
        places, taken = self._places(), dict[int, int]()
        for (_, end, last), (start, stop, part) in pairwise(places):
            k = taken.get(last, last)
            one, other = self.objects[k], self.objects[part]
            between = (_AND_DETAIL if last in taken else _DETAIL).match(self._text[end:start])
            if between is None or other.name == one.name or not self._is_new(k) or other.change not in ("", "add"):
                continue
            if _CARRIES.match(self._text[stop:]) or "already" in self._text[stop:]:
                continue
            noun = other.words.split()[-1:]
            is_part = (
                (last not in taken and between["of"]) or not noun or any(self._is_detail(c, noun[0]) for c in one.categories)
            )
            if not is_part and self._lexicon.categories(other.words.split()):
                continue
            self._take_in(k, part, stop)
            taken[part] = k

    def purposes(self) -> None:
        """Leaves away what a new object is for: "a coaster for a glass"."""
        places = self._places()
        for (_, end, k), (start, stop, part) in pairwise(places):
            one, other = self.objects[k], self.objects[part]
            if other.name != one.name and one.categories and self._is_new(k) and _PURPOSE.match(self._text[end:start]):
                if any(self._at(m.end(), 4) == k for m in EXCHANGE.finditer(self._text)):
                    continue  # "exchange a mug for a glass"
                self._take_in(k, part, stop)

    def _take_in(self, number: int, part: int, end: int) -> None:
        """Makes a mention a part of the words of an object."""
        moved = [r for r in self.goal if r.subject in self._family(part) and r.target not in self._family(number)]
        self._forget(part)
        if not self._has_role(number):
            self.goal += [replace(r, subject=number) for r in moved]
        start = self.objects[number].mentions[0][0]
        words = " ".join(split_words(self._text[start:end]))
        compound = self._lexicon.of_purpose(words.split())
        for k in self._family(number):
            self.objects[k] = replace(self.objects[k], words=words, categories=compound or self.objects[k].categories)
