"""Identifiers of assets whose files have no other names than their paths."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import PurePosixPath

from stable_data.importers.boundary import asset_id_of

_GENERAL = frozenset({"asset", "main", "mesh", "model", "object", "root", "textured"})


def path_words(path: str) -> tuple[str, ...]:
    """Returns the words of a path, outermost first: its folders and the file's name without suffix, if it says something.

    Args:
        path: Relative, with ``/``. The name ``model`` and its like are dropped, and a word that its folder repeats counts once.
    """
    parts = PurePosixPath(path).with_suffix("").parts
    if len(parts) > 1 and parts[-1].lower() in _GENERAL:
        parts = parts[:-1]
    return tuple(word for i, word in enumerate(parts) if i == 0 or word != parts[i - 1])


def path_ids(paths: Iterable[str]) -> dict[str, str]:
    """Returns an identifier for each path: its last word, with as many folders before it as make it unique.

    Args:
        paths: Different paths, relative, with ``/``.

    Returns:
        Path -> identifier. Identifiers differ in more than the case of letters. They depend on the set of paths alone.
    """
    words = {path: path_words(path) for path in sorted(paths)}
    num = dict.fromkeys(words, 1)

    def named(path: str) -> str:
        return asset_id_of(".".join(words[path][-num[path] :]))

    while True:
        alike: defaultdict[str, list[str]] = defaultdict(list)
        for path in words:
            alike[named(path).casefold()].append(path)
        short = [p for same in alike.values() if len(same) > 1 for p in same if num[p] < len(words[p])]
        if not short:
            break
        for path in short:
            num[path] += 1
    ids: dict[str, str] = {}
    used = {key for key, same in alike.items() if len(same) == 1}
    for same in alike.values():
        for place, path in enumerate(same):
            name, count = named(path), place + 1
            while len(same) > 1 and name.casefold() in used:
                count += 1
                name = f"{named(path)[:110]}-{count}"
            used.add(name.casefold())
            ids[path] = name
    return {path: ids[path] for path in words}
