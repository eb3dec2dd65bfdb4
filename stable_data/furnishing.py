"""Raw layouts get their assets: from libraries in order, the first that has a match serving."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from stable_data.errors import Notice
from stable_data.retrieval import Match, Query, Retriever, Unmatched
from stable_data.scene import TABLE, Scene
from stable_data.substitution import with_assets

STEP = "assets"
"""The step that this module's notices name."""


@dataclass(frozen=True, slots=True)
class Furnished:
    """A layout whose objects have assets.

    Attributes:
        scene: The layout; objects without a match are left out, and so is what rests on them.
        unmatched: Why there is no asset, by instance.
        notices: What was left out, and what about a choice deserves a look.
    """

    scene: Scene
    unmatched: Mapping[str, Unmatched]
    notices: tuple[Notice, ...] = ()


def furnish(scenes: Sequence[Scene], retriever: Retriever, seed: int = 0) -> list[Furnished]:
    """Layouts with an asset for each object that one is found for, all of them asked for at once.

    Within a layout equal words and sizes get equal assets. The underside of a thing stays at its height, and what rests on a thing
    comes with it.

    Args:
        scenes: The layouts, staged, with supports.
        retriever: Finds assets.
        seed: Decides among assets that are as good.
    """
    asked = [(k, o) for k, scene in enumerate(scenes) for o in scene.objects]
    queries = [
        Query(o.description, o.size, o.category, scenes[k].scene_id, leans=o.support not in (None, TABLE)) for k, o in asked
    ]
    answers = retriever.retrieve(queries, seed)
    matches: list[dict[str, Match]] = [{} for _ in scenes]
    unmatched: list[dict[str, Unmatched]] = [{} for _ in scenes]
    for (k, o), answer in zip(asked, answers, strict=True):
        if isinstance(answer, Match):
            matches[k][o.instance] = answer
        else:
            unmatched[k][o.instance] = answer
    return [_furnished(*parts) for parts in zip(scenes, matches, unmatched, strict=True)]


def _furnished(scene: Scene, matches: Mapping[str, Match], unmatched: Mapping[str, Unmatched]) -> Furnished:
    gone = scene.resting_on(set(unmatched)) if unmatched else set()
    kept = [o for o in scene.objects if o.instance not in gone]
    notices = []
    for name in sorted(gone):
        why = f"no asset: {unmatched[name].reason}" if name in unmatched else "what it rests on is left out"
        code = "asset_unmatched" if name in unmatched else "carrier_left_out"
        notices.append(Notice(scene.scene_id, STEP, code, f"{scene.scene_id}: {name} is left out; {why}"))
    notices += [
        Notice(scene.scene_id, STEP, "not_stretched", f"{scene.scene_id}: {o.instance} {note}")
        for o in kept
        if (note := matches[o.instance].note)
    ]
    objects = with_assets(kept, {o.instance: matches[o.instance] for o in kept})
    return Furnished(replace(scene, objects=objects), unmatched, tuple(notices))
