"""The rules of the criterion "Layout Coherence & Realism": facing, order, reach, company, spread, and what stands in front."""

import math
from collections.abc import Iterator, Mapping, Sequence

import igl
import numpy as np

from models.scene_rating.fault import Fault, score_by, unknown
from models.scene_rating.rating_case import AuditedScene
from models.scene_rating.task_reader import TaskReader
from models.scene_rating.usual_layouts import (
    UPRIGHT,
    UsualLayouts,
    UsualTurn,
    askew,
    offset_of,
    spread_of,
    standing_objects,
    turned_away,
)
from stable_data.geometry.shape import Shape
from stable_data.rating.rating import CriterionScore
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Scene, SceneObject
from stable_data.scene_graph.relations import yawed_rectangle

REACH = 0.8
"""Distance from the front edge that a person reaches over a table, metres: about the length of an arm; a round figure."""

_FACES_FRONT = 0.95  # share of the objects of a category that face the front edge, so that its front counts
_AWAY = math.radians(90)  # an object that is turned farther does not face the user
_KEPT_STRAIGHT, _ASKEW = (
    math.radians(30),
    math.radians(36),
)  # 95 % quantile of a category that is kept straight; an object that is not
_SHOWS = 0.08  # distance by which a turn changes a shape, as a share of its longer side, from which it can be seen
_FEW = 0.5  # share of the others with which a category usually stands, below which it is out of place
_FRONT_ROW = 1 / 3  # share of the table's depth in which a tall object hides others
_EYE_SLOPE, _COVERED = 0.6, 0.5  # slope at which the viewer looks down, and the share of the other's width that is covered
_PROBES = 400  # vertices that are compared

_SEVERITY = {"away": 0.15, "askew": 0.06, "reach": 0.2, "company": 0.15, "spread": 0.8, "hidden": 0.08}


class LayoutRules:
    """Judges whether a person would arrange a table so, by how the things of a category usually stand.

    Only what shows is a fault: a turned candle is none. Task objects need no usual company, since the task asks for them.

    Args:
        usual: Statistics of layouts.
        reader: Reads the tasks of scenes.
    """

    def __init__(self, usual: UsualLayouts, reader: TaskReader) -> None:
        self._usual, self._reader = usual, reader

    def __call__(self, case: AuditedScene) -> CriterionScore:
        """Returns the score; unknown if neither turns nor company, spread or reach can be judged."""
        scene, standing = case.scene, standing_objects(case.scene)
        if not scene.movable:
            return unknown("the scene has no objects")
        if not standing:
            return unknown("no object is known to stand on the table")
        row = {o.instance: shape for o, shape in zip(scene.objects, case.geometry.shapes, strict=True)}
        named = self._reader.task_objects(case)
        wanted, others = ([o for o in scene.movable if (o.instance in named) == is_named] for is_named in (True, False))
        turns = {o.instance: turn for o in standing if (turn := self._usual_turn(o)) is not None}
        company = self._company(scene, others)
        with_company = [o for o in others if o.category in company]
        limits = self._usual.limits(len(scene.movable))
        checked = {
            f"the turn of {len(turns)} of {len(standing)} standing objects": len(turns),
            f"the company of {len(with_company)} of {len(others)} objects": len(with_company),
            "the spread": limits is not None,
            f"the reach of {len(wanted)} task objects": len(wanted),
        }
        if not any(checked.values()):
            return unknown(
                "turns and company of the objects are not known, the task names none, and for a spread they are too few"
            )
        unknown_turns, alone = len(standing) - len(turns), len(others) - len(with_company)
        kind, is_known_table = scene.table.table_type, self._usual.knows_table(scene.table.table_type)
        left_out = {
            f"the turn of {unknown_turns} objects of other categories, or tilted": unknown_turns,
            f"the company of {alone} objects of other categories, or among few known ones": alone,
            "the spread of so few objects": limits is None,
            f"what is special to a {kind}, a kind of table without statistics": with_company and not is_known_table,
        }
        faults = [f for o in standing if o.instance in turns for f in _turn_faults(o, turns[o.instance], row[o.instance])]
        faults += _company_faults(company, kind)
        faults += [] if limits is None else _place_faults(scene, *limits)
        faults += _reach_faults(wanted)
        faults += _front_row_faults(standing, scene.table.size_xy[1])
        said = [*(words for words, applies in checked.items() if applies), "what stands in front"]
        return score_by(faults, said, [words for words, applies in left_out.items() if applies])

    def _usual_turn(self, o: SceneObject) -> UsualTurn | None:
        """How things like an object usually stand; None if that is not known, or if it is tilted, so that its yaw says nothing."""
        return self._usual.turn(o.category) if o.tilt_angle <= UPRIGHT else None

    def _company(self, scene: Scene, judged: Sequence[SceneObject]) -> dict[str, float]:
        """Category of a judged object -> the share of the other categories with which it usually stands, where that is known."""
        categories = sorted({o.category for o in scene.movable})
        shares = {
            name: self._usual.company(name, categories, scene.table.table_type) for name in sorted({o.category for o in judged})
        }
        return {name: share for name, share in shares.items() if share is not None}


def _turn_faults(o: SceneObject, usual: UsualTurn, shape: Shape) -> Iterator[Fault]:
    away, deviation = turned_away(o.yaw), askew(o.yaw)
    if usual.front >= _FACES_FRONT and away > _AWAY and turn_shows(shape, o.yaw):
        yield Fault(_SEVERITY["away"], f"{o.instance} faces away, by {math.degrees(away):.0f} degrees")
    elif usual.askew <= _KEPT_STRAIGHT and deviation > _ASKEW and turn_shows(shape, deviation):
        yield Fault(_SEVERITY["askew"], f"{o.instance} stands askew, by {math.degrees(deviation):.0f} degrees")


def _place_faults(scene: Scene, least: float, most: float) -> Iterator[Fault]:
    """A layout that takes too little of the table, or stands too far from its middle."""
    share, offset = spread_of(scene), offset_of(scene)
    if share < least:
        words = f"everything stands within {share:.0%} of the table, usual are {least:.0%} or more"
        yield Fault(_SEVERITY["spread"] * (1 - share / least), words)
    if offset > most:
        words = f"the objects are {offset:.0%} of the way from the middle of the table to an edge, usual are {most:.0%} or less"
        yield Fault(_SEVERITY["spread"] * min(1.0, (offset - most) / max(1 - most, 1e-6)), words)


def _company_faults(company: Mapping[str, float], table_type: str) -> Iterator[Fault]:
    for category, share in company.items():
        if share < _FEW:
            words = f"{category} does not belong on a {table_type} with the others"
            yield Fault(_SEVERITY["company"] * (1 - share), words)


def turn_shows(shape: Shape, angle: float) -> bool:
    """Returns whether a turn about the vertical changes a shape so much that it can be seen.

    Args:
        shape: The shape.
        angle: Radians.
    """
    vertices = shape.vertices
    probes = vertices[np.linspace(0, len(vertices) - 1, min(_PROBES, len(vertices))).astype(int)]
    turned: FloatArray = probes.copy()
    turned[:, :2] = rotate_xy(probes[:, :2], angle)
    distance = np.sqrt(igl.point_mesh_squared_distance(turned, vertices, shape.faces)[0].max())
    return bool(distance > _SHOWS * max(shape.size[:2]))


def _reach_faults(wanted: Sequence[SceneObject]) -> Iterator[Fault]:
    for o in wanted:
        distance = float(yawed_rectangle(o)[:, 1].min())
        if distance > REACH:
            yield Fault(_SEVERITY["reach"], f"{o.instance} is {100 * distance:.0f} cm from the front edge, out of reach")


def _front_row_faults(standing: Sequence[SceneObject], depth: float) -> Iterator[Fault]:
    """Objects of which one in the front row hides the top and the half of the width or more from a viewer at the front edge."""
    spans = {o.instance: yawed_rectangle(o)[:, 0] for o in standing}
    front = [o for o in standing if o.position[1] < _FRONT_ROW * depth]
    for o in standing:
        low, high = float(spans[o.instance].min()), float(spans[o.instance].max())
        for other in front:
            apart = float(yawed_rectangle(o)[:, 1].min() - yawed_rectangle(other)[:, 1].max())
            if other is o or apart < 0 or other.top - _EYE_SLOPE * apart < o.top:
                continue
            common = min(high, float(spans[other.instance].max())) - max(low, float(spans[other.instance].min()))
            if common >= _COVERED * max(high - low, 1e-6):
                yield Fault(_SEVERITY["hidden"], f"{o.instance} is behind {other.instance}, a taller one at the front edge")
                break
