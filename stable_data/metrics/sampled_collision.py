"""Object collisions by the paper's own rule, beside the exact ones, so that figures can be compared.

The paper counts a pair as colliding if the signed distance of one object to the other is negative: a sample of the surface of one is
inside the other, however deep. The rule has no tolerance, so that an object at rest on another one can collide with it by a rounding
error, and a thin object can pass between the samples.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface_sampling import surface_points
from stable_data.metrics.card import MetricCard
from stable_data.metrics.verdicts import Audit
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Scene

NUM_SAMPLES = 256
"""Samples of an object's surface."""

_CANDIDATES = 2  # for each sample

_SAMPLED: "WeakKeyDictionary[Shape, tuple[FloatArray, SignedDistance]]" = WeakKeyDictionary()


def add_sampled_collisions(card: MetricCard, scene: Scene, shapes: Sequence[Shape], audit: Audit) -> MetricCard:
    """Adds ``oc_sdf`` to a card: the share of pairs in which a surface sample of one object is inside the other.

    Args:
        card: The card of the scene.
        scene: The scene.
        shapes: The geometry of its objects, in order.
        audit: Its exact audit; objects that it finds apart have no sample inside each other.
    """
    number = {o.instance: k for k, o in enumerate(scene.objects)}
    poses, count = scene.poses(), 0
    for pair in audit.pairs:
        i, j = number[pair.first], number[pair.second]
        if pair.penetration is None or not (shapes[i].is_exact and shapes[j].is_exact):
            return replace(card, oc_sdf=None)
        count += _collide(shapes[i], poses[i], shapes[j], poses[j])
    return replace(card, oc_sdf=count / max(1, audit.num_pairs))


def num_sampled_collisions(scene: Scene, shapes: Sequence[Shape]) -> int:
    """Counts pairs of objects of which one has a surface sample inside the other, without an audit.

    Args:
        scene: The scene.
        shapes: The geometry of its objects, in order.
    """
    posed = list(zip(shapes, scene.poses(), strict=True))
    return sum(_collide(*one, *other) for one, other in combinations(posed, 2))


def prepare_samples(shapes: Sequence[Shape]) -> None:
    """Computes what is kept of shapes: their samples and signed distances."""
    for shape in shapes:
        _sampled(shape)


def _collide(one: Shape, one_pose: npt.NDArray[np.float64], other: Shape, other_pose: npt.NDArray[np.float64]) -> bool:
    """Whether a surface sample of one of two objects is inside the other."""
    return _enters(one, one_pose, other, other_pose) or _enters(other, other_pose, one, one_pose)


def _enters(guest: Shape, guest_pose: npt.NDArray[np.float64], host: Shape, host_pose: npt.NDArray[np.float64]) -> bool:
    """Whether a surface sample of one object is inside another one."""
    turn = guest_pose[3] - host_pose[3]
    apart = rotate_xy((guest_pose[:2] - host_pose[:2])[None], -host_pose[3])[0]
    points, distance = _sampled(guest)[0], _sampled(host)[1]
    placed = np.column_stack([rotate_xy(points[:, :2], turn) + apart, points[:, 2] + guest_pose[2] - host_pose[2]])
    near = placed[(np.abs(placed) <= host.size / 2).all(axis=1)]
    return bool(distance.is_inside(near).any())


def _sampled(shape: Shape) -> tuple[FloatArray, SignedDistance]:
    """The samples of a shape's surface, (P, 3) float64, and its signed distance, both in its yaw frame; computed once."""
    if shape not in _SAMPLED:
        mesh = Mesh(shape.vertices, shape.faces)
        _SAMPLED[shape] = surface_points(mesh, NUM_SAMPLES, candidates=_CANDIDATES)[0].astype(np.float64), SignedDistance(mesh)
    return _SAMPLED[shape]
