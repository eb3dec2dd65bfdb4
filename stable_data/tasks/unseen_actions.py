"""Words of an instruction that ask for what no state of the objects shows."""

import re

_UNSEEN = re.compile(
    r"\b(?P<verb>pour|refill|press|switch (?:on|off)|wipe|clean|rinse|wash|slice|chop|peel|cut|stir|shake|rotate|unplug|plug|light|water"
    r"|write|draw|fold|unfold|flip|tilt|wind up|straighten)\b"
    r"|(?:^|[.;,:]|\band|\bthen|\bto|\byou|\bplease)\s*(?:please )?(?P<first>open|close|shut|turn|fill|use)\b"
)


def unseen_action(instruction: str) -> str | None:
    """Returns the first words of an instruction that ask for what no state of the objects shows, such as ``pour``; None without any.

    Args:
        instruction: The instruction, in English.

    Example:
        >>> unseen_action("Put the cup on the tray and pour some tea.")
        'pour'
    """
    found = _UNSEEN.search(" ".join(instruction.lower().split()))
    return None if found is None else found["verb"] or found["first"]
