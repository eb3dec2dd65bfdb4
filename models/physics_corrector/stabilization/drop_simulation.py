"""Placement of supported objects by a drop simulation in MuJoCo, before a scene is certified.

The corrector itself changes positions and yaws only. A towel on a folded towel lies a little askew, and the angle at which a
pencil leans in its cup is not known in advance: at the proposed tilt there may be no place where they stay. The simulation is for
generated scenes, whose tilts may change.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial.transform import Rotation
from shapely.ops import nearest_points

from models.physics_corrector.certify.correction import shapes_by_instance
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.stabilization.container_insertion import (
    ContainerInterior,
    interior_of,
    is_inside,
    is_long,
    place_leaning,
)
from models.physics_corrector.stabilization.limits import DROPPED_IN_CONTAINER, DROPPED_ON_OBJECT
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import RelationKind, Scene, SceneObject
from stable_data.scene_graph.support_tree import SupportTree, ancestors
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.scene_geometry import RestPose, object_at_rest
from stable_data.simulation.settling import PhysicsOptions, settle

# Tuned on: not recorded.
_SIMULATION = PhysicsOptions(
    settle_seconds=1.5, watch_seconds=0.02, rest_speed=2e-3, rest_move=0.0
)  # times in seconds, speed in metres a second
_INSET = 0.01  # the centre of a dropped object starts at least this far inside its carrier's outline, metres
_SAME_TILT = 1.5e-4  # a turn that moves no corner of the box farther than this counts as no change of tilt, metres


@dataclass(frozen=True, slots=True)
class DropResult:
    """A scene after a drop simulation.

    Attributes:
        scene: The scene with the dropped objects at their settled poses.
        carriers: Dropped object -> the instance at the bottom of its stack; the two move together.
    """

    scene: Scene
    carriers: Mapping[str, str]

    def with_motion_of(self, moved: Scene) -> Scene:
        """Returns the scene with the poses of another scene; dropped objects move with their carriers.

        Args:
            moved: The scene before the drop, with other poses.
        """
        before = {o.instance: o for o in self.scene.objects}
        after = {o.instance: o for o in moved.objects}
        objects = []
        for o in self.scene.objects:
            if (root := self.carriers.get(o.instance)) is None:
                objects.append(o.moved(after[o.instance].position, after[o.instance].yaw))
                continue
            turn = after[root].yaw - before[root].yaw
            c, s = np.cos(turn), np.sin(turn)
            x, y, z = np.subtract(o.position, before[root].position).tolist()
            i, j, k = np.add(after[root].position, (c * x - s * y, s * x + c * y, z)).tolist()
            objects.append(o.moved((i, j, k), o.yaw + turn))
        return replace(self.scene, objects=tuple(objects))


def drop_new_objects(scene: Scene, new: Set[str], fixed: Set[str], store: AssetStore) -> DropResult:
    """Drops the new objects that a relation puts on or in another object, the lowest first.

    Args:
        scene: The scene, resolved, with its relations.
        new: Instances to drop. Long objects that already lean in the same container are dropped again.
        fixed: Instances that must not move.
        store: Geometry of the assets.

    Returns:
        The scene; an object that fell, toppled or could not be simulated keeps its pose.
    """
    there = {o.instance for o in scene.objects}
    carrying = (RelationKind.ON, RelationKind.IN)
    wanted = {
        r.subject: r.target
        for r in scene.relations
        if r.kind in carrying and r.subject in new - fixed and r.target in there - {r.subject}
    }
    layers: dict[tuple[int, str], set[str]] = {}
    for name in wanted:
        chain = [name, *ancestors(wanted, name)]
        if wanted[chain[-1]] not in wanted:  # otherwise the relations form a cycle
            layers.setdefault((len(chain), wanted[name]), set()).add(name)
    carriers: dict[str, str] = {}
    waiting = set(wanted)
    contents = {r.subject for r in scene.relations if r.kind is RelationKind.IN}
    for (_, carrier), names in sorted(layers.items()):
        settled = _drop(scene, carrier, names, names & contents, fixed, waiting, store)
        waiting -= names
        scene = replace(scene, objects=tuple(settled.get(o.instance, o) for o in scene.objects))
        carriers |= dict.fromkeys(settled, carriers.get(carrier, carrier))
    return DropResult(scene, carriers)


def drop_into_container(scene: Scene, container: str, names: Set[str], fixed: Set[str], store: AssetStore) -> Scene | None:
    """Drops objects into a container again, together with the long objects that already lean in it.

    Args:
        scene: The scene.
        container: Instance of the container.
        names: Instances to drop.
        fixed: Instances that must not move.
        store: Geometry of the assets.

    Returns:
        The scene with the settled poses; None if no object settled in the container.
    """
    settled = _drop(scene, container, names, names, fixed, names, store)
    return replace(scene, objects=tuple(settled.get(o.instance, o) for o in scene.objects)) if settled else None


def _drop(
    scene: Scene, carrier: str, names: Set[str], contents: Set[str], fixed: Set[str], waiting: Set[str], store: AssetStore
) -> dict[str, SceneObject]:
    """Drops objects on or into a held carrier; returns instance -> object for those that settled there.

    ``contents`` are those of ``names`` that belong into the carrier. Objects in ``waiting`` have no place yet and carry nothing.
    """
    scene, shapes, _ = store.resolved(scene)
    shape_of = shapes_by_instance(scene, shapes)
    interior = interior_of(scene[carrier], shape_of[carrier]) if contents else None
    leaning = [] if interior is None else _lean_in_container(scene, carrier, contents, fixed, interior, store)
    upright = {o.instance for o in leaning}
    loose = [o for o in scene.objects if o.instance in names - upright]
    supports = SupportTree.of(scene.objects)
    there = supports.with_descendants({carrier}) | {
        o.instance for o in scene.objects if interior is not None and is_inside(o, interior, store)
    }
    # What waits for its own drop, or is dropped now, is not an obstacle, nor is anything on it.
    there -= supports.with_descendants(waiting | names | upright) | {carrier}
    held = [scene[carrier], *(o for o in scene.objects if o.instance in there)]
    part, own, _ = store.resolved(replace(scene, objects=(*held, *leaning, *loose)))
    part = _lower_onto_first(part, own, len(part.objects) - len(loose))
    try:
        bodies = bodies_of(part, own, store)
    except MeshError:
        return {}
    ended = settle([replace(body, movable=k >= len(held)) for k, body in enumerate(bodies)], scene.table, _SIMULATION)
    if not np.isfinite(ended.moves).all():
        return {}
    outline = _outline(scene[carrier], shape_of[carrier])
    settled = {}
    for k, o in list(enumerate(part.objects))[len(held) :]:
        x, y, z = ended.positions[k].tolist()
        a, b, c, d = ended.quats_xyzw[k].tolist()
        end = _settled_object(o, ((x, y, z), (a, b, c, d)), store)
        if interior is not None and is_inside(end, interior, store):
            limits = DROPPED_IN_CONTAINER
            is_settled = o.instance in upright or bool(ended.moves[k] < limits.move and ended.turns[k] < limits.turn)
        else:
            limits = DROPPED_ON_OBJECT
            is_near = bool(ended.moves[k] < limits.move and ended.turns[k] < limits.turn)
            is_settled = is_near and outline.covers(shapely.Point(x, y)) and o.instance not in upright
        if is_settled:
            settled[o.instance] = end
    return _raised(replace(part, objects=(*held, *settled.values())), len(held), store)


def _raised(scene: Scene, first: int, store: AssetStore) -> dict[str, SceneObject]:
    """The objects from index ``first`` on by instance, raised out of what they are on: contacts of an engine are slightly deep."""
    scene, shapes, _ = store.resolved(scene)
    meshes, poses, done = MeshQueries([s.as_mesh() for s in shapes]), scene.poses(), list(range(first))
    for k in sorted(range(first, len(poses)), key=lambda k: float(poses[k, 2])):
        poses[k] = meshes.raise_free(k, poses[k], done, poses)
        done.append(k)
    return {o.instance: o for o in scene.with_poses(poses).objects[first:]}


def _lean_in_container(
    scene: Scene, container: str, names: Set[str], fixed: Set[str], interior: ContainerInterior, store: AssetStore
) -> list[SceneObject]:
    """Returns the long objects of ``names`` and of a container's contents, leaning in it; its contents have priority."""
    inside = [
        o
        for o in scene.objects
        if o.instance in names or (o.instance not in fixed | {container} and is_inside(o, interior, store))
    ]
    sticks = [o for o in inside if is_long(o, interior, store)]
    found = place_leaning(sorted(sticks, key=lambda o: o.instance in names), interior, store)
    return found if names & {o.instance for o in found} else []


def _lower_onto_first(scene: Scene, shapes: Sequence[Shape], first: int) -> Scene:
    """Moves the objects from index ``first`` on over the first object, and lowers them onto it and onto each other."""
    meshes = MeshQueries([s.as_mesh() for s in shapes])
    poses = scene.poses()
    outline = _outline(scene.objects[0], shapes[0])
    inner = outline.buffer(-_INSET)
    for k in range(first, len(poses)):
        area = outline if inner.is_empty else inner
        poses[k, :2] = shapely.get_coordinates(nearest_points(area, shapely.Point(poses[k, :2]))[0])[0]
        poses[k, 2] = meshes.resting_height(k, poses[k], range(k), poses)
    return scene.with_poses(poses)


def _outline(o: SceneObject, shape: Shape) -> shapely.Geometry:
    """Returns the convex outline of an object seen from above, world frame, metres."""
    return shapely.convex_hull(shapely.multipoints(shape.posed_footprint(np.array([*o.position, o.yaw]))))


def _settled_object(o: SceneObject, rest: RestPose, store: AssetStore) -> SceneObject:
    """Returns an object at its settled pose; a tilt that has hardly changed stays the same."""
    there = object_at_rest(o, store.mesh_of(o), rest)
    turn = Rotation.from_quat(there.tilt_quat_xyzw) * Rotation.from_quat(o.tilt_quat_xyzw).inv()
    if turn.magnitude() * float(np.linalg.norm(o.size)) / 2 < _SAME_TILT:
        return o.moved(there.position, there.yaw)
    return there
