"""Similarity of layouts: a kernel with known values, and near-duplicates against a search over all pairs."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.diversity.layout_similarity import SceneLayouts, group_pairs, layout_kernel, near_duplicates
from stable_data.scene import Scene, SceneObject, Tabletop

KINDS = ("cup", "plate", "pen")


def scene(name: str, objects: list[tuple[str, float, float]], table: str = "office_table", width: float = 1.2) -> Scene:
    made = tuple(
        SceneObject(f"{k}_{kind}_0", kind, (x, y, 0.05), 0.0, (0.1, 0.1, 0.1)) for k, (kind, x, y) in enumerate(objects)
    )
    return Scene(name, Tabletop(table, (width, 0.6)), made)


ONE = scene("one", [("cup", 0.3, 0.3), ("plate", 0.6, 0.3)])


def test_the_kernel_of_two_scenes_is_the_sum_over_objects_of_the_same_category() -> None:
    other = scene("other", [("cup", 0.4, 0.3), ("pen", 0.6, 0.3)])
    kernel = layout_kernel(SceneLayouts.of([ONE, other]))
    assert np.diagonal(kernel) == pytest.approx([1.0, 1.0])
    assert kernel[0, 1] == kernel[1, 0] == pytest.approx(math.exp(-0.5) / 2)


def test_the_kernel_does_not_depend_on_the_order_of_objects_or_the_width_of_the_table() -> None:
    turned = scene("turned", [("plate", 0.9, 0.3), ("cup", 0.6, 0.3)], width=1.8)
    assert layout_kernel(SceneLayouts.of([ONE, turned])) == pytest.approx(np.ones((2, 2)))


def test_scenes_without_objects_are_equal_to_each_other_and_unlike_others() -> None:
    empty = scene("empty", [])
    assert layout_kernel(SceneLayouts.of([empty, ONE, empty])) == pytest.approx(np.array([[1, 0, 1], [0, 1, 0], [1, 0, 1]]))
    assert near_duplicates(SceneLayouts.of([empty, ONE, empty])).tolist() == [[0, 2]]
    assert len(layout_kernel(SceneLayouts.of([]))) == len(near_duplicates(SceneLayouts.of([]))) == 0


PLACES = st.tuples(st.sampled_from(KINDS), st.integers(0, 3).map(lambda k: 0.3 + 0.015 * k), st.just(0.3))
SCENES = st.lists(st.lists(PLACES, max_size=5), max_size=7)


@given(SCENES)
def test_the_kernel_is_positive_semi_definite(drawn: list[list[tuple[str, float, float]]]) -> None:
    kernel = layout_kernel(SceneLayouts.of([scene(f"s{k}", objects) for k, objects in enumerate(drawn)]))
    assert kernel == pytest.approx(kernel.T)
    assert np.linalg.eigvalsh(kernel).min(initial=0.0) > -1e-9


def most_matched(one: Scene, other: Scene) -> int:
    """By trying each set of matches; the scenes are small."""

    def best(left: list[SceneObject], right: list[SceneObject]) -> int:
        if not left:
            return 0
        first, rest = left[0], left[1:]
        fits = [o for o in right if o.category == first.category and math.dist(o.position, first.position) <= 0.02]
        return max([best(rest, right), *(1 + best(rest, [o for o in right if o is not used]) for used in fits)])

    return best(list(one.objects), list(other.objects))


@given(SCENES, st.sampled_from([0.5, 0.8, 1.0]))
def test_near_duplicates_are_those_that_a_search_over_all_pairs_finds(
    drawn: list[list[tuple[str, float, float]]], share: float
) -> None:
    scenes = [scene(f"s{k}", objects, "office_table" if k % 3 else "coffee_table") for k, objects in enumerate(drawn)]
    expected = [
        [a, b]
        for a, b in combinations(range(len(scenes)), 2)
        if scenes[a].table.table_type == scenes[b].table.table_type
        and 2 * most_matched(scenes[a], scenes[b]) >= share * (len(scenes[a].objects) + len(scenes[b].objects)) - 1e-9
    ]
    assert near_duplicates(SceneLayouts.of(scenes), share=share).tolist() == expected


def test_other_meshes_of_the_same_things_are_no_new_layout() -> None:
    exchanged = replace(ONE, objects=tuple(replace(o, asset_id="other") for o in ONE.objects))
    assert near_duplicates(SceneLayouts.of([ONE, exchanged])).tolist() == [[0, 1]]


def test_groups_connect_through_others() -> None:
    assert group_pairs(np.array([[0, 3], [3, 4]]), 6).tolist() == [0, 1, 2, 0, 0, 3]
    assert group_pairs(np.zeros((0, 2), np.int64), 2).tolist() == [0, 1]


def test_some_layouts_are_those_of_the_chosen_scenes() -> None:
    scenes = [ONE, scene("two", [("pen", 0.1, 0.1)]), scene("three", [])]
    chosen, made = SceneLayouts.of(scenes).some([2, 0, 2]), [scenes[2], scenes[0], scenes[2]]
    assert chosen.counts.tolist() == [0, 2, 0]
    assert layout_kernel(chosen) == pytest.approx(layout_kernel(SceneLayouts.of(made)))
