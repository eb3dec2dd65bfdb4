"""Derives the supports and the scene graph of a scene from the contacts of its meshes."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from stable_data.metrics.audit import PosedScene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import TABLE, FloatArray, Scene
from stable_data.scene_graph.relations import SceneGraph, relations_of, scene_graph, supports

_CONTACT_GAP = 3e-3  # metres; layouts are written to 1 mm, so a support may be a little below its object


@dataclass(frozen=True, slots=True, eq=False)
class RelatedScene:
    """A scene with supports and relations derived from its meshes.

    Attributes:
        scene: The scene with supports and relations.
        graph: Its scene graph.
        contacts: The supports that each object touches.
        footprints: Convex outline of each object, (K, 2) float64, metres, world frame.
    """

    scene: Scene
    graph: SceneGraph
    contacts: Mapping[str, tuple[str, ...]]
    footprints: Mapping[str, FloatArray]


def relate_scene(posed: PosedScene, audit: Audit, containers: Mapping[str, bool | None]) -> RelatedScene:
    """Derives the supports and relations of a scene from its posed meshes and its audit.

    ``containers`` gives whether objects can be put into an object; None or missing if it is not known.
    """
    scene = posed.scene
    contacts = _support_contacts(posed, audit)
    footprints = {o.instance: s.posed_footprint(p) for o, s, p in zip(scene.objects, posed.shapes, scene.poses(), strict=True)}
    carriers = supports(scene, contacts, footprints, containers)
    scene = replace(scene, objects=tuple(replace(o, support=carriers[o.instance]) for o in scene.objects))
    graph = scene_graph(scene, contacts, footprints, containers)
    return RelatedScene(replace(scene, relations=relations_of(graph)), graph, contacts, footprints)


def _support_contacts(posed: PosedScene, audit: Audit) -> Mapping[str, tuple[str, ...]]:
    """The supports of each object: those of the audit, and those within a larger gap below the object.

    Only the audit decides on the table, because the larger gap reaches through a placemat.
    """
    found = {}
    for index, verdict in enumerate(audit.objects):
        near = verdict.supports if verdict.supports == (TABLE,) else posed.supports(index, _CONTACT_GAP) or ()
        # An object that is on others by the audit is not on the table, even if the larger gap reaches it.
        if verdict.supports and TABLE not in verdict.supports:
            near = tuple(name for name in near if name != TABLE)
        found[verdict.instance] = near
    return found
