"""The taste of scenes: statistics and distances whose values are known by calculation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stable_data.scene import RelationKind, Scene, Vec3
from stable_data.scores.taste import (
    LEAST,
    POOLED,
    STATISTICS,
    SceneTaste,
    Statistic,
    TrainingStatistics,
    compare,
    compare_scenes,
    placement_ratio,
)
from tests.stable_data.scores.taste_scenes import scene_of, scenes, thing

SIZES = Statistic("size", lambda _: [])
LABELS = Statistic("label", lambda _: [], is_label=True)


def values(name: str, scene: Scene, *training: Scene) -> list[float]:
    return list(STATISTICS[name].measure(SceneTaste(scene, TrainingStatistics(training))))


ON = RelationKind.ON
FLAT, KNIFE, THICK = (0.1, 0.1, 0.005), (0.2, 0.02, 0.005), (0.1, 0.1, 0.01)


@pytest.mark.parametrize(
    ("lower", "upper", "kind", "expected"),
    [(FLAT, FLAT, ON, 100), (FLAT, FLAT, None, 0), (FLAT, KNIFE, ON, 0), (FLAT, THICK, ON, 0), (THICK, FLAT, ON, 0)],
)
def test_a_mat_on_a_mat_is_found(lower: Vec3, upper: Vec3, kind: RelationKind | None, expected: float) -> None:
    relations = [("coaster_1", kind, "coaster_0")] if kind else []
    scene = scene_of(thing("coaster_0", 0.3, 0.3, lower), thing("coaster_1", 0.3, 0.3, upper), relations=relations)
    assert values("stacked_mats", scene) == [expected]


ROW = scene_of(thing("mug_0", 0.2, 0.3), thing("mug_1", 0.4, 0.3), thing("book_0", 0.9, 0.38, yaw=87.0))
PILE = scene_of(
    thing("tray_0", 0.3, 0.3, (0.3, 0.3, 0.05)), thing("cup_0", 0.3, 0.3), thing("cup_1", 0.25, 0.3), thing("box_0", 1.0, 0.1),
    relations=[("cup_0", RelationKind.IN, "tray_0"), ("cup_1", ON, "tray_0")],
)  # fmt: skip
SIZE_OF_TURNED = 0.1 * (math.cos(math.radians(3)) + math.sin(math.radians(3)))  # the side of the box around the turned cube
GAP_OF_TURNED = 0.9 - SIZE_OF_TURNED / 2 - 0.45  # its nearest corner is at the height of the other cube


@pytest.mark.parametrize(
    ("name", "scene", "expected"),
    [
        ("objects", ROW, [3]),
        ("repeats", ROW, [100 / 3]),
        ("most_of_one", ROW, [2]),
        ("covered", PILE, [100 * (0.09 + 0.01) / 0.72]),  # things on the tray cover nothing
        ("gap", ROW, [100 * (0.1 + 0.1 + GAP_OF_TURNED) / 3]),
        ("uneven_gaps", ROW, [np.std([0.1, 0.1, GAP_OF_TURNED]) / np.mean([0.1, 0.1, GAP_OF_TURNED])]),
        ("uneven_gaps", PILE, []),
        ("touching", ROW, [0]),
        ("touching", scene_of(thing("a_0", 0.3, 0.3), thing("a_1", 0.401, 0.3), thing("a_2", 0.6, 0.3)), [200 / 3]),
        ("on", PILE, [25]),
        ("in", PILE, [25]),
        ("on", ROW, [0]),
        ("yaw", ROW, [0, 0, 3]),
        ("yaw", scene_of(thing("a_0", 0.2, 0.3, yaw=-91.0), thing("a_1", 0.5, 0.3, yaw=135.0)), [1, 45]),
        ("straight", scene_of(thing("a_0", 0.2, 0.3, yaw=-91.0), thing("a_1", 0.5, 0.3, yaw=135.0)), [50]),
        ("in_line", ROW, [50]),  # the mugs; the book is near mug_1, 8 cm farther back
        ("edge", scene_of(thing("a_0", 0.3, 0.1), thing("a_1", 1.18, 0.3)), [5, -3]),
        ("cells", scene_of(thing("a_0", 0.1, 0.1), thing("a_1", 0.6, 0.5), thing("a_2", 9.0, 0.3)), [0, 7, 5]),
    ],
)  # fmt: skip
def test_statistics_have_their_calculated_values(name: str, scene: Scene, expected: list[float]) -> None:
    assert values(name, scene) == pytest.approx(expected, abs=1e-9)


def test_pairs_and_sizes_are_compared_with_training() -> None:
    training = scene_of(thing("mug_0", 0.2, 0.3), thing("book_0", 0.4, 0.3), thing("mug_1", 0.6, 0.3, (0.2, 0.2, 0.2)))
    scene = scene_of(thing("mug_0", 0.2, 0.3), thing("book_0", 0.6, 0.3), thing("toy_0", 0.9, 0.3))
    assert values("pairs_unseen", scene, training) == pytest.approx([200 / 3])  # only mug and book are together in training
    assert values("pairs_unseen", scene) == []  # without training it is unknown
    assert values("size", scene, training) == pytest.approx([-1.5 * math.log(2), 0])  # the mean mug has 8 ** 0.5 of its volume


def test_an_empty_table_has_no_values_but_counts() -> None:
    known = {name: values(name, scene_of(), ROW) for name in STATISTICS}
    assert {name: found for name, found in known.items() if found} == {
        "objects": [0], "most_of_one": [0], "covered": [0], "stacked_mats": [0],
    }  # fmt: skip


def each(*numbers: float) -> list[list[float]]:
    return [[n] for n in numbers]


def test_a_shift_is_its_length_in_standard_deviations() -> None:
    held_out = np.arange(40.0)
    found = compare(SIZES, each(*(held_out + 10)), each(*held_out))
    assert (found.generated, found.held_out) == (29.5, 19.5)
    assert found.distance == pytest.approx(10 / held_out.std())
    assert found.floor is not None
    assert 0 < found.floor < 0.5
    assert found.ratio == pytest.approx(10 / held_out.std() / found.floor)
    assert compare(SIZES, each(*held_out), each(*held_out)).distance == 0


def test_names_are_compared_by_total_variation() -> None:
    found = compare(LABELS, [[0.0, 0.0, 0.0, 8.0]] * LEAST, [[0.0, 8.0]] * LEAST)
    assert found.distance == pytest.approx(0.25)
    never = compare(LABELS, each(*[0.0] * 10, *[100.0] * 10), each(*[0.0] * 40))
    assert (never.distance, never.floor, never.ratio) == (0.5, 0, None)


def test_what_too_few_scenes_say_is_unknown() -> None:
    many, few = each(*range(2 * LEAST)), each(*range(LEAST - 1))
    for one, other in ((many, few), (few, many), ([*few, []], many)):  # a scene without a value does not count
        found = compare(SIZES, one, other)
        assert (found.distance, found.floor, found.ratio) == (None, None, None)
    halves = compare(SIZES, many, each(*range(2 * LEAST - 1)))
    assert halves.distance is not None
    assert (halves.floor, halves.ratio) == (None, None)
    assert compare(SIZES, [], many).generated is None


def test_equal_held_out_values_have_no_unit() -> None:
    equal = each(*[3.0] * 2 * LEAST)
    other = compare(SIZES, each(*[4.0] * 2 * LEAST), equal)
    assert (other.generated, other.held_out, other.distance, other.ratio) == (4, 3, None, None)
    assert compare(SIZES, equal, equal).distance == 0


def test_equal_scenes_have_no_distance_and_larger_things_only_that_of_size() -> None:
    data = scenes(40)
    equal = compare_scenes(data, data, TrainingStatistics(data))
    assert list(equal) == [POOLED, "desk"]
    assert all(c.distance == 0 for c in equal[POOLED].values())
    larger = compare_scenes(scenes(40, scale=1.3), data, TrainingStatistics(data))["desk"]
    spread = np.std([v for s in data for v in values("size", s, *data)])
    assert larger["size"].distance == pytest.approx(3 * math.log(1.3) / spread)
    assert larger["objects"].distance == larger["yaw"].distance == larger["cells"].distance == 0


def test_kinds_of_table_are_compared_alone() -> None:
    data = [*scenes(20, "desk"), *scenes(4, "shelf")]
    found = compare_scenes(data, data, TrainingStatistics(data))
    assert list(found) == [POOLED, "desk", "shelf"]
    assert found["desk"]["objects"].num_held_out == 20
    assert found["shelf"]["objects"].distance is None


def test_the_placement_is_how_much_farther_than_held_out_scenes_are_from_each_other() -> None:
    data = scenes(60)
    near = placement_ratio(compare_scenes(data[:30], data[30:], TrainingStatistics(data))[POOLED])
    moved = [replace(s, objects=tuple(replace(o, yaw=0.0, position=(0.1, 0.1, 0.0)) for o in s.objects)) for s in data[:30]]
    far = placement_ratio(compare_scenes(moved, data[30:], TrainingStatistics(data))[POOLED])
    assert near is not None
    assert far is not None
    assert 0.5 < near < 2.5 < far
    assert placement_ratio(compare_scenes(data[:3], data, TrainingStatistics(data))[POOLED]) is None  # too few scenes
