"""What is to be on or in a thing, put there as one would and let go in the engine, before anything is proven.

The corrector itself changes positions and yaws alone. A towel on a folded towel lies a little askew, and a pencil leans in its
cup at no angle that could be known before: at the tilt at which they were proposed there may be no place where they stay. This
is for scenes that are made, whose tilts are nobody's but ours.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial.transform import Rotation
from shapely.ops import nearest_points

from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.corrector import named
from models.physics_corrector.stabilization.container_insertion import ContainerInterior, hollow_of, is_inside, is_long, stood
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError
from stable_data.geometry.shape import Shape
from stable_data.scene import RelationKind, Scene, SceneObject
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.scene_geometry import RestPose, at_rest
from stable_data.simulation.settling import PhysicsOptions, settle

_SETTLING = PhysicsOptions(settle_seconds=1.5, watch_seconds=0.02, rest_speed=2e-3)
_STRAYED, _TOPPLED = 0.05, 45.0  # what goes farther in a hollow, metres, or turns more, degrees, was not let go well
_TIPPED = 5.0  # nor what turns more on a thing, degrees
_INSET = 0.01  # how far inside its carrier's outline the middle of what is let go is at least, metres
_SNAP = 1.5e-4  # a tilt that moves no corner farther than this, metres, is none


@dataclass(frozen=True, slots=True)
class DropResult:
    """A scene in which things were let go.

    Attributes:
        scene: The scene, what was let go where it came to lie.
        went_with: What each of them lies on or in at last, by instance: it goes where that goes.
    """

    scene: Scene
    went_with: Mapping[str, str]

    def followed(self, moved: Scene) -> Scene:
        """The same with everything where another scene has it, and what was let go where it lay on what it went with.

        Args:
            moved: The scene as it was before, its objects moved.
        """
        was = {o.instance: o for o in self.scene.objects}
        now = {o.instance: o for o in moved.objects}
        objects = []
        for o in self.scene.objects:
            if (root := self.went_with.get(o.instance)) is None:
                objects.append(o.moved(now[o.instance].position, now[o.instance].yaw))
                continue
            turn = now[root].yaw - was[root].yaw
            c, s = np.cos(turn), np.sin(turn)
            x, y, z = np.subtract(o.position, was[root].position).tolist()
            i, j, k = np.add(now[root].position, (c * x - s * y, s * x + c * y, z)).tolist()
            objects.append(o.moved((i, j, k), o.yaw + turn))
        return replace(self.scene, objects=tuple(objects))


def let_down(scene: Scene, new: Set[str], fixed: Set[str], store: AssetStore) -> DropResult:
    """Lets go what is new and is to be on or in something, what is lowest first.

    Args:
        scene: The scene, resolved; its relations say what is to be where.
        new: Instances that are let go. Long things that lean in the same cup are let go again.
        fixed: Instances that must stay.
        store: Geometry of the assets.

    Returns:
        The scene; what fell, toppled or could not be let go is where it was.
    """
    there = {o.instance for o in scene.objects}
    carrying = (RelationKind.ON, RelationKind.IN)
    wanted = {
        r.subject: r.target
        for r in scene.relations
        if r.kind in carrying and r.subject in new - fixed and r.target in there - {r.subject}
    }
    chains = {name: _down_from(name, wanted) for name in wanted}
    layers: dict[tuple[int, str], set[str]] = {}
    for name, chain in chains.items():
        if chain[-1] not in wanted:  # else they are said to lie on each other
            layers.setdefault((len(chain), wanted[name]), set()).add(name)
    went_with: dict[str, str] = {}
    waiting = set(wanted)
    in_it = {r.subject for r in scene.relations if r.kind is RelationKind.IN}
    for (_, carrier), names in sorted(layers.items()):
        came = _let_go(scene, carrier, names, names & in_it, fixed, waiting, store)
        waiting -= names
        scene = replace(scene, objects=tuple(came.get(o.instance, o) for o in scene.objects))
        went_with |= dict.fromkeys(came, went_with.get(carrier, carrier))
    return DropResult(scene, went_with)


def leaning_in(scene: Scene, cup: str, names: Set[str], fixed: Set[str], store: AssetStore) -> Scene | None:
    """Long things put into a cup anew, with those that lean there already.

    Args:
        scene: The scene.
        cup: Instance of the cup.
        names: What is to be in it.
        fixed: Instances that must stay.
        store: Geometry of the assets.

    Returns:
        The scene with them where they came to lie; None where none did.
    """
    came = _let_go(scene, cup, names, names, fixed, names, store)
    return replace(scene, objects=tuple(came.get(o.instance, o) for o in scene.objects)) if came else None


def _down_from(name: str, wanted: Mapping[str, str]) -> list[str]:
    """A thing, what it is to be on or in, and so on down to what is to be on nothing, or was met before."""
    chain = [name]
    while (below := wanted.get(chain[-1])) is not None and below not in chain:
        chain.append(below)
    return chain


def _let_go(
    scene: Scene, carrier: str, names: Set[str], in_it: Set[str], fixed: Set[str], waiting: Set[str], store: AssetStore
) -> dict[str, SceneObject]:
    """Things of a scene where they come to lie on or in one that is held; without those for which that is no good place.

    Args:
        scene: The scene.
        carrier: What is held.
        names: What is let go.
        in_it: Those of them that are to be in it.
        fixed: Instances that must stay.
        waiting: Instances that are not where they are to be yet, and so hold up nothing.
        store: Geometry of the assets.
    """
    scene, shapes, _ = store.resolved(scene)
    shape_of = named(scene, shapes)
    hollow = hollow_of(scene[carrier], shape_of[carrier]) if in_it else None
    leaning = [] if hollow is None else _leaning(scene, carrier, in_it, fixed, hollow, store)
    upright = {o.instance for o in leaning}
    loose = [o for o in scene.objects if o.instance in names - upright]
    there = scene.resting_on({carrier}) | {
        o.instance for o in scene.objects if hollow is not None and is_inside(o, hollow, store)
    }
    there -= scene.resting_on(waiting | names | upright) | {carrier}
    still = [scene[carrier], *(o for o in scene.objects if o.instance in there)]
    part, own, _ = store.resolved(replace(scene, objects=(*still, *leaning, *loose)))
    part = _lowered(part, own, len(part.objects) - len(loose))
    try:
        bodies = bodies_of(part, own, store)
    except MeshError:
        return {}
    ended = settle([replace(body, movable=k >= len(still)) for k, body in enumerate(bodies)], scene.table, _SETTLING)
    if not np.isfinite(ended.moves).all():
        return {}
    outline = _outline(scene[carrier], shape_of[carrier])
    came = {}
    for k, o in list(enumerate(part.objects))[len(still) :]:
        x, y, z = ended.positions[k].tolist()
        a, b, c, d = ended.quats_xyzw[k].tolist()
        lies = _came_to_lie(o, ((x, y, z), (a, b, c, d)), store)
        if hollow is not None and is_inside(lies, hollow, store):
            is_well = o.instance in upright or bool(ended.moves[k] < _STRAYED and ended.turns[k] < _TOPPLED)
        else:  # what tips over an edge leans on it first
            is_well = bool(ended.moves[k] < _STRAYED and ended.turns[k] < _TIPPED and outline.covers(shapely.Point(x, y)))
            is_well &= o.instance not in upright
        if is_well:
            came[o.instance] = lies
    return came


def _leaning(
    scene: Scene, cup: str, names: Set[str], fixed: Set[str], hollow: ContainerInterior, store: AssetStore
) -> list[SceneObject]:
    """The long ones of some things and of what is in a cup, put into it; those that are there already before the others."""
    inside = [
        o for o in scene.objects if o.instance in names or (o.instance not in fixed | {cup} and is_inside(o, hollow, store))
    ]
    sticks = [o for o in inside if is_long(o, hollow, store)]
    found = stood(sorted(sticks, key=lambda o: o.instance in names), hollow, store)
    return found if names & {o.instance for o in found} else []


def _lowered(scene: Scene, shapes: Sequence[Shape], first: int) -> Scene:
    """A scene whose objects from a number on are well over its first one, come down on it and on each other."""
    meshes = MeshQueries([s if s.is_exact else Shape(s.vertices, s.faces) for s in shapes])
    poses = scene.poses()
    outline = _outline(scene.objects[0], shapes[0])
    inner = outline.buffer(-_INSET)
    for k in range(first, len(poses)):
        area = outline if inner.is_empty else inner
        poses[k, :2] = shapely.get_coordinates(nearest_points(area, shapely.Point(poses[k, :2]))[0])[0]
        poses[k, 2] = meshes.lowered(k, poses[k], range(k), poses)
    return scene.with_poses(poses)


def _outline(o: SceneObject, shape: Shape) -> shapely.Geometry:
    """Convex outline of a thing seen from above, world frame, metres."""
    return shapely.convex_hull(shapely.multipoints(shape.posed_footprint(np.array([*o.position, o.yaw]))))


def _came_to_lie(o: SceneObject, rest: RestPose, store: AssetStore) -> SceneObject:
    """An object where it came to lie, at the tilt that it had where that is as good as the same."""
    there = at_rest(o, store.mesh_of(o), rest)
    turn = Rotation.from_quat(there.tilt_quat_xyzw) * Rotation.from_quat(o.tilt_quat_xyzw).inv()
    if turn.magnitude() * float(np.linalg.norm(o.size)) / 2 < _SNAP:
        return o.moved(there.position, there.yaw)
    return there
