"""Raw layouts get their assets: from libraries in order, the first that has a match serving."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from stable_data.assets.retrieval import Answer, AssetMatch, AssetQuery, Retriever, UnmatchedQuery
from stable_data.assets.substitution import substitute_assets
from stable_data.errors import Notice
from stable_data.scene import TABLE, Scene
from stable_data.scene_graph.support_tree import SupportTree

STEP = "assets"
"""The step that this module's notices name."""


@dataclass(frozen=True, slots=True)
class AssignedLayout:
    """A layout whose objects have assets.

    Attributes:
        scene: The layout; objects without a match are left out, and so is what rests on them.
        unmatched: Why there is no asset, by instance.
        notices: What was left out, and what about a choice deserves a look.
    """

    scene: Scene
    unmatched: Mapping[str, UnmatchedQuery]
    notices: tuple[Notice, ...] = ()


def assign_assets(
    scenes: Sequence[Scene], retriever: Retriever, seed: int = 0, fault_of: Callable[[str], str | None] = lambda _: None
) -> list[AssignedLayout]:
    """Layouts with an asset for each object that one is found for, all of them asked for at once.

    Within a layout equal words and sizes get equal assets. The underside of a thing stays at its height, and what rests on a
    thing comes with it.

    Args:
        scenes: The layouts, staged, with supports.
        retriever: Finds assets.
        seed: Decides among assets that are as good.
        fault_of: Why an asset cannot be used, by its id; None where it can. Of what cannot, the next best takes the place.
    """
    asked = [(k, o) for k, scene in enumerate(scenes) for o in scene.objects]
    queries = [
        AssetQuery(o.description, o.size, o.category, scenes[k].scene_id, leans=o.support not in (None, TABLE))
        for k, o in asked
    ]
    answers, faults = _usable(queries, retriever, seed, fault_of)
    matches: list[dict[str, AssetMatch]] = [{} for _ in scenes]
    unmatched: list[dict[str, UnmatchedQuery]] = [{} for _ in scenes]
    passed: list[list[Notice]] = [[] for _ in scenes]
    for (k, o), answer, found in zip(asked, answers, faults, strict=True):
        name = scenes[k].scene_id
        why = found[0] + (f" (and {len(found) - 1} more assets)" if found[1:] else "") if found else ""
        if isinstance(answer, UnmatchedQuery):
            unmatched[k][o.instance] = replace(answer, reason=f"the similar assets cannot be used: {why}") if why else answer
            continue
        matches[k][o.instance] = answer
        if why:
            passed[k].append(Notice(name, STEP, "asset_unusable", f"{name}: {o.instance} gets another asset; not used: {why}"))
    return [_furnished(*parts) for parts in zip(scenes, matches, unmatched, passed, strict=True)]


def _usable(
    queries: Sequence[AssetQuery], retriever: Retriever, seed: int, fault_of: Callable[[str], str | None]
) -> tuple[list[Answer], list[list[str]]]:
    """The best asset that can be used for each query, and why those before it cannot.

    Each query is asked anew without what it was given in vain, rather than without all that is known to be broken: so it gets
    the same whatever was asked before.
    """
    asked, answers = list(queries), retriever.retrieve(queries, seed)
    faults: list[list[str]] = [[] for _ in queries]
    waiting = list(range(len(asked)))
    while waiting:
        again = []
        for k in waiting:
            answer = answers[k]
            if isinstance(answer, AssetMatch) and (fault := fault_of(answer.asset_id)) is not None:
                faults[k].append(fault)
                asked[k] = replace(asked[k], without=asked[k].without | {answer.asset_id})
                again.append(k)
        waiting = again
        for k, answer in zip(again, retriever.retrieve([asked[k] for k in again], seed) if again else (), strict=True):
            answers[k] = answer
    return answers, faults


def _furnished(
    scene: Scene, matches: Mapping[str, AssetMatch], unmatched: Mapping[str, UnmatchedQuery], passed: Sequence[Notice]
) -> AssignedLayout:
    gone = SupportTree.of(scene.objects).with_descendants(set(unmatched))
    kept = [o for o in scene.objects if o.instance not in gone]
    notices = list(passed)
    for name in sorted(gone):
        why = f"no asset: {unmatched[name].reason}" if name in unmatched else "its carrier is removed"
        code = "asset_unmatched" if name in unmatched else "carrier_left_out"
        notices.append(Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {name} is removed; {why}"))
    notices += [
        Notice(scene.scene_id, STEP, "not_stretched", f"{scene.scene_id}: {o.instance} {note}")
        for o in kept
        if (note := matches[o.instance].note)
    ]
    objects = substitute_assets(kept, {o.instance: matches[o.instance] for o in kept})
    return AssignedLayout(replace(scene, objects=objects), unmatched, tuple(notices))
