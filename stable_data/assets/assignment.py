"""Assigns assets to the objects of layouts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from stable_data.assets.retrieval import Answer, AssetMatch, AssetQuery, Retriever, UnmatchedQuery
from stable_data.assets.substitution import substitute_assets
from stable_data.errors import Notice
from stable_data.scene import TABLE, Scene
from stable_data.scene_graph.support_tree import SupportTree

_INSIDE = 0.002  # metres; things that stand on one another may touch this deep in a layout that nobody corrected yet

STEP = "assets"
"""The step in the notices of this module."""


@dataclass(frozen=True, slots=True)
class AssignedLayout:
    """A layout whose objects have assets.

    Attributes:
        scene: The layout, without unmatched objects and the objects that they support.
        unmatched: Instance -> why it has no asset.
        notices: Removed objects, unusable assets, better assets whose licences are not allowed, and assets that could not be stretched.
    """

    scene: Scene
    unmatched: Mapping[str, UnmatchedQuery]
    notices: tuple[Notice, ...] = ()


def assign_assets(
    scenes: Sequence[Scene], retriever: Retriever, seed: int = 0, fault_of: Callable[[str], str | None] = lambda _: None
) -> list[AssignedLayout]:
    """Assigns an asset to each object of some layouts, with one retrieval for all of them.

    Within a layout, equal words and sizes get equal assets. The underside of an object keeps its height, and supported objects
    move with their support.

    Args:
        scenes: The layouts, with stages and supports.
        retriever: Finds assets.
        seed: Decides between equally good assets.
        fault_of: Function from an asset id to why the asset cannot be used, or None if it can. The next best asset replaces an
            unusable one.
    """
    requested = [(k, o) for k, scene in enumerate(scenes) for o in scene.objects]
    holders = [_holders(scene) for scene in scenes]
    queries = [
        AssetQuery(
            o.description, o.size, o.category, scenes[k].scene_id, o.support not in (None, TABLE), o.instance in holders[k]
        )
        for k, o in requested
    ]
    answers, faults = retrieve_usable(queries, retriever, seed, fault_of)
    matches: list[dict[str, AssetMatch]] = [{} for _ in scenes]
    unmatched: list[dict[str, UnmatchedQuery]] = [{} for _ in scenes]
    notices: list[list[Notice]] = [[] for _ in scenes]
    for (k, o), answer, found in zip(requested, answers, faults, strict=True):
        name = scenes[k].scene_id
        if answer.barred is not None:
            notices[k].append(_licence_notice(name, o.instance, answer))
        why = found[0] + (f" (and {len(found) - 1} more assets)" if found[1:] else "") if found else ""
        if isinstance(answer, UnmatchedQuery):
            unmatched[k][o.instance] = replace(answer, reason=f"the similar assets cannot be used: {why}") if why else answer
            continue
        matches[k][o.instance] = answer
        if why:
            notices[k].append(Notice(name, STEP, "asset_unusable", f"{name}: {o.instance} gets another asset; not used: {why}"))
    return [_assigned(*parts) for parts in zip(scenes, matches, unmatched, notices, strict=True)]


def _holders(scene: Scene) -> set[str]:
    """The objects whose top is above the underside of an object that they support, so that this one is in them."""
    tops = {o.instance: o.bottom + o.size[2] for o in scene.objects}
    return {o.support for o in scene.objects if o.support is not None and o.bottom < tops.get(o.support, o.bottom) - _INSIDE}


def retrieve_usable(
    queries: Sequence[AssetQuery], retriever: Retriever, seed: int, fault_of: Callable[[str], str | None]
) -> tuple[list[Answer], list[list[str]]]:
    """Returns the best usable asset for each query, and the faults of the better ones.

    A query is repeated without the unusable assets that it was given itself, not without all known unusable assets. So its
    answer does not depend on earlier queries.

    Args:
        queries: The queries.
        retriever: Finds assets.
        seed: Decides between equally good assets.
        fault_of: As for :func:`assign_assets`.
    """
    queries, answers = list(queries), retriever.retrieve(queries, seed)
    faults: list[list[str]] = [[] for _ in queries]
    waiting = list(range(len(queries)))
    while waiting:
        again = []
        for k in waiting:
            answer = answers[k]
            if isinstance(answer, AssetMatch) and (fault := fault_of(answer.asset_id)) is not None:
                faults[k].append(fault)
                queries[k] = replace(queries[k], without=queries[k].without | {answer.asset_id})
                again.append(k)
        waiting = again
        for k, answer in zip(again, retriever.retrieve([queries[k] for k in again], seed) if again else (), strict=True):
            answers[k] = answer
    return answers, faults


def _licence_notice(scene_id: str, instance: str, answer: Answer) -> Notice:
    """The notice that the licence of the best match is not allowed."""
    used = f"gets asset {answer.asset_id} of library {answer.library}" if isinstance(answer, AssetMatch) else "gets no asset"
    text = f"{scene_id}: {instance} {used}; the best match is {answer.barred}; allow the licence or accept the substitute"
    return Notice(scene_id, STEP, "licence_substitute", text)


def _assigned(
    scene: Scene, matches: Mapping[str, AssetMatch], unmatched: Mapping[str, UnmatchedQuery], notices: list[Notice]
) -> AssignedLayout:
    removed = SupportTree.of(scene.objects).with_descendants(set(unmatched))
    remaining = [o for o in scene.objects if o.instance not in removed]
    for name in sorted(removed):
        why = f"no asset: {unmatched[name].reason}" if name in unmatched else "its support is removed"
        code = "asset_unmatched" if name in unmatched else "carrier_left_out"
        notices.append(Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {name} is removed; {why}"))
    notices += [
        Notice(scene.scene_id, STEP, "not_stretched", f"{scene.scene_id}: {o.instance} {note}")
        for o in remaining
        if (note := matches[o.instance].note)
    ]
    objects = substitute_assets(remaining, {o.instance: matches[o.instance] for o in remaining})
    return AssignedLayout(replace(scene, objects=objects), unmatched, tuple(notices))
