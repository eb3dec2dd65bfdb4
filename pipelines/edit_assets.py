"""Assets for what an edit adds or changes, from the library that the scene's own assets are of."""

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from models.semantic_reasoner.editing import EditedScene
from models.text_encoder import load_default
from pipelines.scene_source import SceneSource
from stable_data.errors import Notice, SceneError
from stable_data.retrieval import Match, Query, Retriever
from stable_data.scene import Scene, SceneObject
from stable_data.substitution import with_assets


@dataclass(frozen=True, slots=True)
class WithAssets:
    """An edited scene whose new things have assets.

    Attributes:
        scene: The scene.
        kept: Instances that are where they were before assets were found.
        notices: What about the choice deserves a look.
    """

    scene: Scene
    kept: frozenset[str]
    notices: tuple[Notice, ...] = ()


class AssetFinder:
    """Finds assets; the library is read and encoded when the first is wanted.

    Args:
        source: Where the scenes, and so their assets, are.
    """

    def __init__(self, source: SceneSource) -> None:
        self._source = source

    @cached_property
    def _retriever(self) -> Retriever:
        encoder = load_default()
        cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "stable-data" / "text"
        return Retriever([self._source.library().embedded(encoder, cache / f"{encoder.fingerprint}.parquet")], encoder)

    def with_assets(self, edited: EditedScene, edit_id: str, seed: int) -> WithAssets:
        """The scene with an asset for each thing that wants one; what rests on such a thing comes with it.

        Equal words get equal assets within an edit. The underside of a thing stays at its height.

        Args:
            edited: The scene after the reply.
            edit_id: Together with the seed, what decides among assets that are as good.
            seed: Likewise.

        Raises:
            SceneError: The library has nothing like it (``asset_unmatched``).
        """
        scene, wanting = edited.scene, set(edited.wanting)
        if not wanting:
            return WithAssets(scene, frozenset(o.instance for o in scene.objects))
        asked = [o for o in scene.objects if o.instance in wanting]
        answers = self._retriever.retrieve([Query(o.description, o.size, o.category, edit_id) for o in asked], seed)
        matches: dict[str, Match] = {}
        for o, answer in zip(asked, answers, strict=True):
            if not isinstance(answer, Match):
                raise SceneError(f"{edit_id}: no asset for {o.instance}: {answer.reason}", "asset_unmatched")
            matches[o.instance] = answer
        members = _resting_on(scene, wanting)
        done = {o.instance: o for o in with_assets([o for o in scene.objects if o.instance in members], matches)}
        objects = tuple(_named_so(done.get(o.instance, o), o) for o in scene.objects)
        kept = frozenset(
            o.instance
            for o, now in zip(scene.objects, objects, strict=True)
            if o.instance not in wanting and now.position == o.position
        )
        notes = tuple(
            Notice(edit_id, "assets", "not_stretched", f"{edit_id}: {name} {match.note}")
            for name, match in matches.items()
            if match.note
        )
        return WithAssets(replace(scene, objects=objects), kept, notes)


def _named_so(now: SceneObject, wanted: SceneObject) -> SceneObject:
    """The object under the category that its instance names."""
    return now if now.category == wanted.category else replace(now, category=wanted.category)


def _resting_on(scene: Scene, carriers: set[str]) -> set[str]:
    """Some things and all that rests on them, directly and through others."""
    members = set(carriers)
    while more := {o.instance for o in scene.objects if o.support in members} - members:
        members |= more
    return members
