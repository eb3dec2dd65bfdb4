"""A batch of layouts to refine: scenes, shapes, supports, and how easily each body moves."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.certify.layout_state import STIFFNESS
from models.physics_corrector.certify.support_inference import expected_carriers
from models.physics_corrector.geometry.scene_batch import LayoutBatch, pad_scenes
from models.physics_corrector.refinement.contact_shapes import ContactShapeCache, ContactShapes
from models.physics_corrector.refinement.support_forest import SupportForest
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene
from stable_data.scene_graph.relations import NEAREST, REACH


@dataclass(frozen=True, slots=True, eq=False)
class DirectionalOrders:
    """K directional relations of pairs of objects, each pair once; objects are flat indices.

    Attributes:
        subject: (K,) int64.
        target: (K,) int64.
        axis: 0 for left of and right of, 1 for in front of and behind, (K,) int64.
        sign: 1 if the subject is right of or behind its target, else -1, (K,).
    """

    subject: Tensor
    target: Tensor
    axis: Tensor
    sign: Tensor

    @classmethod
    def of(cls, layout: LayoutBatch, forest: SupportForest) -> "DirectionalOrders":
        """Finds the relations of a batch that a separation of bodies must preserve: those between objects of different bodies.

        As in the scene graph, an object is linked to its nearest ones within a share of the table's longer side.
        """
        num_slots = layout.mask.shape[1]
        places = layout.poses[..., :2]
        apart = places[:, :, None] - places[:, None]
        distance = apart.norm(dim=-1)
        is_pair = layout.mask[:, :, None] & layout.mask[:, None] & ~torch.eye(num_slots, dtype=torch.bool, device=places.device)
        distance = torch.where(is_pair, distance, torch.inf)
        near = distance.topk(min(NEAREST, num_slots), dim=2, largest=False).indices
        linked = torch.zeros_like(is_pair).scatter(2, near, True)
        linked &= is_pair & (distance <= REACH * layout.table.amax(dim=1)[:, None, None])
        linked |= linked.transpose(1, 2).clone()
        scene, one, other = torch.triu(linked, 1).nonzero(as_tuple=True)
        step = apart[scene, one, other]
        axis = (step[:, 1].abs() >= step[:, 0].abs()).long()
        sign = torch.sign(step.gather(1, axis[:, None])[:, 0])
        subject, target = scene * num_slots + one, scene * num_slots + other
        counts = (forest.root[subject] != forest.root[target]) & (sign != 0)
        return cls(subject[counts], target[counts], axis[counts], sign[counts])

    def to(self, device: torch.device | str) -> "DirectionalOrders":
        """Copies the tensors to a device."""
        return DirectionalOrders(*(getattr(self, name).to(device) for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class RefinementProblem:
    """B scenes of N slots to refine; M = B * N.

    Attributes:
        layout: The scenes.
        shapes: Their shapes.
        forest: Their supports.
        orders: The directional relations to preserve.
        mobility: How easily each body moves, (M,): the inverse of its stiffness, 0 if an object of it is fixed. Read it at roots.
    """

    layout: LayoutBatch
    shapes: ContactShapes
    forest: SupportForest
    orders: DirectionalOrders
    mobility: Tensor

    @classmethod
    def of(
        cls,
        scenes: Sequence[Scene],
        shapes: Sequence[Sequence[Shape]],
        fixed: Sequence[Set[str]],
        origins: Sequence[Scene],
        cache: ContactShapeCache,
    ) -> "RefinementProblem":
        """Converts scenes.

        Args:
            scenes: The scenes, positions at the centres of the boxes. The support of an object is the one that the scene's
                relations name, else its own ``support``, else the table.
            shapes: The geometry of the objects of each scene.
            fixed: The instances of each scene that must not move.
            origins: The same scenes at the poses whose directional relations are preserved.
            cache: Makes the contact shapes.
        """
        known = [_with_supports(scene) for scene in scenes]
        arrays = {name: torch.from_numpy(value) for name, value in pad_scenes(known, shapes, fixed).items()}
        shape_index, stiffness = torch.zeros_like(arrays["parent"]), torch.zeros(arrays["mask"].shape)
        contact_shapes, indices = cache.shapes_of(known, shapes)
        for b, (scene, own) in enumerate(zip(known, indices, strict=True)):
            count = len(own)
            shape_index[b, :count] = torch.tensor(own)
            stiffness[b, :count] = torch.tensor([STIFFNESS[o.stage] for o in scene.objects])
        layout = LayoutBatch(shape_index=shape_index, **arrays)
        forest = SupportForest.of(layout)
        before = layout.poses.clone()
        for b, scene in enumerate(origins):
            before[b, : len(scene.objects)] = torch.from_numpy(scene.poses()).float()
        of_body = torch.zeros(stiffness.numel()).index_add(0, forest.root, stiffness.reshape(-1))
        is_stuck = torch.zeros(stiffness.numel()).index_add(0, forest.root, layout.is_fixed.reshape(-1).float()) > 0
        mobility = torch.where(is_stuck | (of_body == 0), 0.0, 1 / of_body.clamp_min(1e-9))
        return cls(layout, contact_shapes, forest, DirectionalOrders.of(replace(layout, poses=before), forest), mobility)

    @property
    def carried(self) -> Tensor:
        """The objects that are on or in another one and may move, (M,) bool."""
        return (self.forest.level > 0) & (self.mobility[self.forest.root] > 0)

    def to(self, device: torch.device | str) -> "RefinementProblem":
        """Copies the tensors to a device."""
        layout, shapes = self.layout.to(device), self.shapes.to(device)
        return RefinementProblem(layout, shapes, self.forest.to(device), self.orders.to(device), self.mobility.to(device))

    def half_sizes(self, margin: float) -> Tensor:
        """Half sizes of the boxes, enlarged so that boxes nearer than a margin in metres meet, (B, N, 3)."""
        return self.layout.sizes / 2 + margin / 2


def _with_supports(scene: Scene) -> Scene:
    """Returns a scene whose objects have the supports that its relations name; other objects keep theirs."""
    carriers = expected_carriers(scene)
    if not carriers:
        return scene
    names = [o.instance for o in scene.objects]
    objects = [replace(o, support=names[carriers[k].parent]) if k in carriers else o for k, o in enumerate(scene.objects)]
    return replace(scene, objects=tuple(objects))
