"""The judge by rules: real scenes score high, and each kind of bad scene lowers the right criterion."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.rating import BAD, Change, with_all_turned_away, with_giant, with_task_object_under_table, without_task_object
from models.scene_rating.fault import Fault, score_by
from models.scene_rating.layout_rules import LayoutRules, turn_shows
from models.scene_rating.placement_rules import PlacementRules
from models.scene_rating.rating_case import AuditedScene, RatingCase
from models.scene_rating.settings import RatingSettings
from models.scene_rating.size_rules import SizeRules
from models.scene_rating.symbolic_judge import SymbolicJudge, _foundations, rules_version
from models.scene_rating.task_reader import TaskReader
from models.scene_rating.task_rules import interpreter_for
from models.scene_rating.usual_layouts import UsualLayouts
from models.scene_rating.visibility_rules import VisibilityRules
from stable_data.assets.store import AssetStore
from stable_data.instructions.naming import shows_look
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.alignment import Alignment, AlignmentReference
from stable_data.rating.criteria import KEYS
from stable_data.rating.rating import CriterionScore, Rating
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, TaskInfo, Vec3
from stable_data.simulation.scene_geometry import SceneGeometry

TIPPED = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""A quarter turn about x."""


class Rater:
    """Rates the scenes of a dataset, as they are or changed."""

    def __init__(self, root: Path) -> None:
        self.dataset = MesaTaskDataset(root)
        self.store, self.judge = AssetStore(self.dataset), SymbolicJudge()
        self.reader = TaskReader(interpreter_for(["frobnicator"]))
        self._known: dict[str, Rating] = {}

    def scene(self, table_type: str) -> Scene:
        (name,) = (scene_id for scene_id in self.dataset.scene_ids if scene_id.startswith(table_type))
        return self.dataset.read(name)[0]

    def geometry(self, scene: Scene) -> SceneGeometry:
        known = {o.asset_id: self.dataset.annotation(o.asset_id) for o in scene.objects if o.asset_id}
        return replace(SceneGeometry.of(scene, self.store), annotations=known)

    def rate(self, scene: Scene) -> Rating:
        (rating,) = self.judge.rate([RatingCase.of(self.geometry(scene))])
        return rating

    def unchanged(self, scene: Scene) -> Rating:
        if scene.scene_id not in self._known:
            self._known[scene.scene_id] = self.rate(scene)
        return self._known[scene.scene_id]


@pytest.fixture(scope="module")
def rater(dataset: Path) -> Rater:
    return Rater(dataset)


TABLES = ("bathroom_vanity", "coffee_table", "dining_table", "dressing_table")


def changed_by(change: Change, scene: Scene) -> Scene:
    changed = change(scene)
    assert changed is not None
    return changed


def each(scene: Scene, change: Callable[[SceneObject], SceneObject]) -> Scene:
    return replace(scene, objects=tuple(map(change, scene.objects)))


HAS_FRONTS = ("bathroom_vanity", "dressing_table")
"""Elsewhere nothing shows that it is turned away."""


@pytest.mark.parametrize("table", TABLES)
def test_scenes_of_the_embedded_world_score_high_and_pass(rater: Rater, table: str) -> None:
    rating = rater.unchanged(rater.scene(table))
    assert rating.average is not None
    assert rating.average > 9.3
    assert min(rating.score(key) or 0 for key in KEYS) > 8.5
    assert (rating.clean, rating.quality_pass, rating.code) == (True, True, "")
    assert all(score.rationale for score in rating.scores.values())


@pytest.mark.parametrize("what", BAD)
def test_a_bad_scene_loses_in_the_right_criterion(rater: Rater, what: str) -> None:
    change, key = BAD[what]
    for table in HAS_FRONTS:
        scene = rater.scene(table)
        before, after = rater.unchanged(scene), rater.rate(changed_by(change, scene))
        lost = (before.score(key) or 0) - (after.score(key) or 0)
        assert lost > 1.5, f"{table}: {after.scores[key].rationale}"
        assert after.average is not None
        assert before.average is not None
        assert after.average < before.average
    if what == "a task object is removed":  # what has nothing to do with it stays as it is
        assert after.score("osr") == before.score("osr")
    if what in ("two things are in one place", "a task object is under the table"):
        assert after.quality_pass is False


@pytest.mark.slow
@pytest.mark.parametrize("what", BAD)
def test_a_bad_scene_loses_in_the_right_criterion_on_all_tables(rater: Rater, what: str) -> None:
    change, key = BAD[what]
    for table in HAS_FRONTS if what == "all is turned away" else TABLES:
        scene = rater.scene(table)
        before, after = rater.unchanged(scene), rater.rate(changed_by(change, scene))
        assert (before.score(key) or 0) - (after.score(key) or 0) > 1.0, f"{table}: {after.scores[key].rationale}"


def test_the_reasons_name_what_is_wrong(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    said = {
        without_task_object: ("cwt", "missing: mirror"),
        with_giant: ("osr", "times too large"),
        with_all_turned_away: ("lcr", "1_mirror_0 faces away"),
        with_task_object_under_table: ("ov", "1_mirror_0 is hidden"),
    }
    for change, (key, words) in said.items():
        assert words in rater.rate(changed_by(change, scene)).scores[key].rationale


def test_equal_scenes_have_equal_ratings_and_pictures_do_not_count(rater: Rater) -> None:
    scene = rater.scene("coffee_table")
    case = RatingCase.of(rater.geometry(scene), np.zeros((8, 8, 3), np.uint8))
    assert rater.judge.rate([case, RatingCase.of(rater.geometry(scene))]) == [rater.unchanged(scene)] * 2


def test_stated_relations_and_looks_count(rater: Rater) -> None:
    scene = rater.scene("coffee_table")  # a tumbler stands on a coaster
    assert scene.task is not None
    apart = each(scene, lambda o: o.moved((0.1, 0.1, o.size[2] / 2), o.yaw) if o.category == "tumbler" else o)
    rating = rater.rate(apart)
    assert "does not hold: tumbler on coaster" in rating.scores["cwt"].rationale
    assert rating.score("cwt") == pytest.approx(4.6)
    own = next(o.description for o in scene.objects if o.category == "tumbler")
    other = next(colour for colour in ("red", "pink", "yellow") if shows_look(own, colour) is False)
    rating = rater.rate(replace(scene, task=TaskInfo("", f"Pick up the {other} tumbler.")))
    assert f"no {other} tumbler" in rating.scores["cwt"].rationale
    assert rating.score("cwt") == pytest.approx(6.4)


UNKNOWN: dict[str, tuple[Callable[[Scene], Scene], str, str]] = {
    "no task": (lambda s: replace(s, task=None), "cwt", "no instruction"),
    "unknown words": (
        lambda s: replace(s, task=TaskInfo("", "Grok the frobnicator.")),
        "cwt",
        "no object that the instruction names",
    ),
    "no known sizes": (lambda s: each(s, lambda o: replace(o, category="frobnicator")), "osr", "usual size of no object"),
    "a missing mesh": (
        lambda s: each(s, lambda o: replace(o, asset_id=None) if o is s.objects[0] else o),
        "ppi",
        "leaves verdicts open",
    ),
}


@pytest.mark.parametrize("what", UNKNOWN)
def test_what_no_rule_can_judge_is_unknown_and_so_is_the_average(rater: Rater, what: str) -> None:
    change, key, why = UNKNOWN[what]
    rating = rater.rate(change(rater.scene("dressing_table")))
    assert rating.score(key) is None
    assert why in rating.scores[key].rationale
    assert (rating.average, rating.quality_pass, rating.code) == (None, None, "criterion_unknown")
    assert why in rating.reason
    assert any(rating.score(other) is not None for other in KEYS)


def test_a_scene_without_objects_or_geometry_is_unknown(rater: Rater) -> None:
    empty = replace(rater.scene("dressing_table"), objects=(), task=None)
    case = RatingCase.of(rater.geometry(empty))
    whole, bare = rater.judge.rate([case, case.without_geometry()])
    assert [whole.score(key) for key in KEYS] == [None] * 5
    assert (bare.code, dict(bare.scores)) == ("geometry_missing", {})


def test_unknown_categories_are_left_out_and_said(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    odd = each(scene, lambda o: replace(o, category="frobnicator") if o.category == "cream_jar" else o)
    audited = AuditedScene.of(rater.geometry(odd))
    layout = LayoutRules(UsualLayouts.load(), rater.reader)
    for rules, words in ((SizeRules(), "frobnicator"), (layout, "of other categories")):
        score = rules(audited)
        assert score.score is not None
        assert "left out" in score.rationale
        assert words in score.rationale


def sized(o: SceneObject, size: Vec3) -> SceneObject:
    """An object of another size, on the table."""
    assert o.scale is not None
    x, y, z = (scale * new / old for scale, new, old in zip(o.scale, size, o.size, strict=True))
    return replace(o, size=size, scale=(x, y, z), position=(*o.position[:2], size[2] / 2))


def layout_score(rater: Rater, scene: Scene) -> CriterionScore:
    return LayoutRules(UsualLayouts.load(), rater.reader)(AuditedScene.of(rater.geometry(scene)))


def test_a_layout_of_which_nothing_is_known_is_unknown_and_no_perfect_one(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    mirror = next(o for o in scene.objects if o.category == "mirror")
    bare = replace(scene, task=None, objects=(replace(mirror, category="frobnicator"),))
    found = layout_score(rater, bare)
    assert found.score is None
    assert "not known" in found.rationale
    known = layout_score(rater, replace(bare, objects=(mirror,)))  # how a mirror is turned is known, its company is not
    assert known.score is not None
    checked, _, left_out = known.rationale.partition("left out: ")
    assert "the turn of 1 of 1 standing objects" in checked
    assert "company" not in checked
    assert "the company of 1 objects" in left_out
    assert "the spread of so few objects" in left_out
    a, b, c = mirror.size
    lying = replace(mirror, size=(a, c, b), tilt_quat_xyzw=TIPPED, position=(*mirror.position[:2], b / 2))
    tilted = layout_score(rater, replace(bare, objects=(lying,)))  # its yaw says nothing about its front
    assert (tilted.score, tilted.rationale) == (None, found.rationale)
    task = TaskInfo("", "Pick up the frobnicator.")
    assert "the reach of 1 task objects" in layout_score(rater, replace(bare, task=task)).rationale


def test_what_takes_most_of_the_table_is_too_large_whatever_it_is(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    (width, depth), odd = scene.table.size_xy, each(scene, lambda o: replace(o, category="frobnicator"))
    assert SizeRules()(AuditedScene.of(rater.geometry(odd))).score is None
    huge = each(odd, lambda o: sized(o, (0.9 * width, 0.8 * depth, 0.05)) if o is odd.objects[0] else o)
    huge = replace(huge, objects=tuple(replace(o, yaw=0.0) for o in huge.objects))
    score = SizeRules()(AuditedScene.of(rater.geometry(huge)))
    assert score.score == pytest.approx(1 + 9 * 0.5 / 0.72, abs=0.01)
    assert "takes 72% of the table" in score.rationale


def test_what_is_too_small_for_the_pictures_is_left_out_and_not_hidden(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    jar = next(o for o in scene.objects if o.category == "cream_jar")
    tiny = each(scene, lambda o: sized(o, (0.002, 0.002, 0.002)) if o is jar else o)
    rules = VisibilityRules(rater.reader)
    score = rules(AuditedScene.of(rater.geometry(tiny)))
    assert score.score is not None
    assert f"too small for their silhouettes ({jar.instance})" in score.rationale
    assert f"{jar.instance} is hidden" not in score.rationale
    alone = replace(tiny, objects=tuple(o for o in tiny.objects if o.instance == jar.instance))
    assert rules(AuditedScene.of(rater.geometry(alone))).score is None


def test_the_version_of_the_rules_is_of_all_that_they_rest_on(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = rules_version()
    assert rules_version(["mug", "mirror"]) == plain  # the embedded world has these
    assert rules_version(["zarf", "mug"]) == rules_version(["mug", "zarf", "zarf"]) != plain
    assert RatingSettings().shaping() == {"judge": "symbolic", "version": plain}
    changes = {
        "load_default": lambda: SimpleNamespace(fingerprint="another text encoder"),
        "reader_fingerprint": lambda: "another reader",
        "RULES_VERSION": 0,
    }
    places = {"load_default": "models.text_encoder.load_default"}
    for name, change in changes.items():
        with monkeypatch.context() as patch:
            patch.setattr(places.get(name, f"models.scene_rating.symbolic_judge.{name}"), change)
            _foundations.cache_clear()
            assert rules_version() != plain, name
    _foundations.cache_clear()
    assert rules_version() == plain


def test_a_thing_that_leans_is_as_large_as_it_is(rater: Rater) -> None:
    scene = rater.scene("dressing_table")  # brushes lean in a holder
    assert any(o.tilt_angle > 0.1 for o in scene.objects)
    assert SizeRules()(AuditedScene.of(rater.geometry(scene))).score == 10.0


def test_a_turn_shows_only_where_a_shape_changes(rater: Rater) -> None:
    geometry = rater.geometry(rater.scene("dressing_table"))
    shapes = {o.category: shape for o, shape in zip(geometry.scene.objects, geometry.shapes, strict=True)}
    assert turn_shows(shapes["mirror"], math.pi)
    assert not turn_shows(shapes["mirror"], 0.0)
    assert not turn_shows(shapes["cream_jar"], math.pi)


def test_faults_multiply_and_the_worst_come_first() -> None:
    assert score_by([], ["all"]).score == 10.0
    found = score_by([Fault(0.1, "small"), Fault(0.5, "large")], ["all"], ["rest"])
    assert found.score == pytest.approx(1 + 9 * 0.45)
    assert found.rationale == "large; small; checked: all; left out: rest"
    many = score_by([Fault(1.0, f"fault {k}") for k in range(6)], [])
    assert many.score == 1.0
    assert many.rationale.endswith("fault 3; 2 more faults")


def test_placement_follows_the_audit(rater: Rater) -> None:
    scene = rater.scene("dressing_table")
    lifted = each(scene, lambda o: o.moved((*o.position[:2], o.position[2] + 0.05), o.yaw) if o is scene.objects[0] else o)
    outside = each(scene, lambda o: o.moved((-0.02, *o.position[1:]), o.yaw) if o is scene.objects[0] else o)
    rules = PlacementRules()
    assert "floats" in rules(AuditedScene.of(rater.geometry(lifted))).rationale
    assert "reaches over the edge" in rules(AuditedScene.of(rater.geometry(outside))).rationale
    audited = AuditedScene.of(rater.geometry(lifted))
    unmeasured = tuple(replace(o, gap=None) for o in audited.audit.objects)
    open_ = rules(replace(audited, audit=replace(audited.audit, objects=unmeasured)))  # how far something floats is not known
    assert open_.score is None
    assert scene.objects[0].instance in open_.rationale


def test_task_objects_weigh_more_when_they_are_hidden(rater: Rater) -> None:
    scene = rater.scene("dining_table")
    hidden = changed_by(with_task_object_under_table, scene)
    audited, nobodys = (AuditedScene.of(rater.geometry(s)) for s in (hidden, replace(hidden, task=None)))
    of_task, of_none = (VisibilityRules(rater.reader)(one).score for one in (audited, nobodys))
    assert of_task is not None
    assert of_none is not None
    assert of_task < of_none - 1


ATTACHED: dict[str, Callable[[Scene, TaskInfo], TaskInfo]] = {
    "nothing": lambda scene, task: replace(task, task_objects=(), relations=()),
    "everything": lambda scene, task: replace(task, task_objects=tuple(o.instance for o in scene.objects)),
    "other objects": lambda scene, task: replace(task, task_objects=(_other_than(scene, task),)),
    "a relation that does not hold": lambda scene, task: replace(
        task, relations=(Relation(task.task_objects[0], RelationKind.ON, _other_than(scene, task)),)
    ),
}
"""What systems may attach to the same scene."""


def _other_than(scene: Scene, task: TaskInfo) -> str:
    return next(o.instance for o in scene.objects if o.instance not in task.task_objects)


@pytest.mark.parametrize("what", ATTACHED)
def test_a_scene_has_the_same_rating_whatever_its_maker_attached(rater: Rater, what: str) -> None:
    """Each change would lower a criterion by its names: with a hidden task object, OV and LCR depend on which ones are of the task."""
    for changed in (rater.scene("coffee_table"), changed_by(with_task_object_under_table, rater.scene("dining_table"))):
        assert changed.task is not None
        staged = each(changed, lambda o: replace(o, stage=Stage.TASK))
        other = rater.rate(replace(staged, task=ATTACHED[what](changed, changed.task)))
        assert other.scores == rater.rate(changed).scores


def test_a_scene_whose_instruction_is_not_understood_has_no_task_objects(rater: Rater) -> None:
    scene = changed_by(with_task_object_under_table, rater.scene("dining_table"))
    assert scene.task is not None
    ratings = [
        rater.rate(replace(scene, task=TaskInfo("", "Grok the quux.", task_objects=named)))
        for named in ((), scene.task.task_objects, tuple(o.instance for o in scene.objects))
    ]
    assert ratings[0].score("cwt") is None
    assert [r.scores for r in ratings] == [ratings[0].scores] * 3


def test_a_scene_is_aligned_once_for_all_criteria(rater: Rater, monkeypatch: pytest.MonkeyPatch) -> None:
    aligned, align = list[str](), AuditedScene.align

    def counted(case: AuditedScene, reference: AlignmentReference) -> Alignment:
        aligned.append(case.scene.scene_id)
        return align(case, reference)

    monkeypatch.setattr(AuditedScene, "align", counted)
    scenes = [rater.scene("dining_table"), rater.scene("coffee_table")]
    ratings = [rater.rate(scene) for scene in scenes]
    assert aligned == [scene.scene_id for scene in scenes]
    assert ratings == [rater.unchanged(scene) for scene in scenes]
