"""Whether the licence of an imported asset allows its use: what its source states, joined and compared with an allow-list."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from stable_data.assets.licences import is_licence_allowed, is_restricted, licence_terms, normalise_licence
from stable_data.errors import MeshError, Notice
from stable_data.importers.source import GivenLicence
from stable_data.json_text import quote_value

OPTION = "option"
"""Where a licence stands that the user states."""

_SHOWN = 80  # characters of a licence text in a message


@dataclass(frozen=True, slots=True)
class Licence:
    """The licence under which an asset is used.

    Attributes:
        name: Its SPDX identifier.
        text: The words that state it.
        where: Where they stand.
    """

    name: str
    text: str
    where: str


def judge_licence(
    asset_id: str, stated: Sequence[GivenLicence], option: str, allowed: Collection[str]
) -> tuple[Licence, tuple[Notice, ...]]:
    """Decides under which licence an asset is used: of several statements the strictest counts.

    Args:
        asset_id: The asset, for messages.
        stated: What its source states, the most specific first.
        option: What the user states, empty for nothing. It serves where the source names no licence, and cannot make a known licence
            weaker.
        allowed: Allowed licences.

    Returns:
        The licence, and a warning ``licence_conflict`` if the source contradicts itself.

    Raises:
        MeshError: ``licence_unknown``: no statement names a known licence; ``licence_refused``: it is not allowed;
            ``licence_conflict``: of several statements one is not allowed.
    """
    known, unclear = [], []
    for given in (*stated, *([GivenLicence(option, OPTION)] if option else [])):
        name = normalise_licence(given.text)
        if name is not None:
            known.append(Licence(name, given.text, given.where))
        elif given.text.strip():
            unclear.append(given)
    if not known:
        found = f"states {_shown(unclear[0])}, which names no known licence" if unclear else "states no licence"
        message = f"asset {asset_id}: {found}, expected one that is allowed; state it in the manifest or with --licence"
        raise MeshError(message, "licence_unknown")
    restricted = [given for given in unclear if is_restricted(given.text)]
    refused = [each for each in known if not is_licence_allowed(each.name, allowed)]
    strictest = max(known, key=lambda each: _strictness(each.name))
    differs = len({each.name for each in known}) > 1 or bool(restricted)
    if refused or restricted:
        said = ", ".join([*(f"{each.name} in {each.where}" for each in known), *(_shown(given) for given in restricted)])
        if differs:
            message = f"asset {asset_id}: its licences contradict each other: {said}; one of them is not allowed"
            raise MeshError(f"{message}; correct the source, or allow it with --allow-licence", "licence_conflict")
        message = (
            f"asset {asset_id}: its licence is {said}, expected an allowed one; leave it out, or allow it with --allow-licence"
        )
        raise MeshError(message, "licence_refused")
    if not differs and not (unclear and strictest.where == OPTION):
        return strictest, ()
    others = [f"{each.name} in {each.where}" for each in known if each is not strictest]
    said = ", ".join([*others, *map(_shown, unclear)])
    message = f"asset {asset_id}: its licence is taken as {strictest.name} ({strictest.where}), but it also states {said}; check the source"
    return strictest, (Notice(asset_id, "licence", "licence_conflict", message),)


def _shown(given: GivenLicence) -> str:
    return f"{quote_value(' '.join(given.text.split())[:_SHOWN])} in {given.where}"


def _strictness(name: str) -> tuple[bool, bool, bool, bool]:
    terms = licence_terms(name)
    assert terms is not None
    return terms.is_unchanged, terms.is_non_commercial, terms.is_share_alike, terms.is_credited
