"""Certification of a scene after the flow: choice of the start layout and of the better result."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.certify.certifier import Certifier
from models.physics_corrector.certify.options import CertificationResult, CertifyOptions
from stable_data.geometry.shape import Shape
from stable_data.metrics.movement import movement
from stable_data.metrics.relations_kept import DIRECTIONAL
from stable_data.rotations import wrap_angle
from stable_data.scene import FloatArray, IntArray, Scene
from stable_data.scene_graph.relations import scene_graph
from stable_data.scene_graph.support_tree import SupportTree

# A flow that moves no object farther than this (metres along the table, radians about z) is ignored: it is about the error of
# the flow itself. Tuned on: not recorded.
_FLOW_ERROR, _FLOW_TURN_ERROR = 5e-3, float(np.radians(5))
_DEFAULT = CertifyOptions()


def certify_moved(
    scene: Scene,
    raw: Scene | None,
    shapes: Sequence[Shape],
    options: CertifyOptions = _DEFAULT,
    *,
    rearranges: bool = False,
) -> tuple[CertificationResult, Certifier]:
    """Certifies a scene from its poses after the flow; if the result is poor, also from the scene itself.

    A result is poor if it is infeasible or drops objects or, with ``options.twice``, if it breaks relations.

    Args:
        scene: The scene before the flow, with the known supports of its objects.
        raw: The scene after the flow; None without a flow.
        shapes: The geometry of its objects, in order.
        options: Settings.
        rearranges: Whether directions of ``raw`` are kept instead of those of ``scene``.

    Returns:
        The better result with its certifier: with fewer dropped objects, then fewer broken relations, then less movement.
    """
    start = choose_start(scene, raw, rearranges=rearranges)
    certifier = Certifier(start, shapes, options, start if rearranges else scene)
    result = certifier.certify()
    is_poor = result.scene is None or bool(result.dropped) or (options.twice and result.num_broken > 0 and not rearranges)
    if start is scene or not is_poor:
        return result, certifier

    def cost(each: tuple[CertificationResult, Certifier]) -> tuple[bool, int, int, float]:
        result = each[0]
        move = np.inf if result.scene is None else movement(scene, result.scene)[0]
        return result.scene is None, len(result.dropped), result.num_broken, move

    other = Certifier(scene, shapes, options)
    return min(((result, certifier), (other.certify(), other)), key=cost)


def choose_start(scene: Scene, raw: Scene | None, *, rearranges: bool = False) -> Scene:
    """Returns the start layout of `certify`: the scene after the flow, without harmful moves.

    The flow decides in which directions objects separate; the exact search finds millimetres and heights. If the flow moves no
    object farther than its own error, it can only add that error, and the scene itself is used. An object whose move breaks a
    directional relation returns to its pose with all that it carries, the farthest first: `certify` could hardly restore the
    relation, because of the objects between the two.

    Args:
        scene: The scene before the flow, with the known supports of its objects.
        raw: The scene after the flow; None without a flow.
        rearranges: Whether all moves of the flow are taken as they are.
    """
    if raw is None:
        return scene
    if rearranges:
        return raw
    start, poses = scene.poses(), raw.poses()
    steps = poses - start
    turns = np.abs(wrap_angle(steps[:, 3]))
    if ((np.linalg.norm(steps[:, :2], axis=1) < _FLOW_ERROR) & (turns < _FLOW_TURN_ERROR)).all():
        return scene
    one, other, axis = _directional_pairs(scene, start)
    sign = np.sign(start[one, axis] - start[other, axis])
    supports = SupportTree.of(scene.objects)
    for _ in scene.objects:
        apart = poses[one, :2] - poses[other, :2]
        each = np.arange(len(one))
        broken = sign * apart[each, axis] <= np.abs(apart[each, 1 - axis])
        ends = np.concatenate([one[broken], other[broken]])
        lengths = np.linalg.norm(poses[ends, :2] - start[ends, :2], axis=1)
        if not lengths.any():
            break
        returned = supports.with_descendants({scene.objects[int(ends[lengths.argmax()])].instance})
        back = [k for k, o in enumerate(scene.objects) if o.instance in returned]
        poses[back] = start[back]
    return scene.with_poses(poses)


def _directional_pairs(scene: Scene, poses: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Returns pairs (E,) of objects with a directional relation, each once, and the axis of their larger distance, 0 or 1."""
    number = {o.instance: k for k, o in enumerate(scene.objects)}
    edges = scene_graph(scene, {}).edges(keys=True)
    pairs = {tuple(sorted((number[s], number[t]))) for s, t, kind in edges if kind in DIRECTIONAL}
    one, other = np.array(sorted(pairs), np.int64).reshape(-1, 2).T
    apart = np.abs(poses[one, :2] - poses[other, :2])
    return one, other, (apart[:, 1] >= apart[:, 0]).astype(np.int64)
