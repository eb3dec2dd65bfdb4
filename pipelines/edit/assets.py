"""Assets for the objects that an edit adds or resizes, from the library of the scenes or, if it has none, from further ones."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from models.semantic_reasoner.editing import EditResult
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.scenes import SceneSource
from stable_data.assets.box_fitting import box_proportions, size_score, stretched_scale, uniform_scale_factor
from stable_data.assets.catalog import Asset
from stable_data.assets.noun_fit import NounFit, noun_fit
from stable_data.assets.retrieval import AssetMatch, AssetQuery, Retriever
from stable_data.assets.substitution import substitute_assets
from stable_data.errors import Notice, SceneError
from stable_data.rotations import rotation_matrix
from stable_data.scene import UPRIGHT, FloatArray, RelationKind, Scene, SceneObject, Vec3
from stable_data.scene_graph.support_tree import SupportTree

_AS_GOOD = 0.01  # a resized object keeps its tilt unless another tilt fits better by this cosine
_EVEN, _MOST_UNEVEN = 1.03, 1.6  # distortions between these are stretched; smaller and larger ones are scaled uniformly


@dataclass(frozen=True, slots=True)
class AssignedEdit:
    """An edited scene whose new objects have assets.

    Attributes:
        scene: The scene.
        kept: Instances whose pose the choice of assets did not change.
        notices: Warnings about the choice.
    """

    scene: Scene
    kept: frozenset[str]
    notices: tuple[Notice, ...] = ()


class AssetFinder:
    """Finds assets; the libraries are encoded at the first use.

    Args:
        source: The source of the scenes; its store has the meshes of all libraries.
        shelf: The libraries, that of the source first.
    """

    def __init__(self, source: SceneSource, shelf: AssetLibraries) -> None:
        self._source, self._shelf = source, shelf

    @cached_property
    def _retriever(self) -> Retriever:
        return self._shelf.retriever()

    def assign(self, edited: EditResult, edit_id: str, seed: int) -> AssignedEdit:
        """Assigns an asset to each new object, and fits the own asset of each resized object to its new size.

        Equal descriptions get equal assets within an edit. The underside of an object stays at its height, and the objects on
        it move with its top.

        Args:
            edited: The scene after the reply.
            edit_id: With the seed, decides among equally good assets.
            seed: The seed of the edit.

        Raises:
            SceneError: No library has a similar asset (``asset_unmatched``).
        """
        scene, new = edited.scene, set(edited.need_asset)
        resized = [o for o in scene.objects if o.instance in edited.changed and o.scale is None and o.asset_id is not None]
        if not (new or resized):
            return AssignedEdit(scene, frozenset(o.instance for o in scene.objects))
        without_asset = [o for o in scene.objects if o.instance in new]
        within = [r for r in edited.wanted if r.kind is RelationKind.IN]
        contents, holders = {r.subject for r in within}, {r.target for r in within}
        queries = [
            AssetQuery(o.description, o.size, o.category, edit_id, o.instance in contents, o.instance in holders)
            for o in without_asset
        ]
        answers = self._retriever.retrieve(queries, seed) if queries else []
        matches: dict[str, AssetMatch] = {}
        notes = []
        for o, answer in zip(without_asset, answers, strict=True):
            if not isinstance(answer, AssetMatch):
                raise SceneError(f"{edit_id}: no asset for {o.instance}: {answer.reason}", "asset_unmatched")
            matches[o.instance] = answer
            if not self._shelf.is_of_first(answer.asset_id):
                message = (
                    f"{o.instance} has an asset of library {answer.library}, because that of the scenes has none that fits"
                )
                notes.append(Notice(edit_id, "assets", "asset_of_other_library", f"{edit_id}: {message}"))
        matches |= {o.instance: match for o in resized if (match := self._fitted(o)) is not None}
        notes += [
            Notice(edit_id, "assets", "not_stretched", f"{edit_id}: {name} {match.note}")
            for name, match in matches.items()
            if match.note
        ]
        members = SupportTree.of(scene.objects).with_descendants(set(matches))
        wanted = [o for o in scene.objects if o.instance in members]
        done = {o.instance: o for o in substitute_assets(wanted, matches)}
        objects = tuple(_named_so(done.get(o.instance, o), o) for o in scene.objects)
        kept = frozenset(
            o.instance
            for o, now in zip(scene.objects, objects, strict=True)
            if o.instance not in matches and now.position == o.position
        )
        return AssignedEdit(replace(scene, objects=objects), kept, tuple(notes))

    def _fitted(self, o: SceneObject) -> AssetMatch | None:
        """An object's own asset at the tilt and scale nearest to its size, or None if it has no mesh."""
        mesh = self._source.store.mesh_of(o)
        if mesh is None or o.asset_id is None:
            return None
        known = self._assets.get(o.asset_id)
        tilts = (o.tilt_quat_xyzw, *((UPRIGHT,) if known is None else (tilt.quat_xyzw for tilt in known.tilts)))
        boxes = np.array([np.ptp(mesh.vertices @ rotation_matrix(tilt).T, axis=0) for tilt in tilts])
        scores = size_score(box_proportions(o.size), box_proportions(boxes))
        k = 0 if scores[0] >= scores.max() - _AS_GOOD else int(scores.argmax())
        box = _triple(boxes[k])
        stretched, distortion = stretched_scale(o.size, box, tilts[k])
        if stretched is not None and _EVEN < distortion <= _MOST_UNEVEN:
            scale, size = stretched, o.size
        else:
            factor = float(uniform_scale_factor(o.size, box))
            scale, size = (factor, factor, factor), _triple(factor * boxes[k])
        score = float(scores[k])
        return AssetMatch(o.asset_id, self._source.name, o.category, score, 1.0, score, tilts[k], scale, size)

    @cached_property
    def _assets(self) -> dict[str, Asset]:
        return {asset.asset_id: asset for library in self._shelf.libraries for asset in library.assets}


def _triple(values: FloatArray) -> Vec3:
    x, y, z = values.tolist()
    return x, y, z


def _named_so(now: SceneObject, wanted: SceneObject) -> SceneObject:
    """The object with the category of its instance name, if its asset is such a thing."""
    return replace(now, category=wanted.category) if noun_fit(now.category, wanted.category) >= NounFit.KIND else now
