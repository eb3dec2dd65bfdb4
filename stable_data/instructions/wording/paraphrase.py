"""Paraphrases of requests: other verbs and prepositions, polite frames, reasons.

A template has its choices in brackets: ``[put] {x} [into|inside] {y}``. A bracket with bars lists the words; a bracket without
bars is a key of ``SYNONYMS``. A text without punctuation marks is a clause: an imperative that fits into a frame or a task of
several steps.
"""

import re
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from stable_data.instructions.wording.words import sentences

SYNONYMS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "put": ("put", "put", "place", "set"),
        "lay": ("lay", "put", "place"),
        "take": ("take", "take", "get", "lift"),
        "fetch": ("fetch", "get", "take"),
        "remove": ("remove", "take away"),
        "pick up": ("pick up", "pick up", "lift up", "grab", "take hold of"),
        "move": ("move", "move", "shift", "bring"),
        "bring": ("bring", "move", "carry"),
        "push": ("push", "slide", "nudge"),
        "turn": ("turn", "rotate"),
        "stack": ("stack", "pile", "put"),
        "hand": ("hand", "pass", "give"),
        "press": ("press", "push down"),
        "collect": ("collect", "gather"),
        "arrange": ("arrange", "line up", "place"),
        "into": ("into", "in", "inside"),
        "onto": ("onto", "on", "on top of"),
        "next to": ("next to", "beside", "right next to"),
        "middle": ("middle", "centre"),
        "then": ("then", "and then", "and after that"),
    }
)
"""Alternatives of each word; a word that is listed twice has twice the probability."""

_FRAMES = (
    "please {}",
    "please {}",
    "{}, please",
    "could you {}?",
    "can you {}?",
    "would you {}, please?",
    "could you please {}?",
    "I want you to {}.",
    "I would like you to {}.",
    "your task is to {}.",
    "go ahead and {}.",
    "you need to {}.",
    "the robot should {}.",
    "your next job is to {}.",
    "it would help me if you could {}.",
)
_FRAMED = 0.5  # probability that a clause gets a frame

_REASONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "tidy": (
            "I am tidying up.",
            "Let us tidy up a little.",
            "I want everything in order.",
            "Some tidying is needed here.",
            "Everything should have its place.",
        ),
        "meal": ("We are about to eat.", "The food will be ready in a minute.", "Guests are coming.", "It is time to eat."),
        "after_meal": ("We have finished eating.", "The meal is over.", "Everybody has eaten."),
        "drink": ("I am thirsty.", "I would like something to drink.", "It is time for a drink."),
        "cook": ("I am about to cook.", "Let us start cooking."),
        "work": ("I want to start working.", "I have some work to do.", "Work is waiting."),
        "done": ("I am done for today.", "I have finished my work."),
        "room": ("I need some room here.", "It is too crowded here."),
        "look": ("I am looking for something.", "I want to check something."),
    }
)
_REASONED = 0.3  # probability that a task with a theme gets a reason


def reword(text: str, rng: np.random.Generator) -> str:
    """Replaces each bracket of a template by a random alternative."""

    def choose(match: re.Match[str]) -> str:
        options = tuple(match[1].split("|")) if "|" in match[1] else SYNONYMS[match[1].lower()]
        chosen = options[int(rng.integers(len(options)))]
        return chosen.capitalize() if match[1][0].isupper() else chosen

    return re.sub(r"\[([^\]]+)\]", choose, text)


def is_clause(text: str) -> bool:
    """Whether a text is an imperative that fits into a frame."""
    return re.search(r"[.!?:;]", text) is None


def request(text: str, theme: str, rng: np.random.Generator) -> str:
    """Returns a text as sentences, with a random frame or without, with a random reason in front or without.

    Args:
        text: A clause or sentences.
        theme: The topic of the reasons, or empty.
        rng: The random generator.
    """
    if is_clause(text) and rng.random() < _FRAMED:
        text = _FRAMES[int(rng.integers(len(_FRAMES)))].format(text)
    reasons = _REASONS.get(theme, ())
    if reasons and rng.random() < _REASONED:
        text = f"{reasons[int(rng.integers(len(reasons)))]} {text}"
    return sentences(text)
