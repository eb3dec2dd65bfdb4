"""The rules of the criterion "Object Visibility": the visible shares of silhouettes from the two cameras."""

import numpy as np

from models.scene_rating.fault import Fault, listed, score_by, unknown
from models.scene_rating.rating_case import AuditedScene
from models.scene_rating.task_reader import TaskReader
from stable_data.rating.rating import CriterionScore
from stable_data.simulation.visibility import visible_shares

_ENOUGH = 0.3  # visible share of a silhouette, in the better of the two pictures, that shows an object
_HIDDEN, _TASK_HIDDEN = 0.15, 0.5  # severity of a hidden object, and of one of the task


class VisibilityRules:
    """Judges how much of each object the two cameras see: an object counts by the picture that shows more of it.

    Args:
        reader: Reads the tasks of scenes.
    """

    def __init__(self, reader: TaskReader) -> None:
        self._reader = reader

    def __call__(self, case: AuditedScene) -> CriterionScore:
        """Returns the score; unknown for a scene without objects, or with none that is large enough in the pictures."""
        scene = case.scene
        if not scene.movable:
            return unknown("the scene has no objects")
        shares = np.fmax(visible_shares(case.geometry, "front"), visible_shares(case.geometry, "perspective"))
        wanted = self._reader.task_objects(case)
        faults, seen, small = [], [], []
        for o, share in zip(scene.objects, shares.tolist(), strict=True):
            if o.instance in scene.fixed:
                continue
            if np.isnan(share):
                small.append(o.instance)
                continue
            seen.append(share)
            if share < _ENOUGH:
                worst = _TASK_HIDDEN if o.instance in wanted else _HIDDEN
                faults.append(Fault(worst * (1 - share / _ENOUGH), f"{o.instance} is hidden, {share:.0%} of it can be seen"))
        if not seen:
            return unknown("every object is too small for its silhouette")
        boxes = sum(not shape.is_exact for shape in case.geometry.shapes)
        left_out = [f"the shapes of {boxes} objects without meshes, which count as boxes"] if boxes else []
        left_out += [f"objects that are too small for their silhouettes ({listed(small)})"] if small else []
        return score_by(faults, [f"{len(seen)} objects, of which {np.mean(seen):.0%} can be seen on average"], left_out)
