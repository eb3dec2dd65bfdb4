"""Text from outside in Markdown pages: cards and pages of attribution quote names, licences and sources as their files state them."""

import re

from stable_data.errors import one_line

_MARKUP = re.compile(r"[\\`*\[\]<>#|!~&]")
_MOST_SHOWN = 1000  # characters


def plain(text: str) -> str:
    """Returns text as Markdown shows it: on one line, of bounded length, none of it markup."""
    shown = one_line(" ".join(text.split()))
    shown = shown if len(shown) <= _MOST_SHOWN else f"{shown[:_MOST_SHOWN]}…"
    return _MARKUP.sub(lambda found: f"\\{found[0]}", shown)
