"""Sizes of categories, and scales from them."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import MeshError
from stable_data.geometry.surface import Surface
from stable_data.importers.conversion import ConversionContext, extents_of
from stable_data.importers.conversion.scaling import choose_scale
from stable_data.importers.conversion.sizes import SetScale, SizeTable, read_sizes
from stable_data.importers.source import SourceAsset

TABLE = SizeTable()
MUG = SourceAsset("a", "mug", ())


def test_every_row_of_the_table_is_sound() -> None:
    for size in read_sizes().values():
        longest, middle, shortest = np.exp(size.log_sides)
        assert 1e-3 < longest < 3
        assert longest >= middle * 0.99
        assert middle >= shortest * 0.99
        assert size.low < longest < size.high
        assert 0 < size.upright <= 1.01


@given(st.sampled_from(sorted(read_sizes())), st.floats(1e-3, 1e3))
def test_the_middle_of_a_category_in_any_unit_gets_its_size_back(category: str, unit: float) -> None:
    sides = np.exp(read_sizes()[category].log_sides)
    found = TABLE.infer_scale(category, (sides / unit).tolist())
    assert found is not None
    assert found.unit_m == pytest.approx(unit, rel=1e-6)
    assert 0 < found.confidence <= 1


def test_sides_may_come_in_any_order_and_one_odd_side_changes_little() -> None:
    sides = np.exp(read_sizes()["fork"].log_sides)
    usual = TABLE.infer_scale("fork", sides.tolist())
    turned = TABLE.infer_scale("fork", sides[[2, 0, 1]].tolist())
    flat = TABLE.infer_scale("fork", (sides * (1, 1, 0.05)).tolist())
    assert usual is not None
    assert turned == usual
    assert flat is not None
    assert 1 <= flat.unit_m < 1.5
    assert flat.confidence < usual.confidence


def test_other_names_have_sizes_and_nonsense_has_none() -> None:
    assert TABLE.find("coffee_mug") is not None
    found = TABLE.find("large_blue_teapot")
    assert found is not None
    assert found[0].category == "teapot"
    assert TABLE.find("zorble") is None


def test_rows_of_a_source_can_be_left_out() -> None:
    assert "mustard_bottle" in read_sizes()
    assert "mustard_bottle" not in read_sizes(("YCB",))


def test_a_set_has_one_unit_and_outliers_do_not_move_it() -> None:
    things = ["mug", "plate", "bowl", "fork", "spoon", "teapot", "kettle"]
    listing = [(name, (np.exp(read_sizes()[name].log_sides) / 0.2).tolist()) for name in things]
    found = TABLE.set_scale([*listing, ("apple", (9.0, 9.0, 9.0))])
    assert found is not None
    assert found.unit_m == pytest.approx(0.2, rel=1e-6)
    assert TABLE.set_scale([("zorble", (1.0, 1.0, 1.0))]) is None


def scale(asset: SourceAsset, extents: tuple[float, float, float], category: str = "mug", **options: Any) -> tuple[float, str]:
    found = choose_scale(asset, category, np.array(extents), TABLE, **options)
    return found.unit_m, found.source


def test_given_and_stated_scales_are_exact() -> None:
    exact = choose_scale(SourceAsset("a", "mug", (), unit_m=0.01), "mug", np.array((9.0, 12.0, 10.0)), TABLE)
    columns = exact.columns(0.12)
    assert (exact.unit_m, exact.confidence, columns["size_low"], columns["size_high"]) == (0.01, 1.0, 0.12, 0.12)
    assert not columns["scale_inferred"]
    unit, source = scale(SourceAsset("a", "mug", (), size_m=(0.09, 0.12, 0.1)), (0.9, 1.2, 1.0))
    assert source == "stated_size"
    assert unit == pytest.approx(0.1)


def test_a_stated_size_of_other_proportions_is_warned() -> None:
    found = choose_scale(SourceAsset("a", "mug", (), size_m=(0.12, 0.1, 0.05)), "mug", np.array((1.0, 1.0, 1.0)), TABLE)
    assert found.unit_m == pytest.approx(0.1)
    assert [n.code for n in found.notices] == ["size_differs"]


def test_an_asset_keeps_the_scale_of_its_set_unless_it_would_be_odd() -> None:
    common = SetScale(0.15, 0.6, 80)
    assert scale(MUG, (0.7, 0.6, 0.6), set_scale=common) == (0.15, "set")
    unit, source = scale(SourceAsset("a", "table", ()), (2.0, 2.0, 1.0), "table", set_scale=common)
    assert source == "category"
    assert 0.4 < unit < 1.0


def test_in_a_folder_of_many_units_an_asset_has_the_surer_scale() -> None:
    mixed = SetScale(0.15, 0.2, 80)
    unit, source = scale(MUG, (0.7, 0.6, 0.6), set_scale=mixed)
    assert (unit != 0.15, source) == (True, "category")
    unsure = TABLE.infer_scale("candle", (1.0, 0.1, 0.1))
    assert unsure is not None
    assert unsure.confidence < 0.58
    assert scale(MUG, (1.0, 0.1, 0.1), "candle", set_scale=SetScale(0.15, 0.58, 80)) == (0.15, "set")
    assert scale(MUG, (1.0, 1.0, 1.0), "zorble", set_scale=mixed) == (0.15, "set")
    assert scale(MUG, (4.0, 1.0, 1.0), "zorble", set_scale=mixed, default_longest_m=0.2) == (0.05, "option")


@given(st.lists(st.sampled_from([1e-3, 0.01, 0.0254, 1.0, 30.0]), min_size=10, max_size=10))
def test_things_whose_files_have_units_of_their_own_keep_their_sizes(units: list[float]) -> None:
    """Whatever the mixture: either the common unit is that of a thing, or the thing has its own."""
    names = ["mug", "plate", "bowl", "fork", "spoon", "teapot", "kettle", "knife", "wine_glass", "vase"]
    boxes = [np.exp(read_sizes()[name].log_sides) / unit for name, unit in zip(names, units, strict=True)]
    common = TABLE.set_scale(zip(names, (box.tolist() for box in boxes), strict=True))
    for name, box, unit in zip(names, boxes, units, strict=True):
        found = choose_scale(SourceAsset("a", name, ()), name, box, TABLE, set_scale=common)
        assert abs(math.log(found.unit_m / unit)) < math.log(3)


def test_without_any_size_an_asset_is_refused_or_gets_the_default() -> None:
    with pytest.raises(MeshError, match="no size of a zorble") as error:
        scale(MUG, (1.0, 1.0, 1.0), "zorble")
    assert error.value.code == "scale_unknown"
    assert scale(MUG, (4.0, 1.0, 1.0), "zorble", default_longest_m=0.2) == (0.05, "option")


def test_assets_without_a_size_do_not_count_in_a_set() -> None:
    flat = SourceAsset("a", "mug", (Surface(np.zeros((0, 3, 3))),))
    assert extents_of(flat.surfaces) == (0.0, 0.0, 0.0)
    assert ConversionContext().set_scale([(flat, extents_of(flat.surfaces)), (MUG, (math.nan, 1.0, 1.0))]) is None


@pytest.mark.parametrize(("unit", "factor"), [(1.0, "0.001"), (1e-6, "1000")])
def test_a_unit_that_cannot_be_names_the_factor_that_can(unit: float, factor: str) -> None:
    with pytest.raises(MeshError, match=f"a factor of {factor} would make it") as error:
        scale(SourceAsset("a", "mug", (), unit_m=unit), (120.0, 90.0, 90.0))
    assert error.value.code == "unit_implausible"


def test_inferred_scales_say_so() -> None:
    found = choose_scale(MUG, "mug", np.array((1.2, 0.9, 0.9)), TABLE)
    columns = found.columns(0.12)
    assert columns["scale_inferred"] is True
    assert columns["size_low"] < 0.12 < columns["size_high"]
    assert [n.code for n in found.notices] == ["scale_inferred"]
    assert math.isclose(columns["scale_confidence"], found.confidence or 0)
