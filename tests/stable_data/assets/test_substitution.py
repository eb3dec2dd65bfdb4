"""Wanted objects with assets: where they end up, and what they carry."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.assets.retrieval import AssetMatch
from stable_data.assets.substitution import substitute_asset, substitute_assets
from stable_data.errors import SceneError
from stable_data.scene import TABLE, UPRIGHT, SceneObject, Stage, Vec3
from tests.stable_data.assets.bag_of_words import LAID


def wanted(name: str, low: float, size: Vec3 = (0.1, 0.1, 0.1), support: str | None = TABLE) -> SceneObject:
    return SceneObject(
        name, "cup", (0.3, 0.4, low + size[2] / 2), 0.7, size, description="a cup", stage=Stage.TASK, support=support
    )


def match(height: float, category: str = "mug") -> AssetMatch:
    return AssetMatch("uid", "lib", category, 0.9, 0.9, 0.9, LAID, (2.0, 2.0, 2.0), (0.2, 0.3, height))


def test_an_object_keeps_what_it_is_and_where_it_stands() -> None:
    before = wanted("0_cup_0", 0.05)
    after = substitute_asset(before, match(0.3))
    kept = ("instance", "yaw", "description", "stage", "support")
    assert [getattr(after, name) for name in kept] == [getattr(before, name) for name in kept]
    assert after.position == pytest.approx((0.3, 0.4, 0.2))
    assert (after.asset_id, after.category, after.tilt_quat_xyzw) == ("uid", "mug", LAID)
    assert (after.scale, after.size) == ((2.0, 2.0, 2.0), (0.2, 0.3, 0.3))
    assert substitute_asset(before, match(0.3, category="")).category == "object"  # not the cup that was asked for


@given(
    st.lists(st.floats(0.01, 0.5), min_size=1, max_size=6),
    st.lists(st.floats(0.01, 0.5), min_size=6, max_size=6),
    st.booleans(),
)
def test_a_stack_still_stands_whatever_its_heights_become(old: list[float], new: list[float], is_reversed: bool) -> None:
    stack, low = list[SceneObject](), 0.0
    for k, height in enumerate(old):
        stack.append(wanted(str(k), low, (0.1, 0.1, height), TABLE if k == 0 else str(k - 1)))
        low += height
    objects = stack[::-1] if is_reversed else stack
    placed = substitute_assets(objects, {o.instance: match(new[k]) for k, o in enumerate(stack) if k % 3 != 1})
    assert [o.instance for o in placed] == [o.instance for o in objects]
    by_name = {o.instance: o for o in placed}
    assert by_name["0"].bottom == pytest.approx(0.0, abs=1e-12)
    for k in range(1, len(stack)):
        assert by_name[str(k)].bottom == pytest.approx(by_name[str(k - 1)].top)


def test_what_lies_in_a_bowl_stays_between_its_underside_and_its_rim() -> None:
    bowl, apple = wanted("bowl", 0.0, (0.3, 0.3, 0.1)), wanted("apple", 0.02, (0.05, 0.05, 0.05), "bowl")
    _, inside = substitute_assets([bowl, apple], {"bowl": match(0.2)})
    assert inside.bottom == pytest.approx(0.04)
    assert inside.size == apple.size


def test_a_gap_above_a_carrier_is_kept_and_so_is_depth_below_it() -> None:
    tray = wanted("tray", 0.0, (0.3, 0.3, 0.02))
    above, below = wanted("above", 0.03, support="tray"), wanted("below", -0.01, support="tray")
    _, a, b = substitute_assets([tray, above, below], {"tray": match(0.05)})
    assert a.bottom == pytest.approx(0.06)
    assert b.bottom == pytest.approx(-0.01)


def test_what_no_match_touches_is_unchanged() -> None:
    shelf = wanted("shelf", 0.0)
    on_earlier = wanted("cup", 0.2, support="of_an_earlier_stage")
    loose = wanted("loose", 0.3, support=None)
    assert substitute_assets([shelf, on_earlier, loose], {}) == pytest.approx((shelf, on_earlier, loose))
    cup = substitute_assets([shelf, on_earlier, loose], {"cup": match(0.4), "shelf": match(0.9)})[1]
    assert cup.bottom == pytest.approx(0.2)


def test_supports_in_a_circle_are_refused() -> None:
    one, other = wanted("one", 0.0, support="other"), wanted("other", 0.1, support="one")
    with pytest.raises(SceneError, match="one -> other -> one form a cycle of supports"):
        substitute_assets([one, other], {})
    with pytest.raises(SceneError, match="one -> one form a cycle"):
        substitute_assets([wanted("one", 0.0, support="one")], {})


def test_an_upright_match_needs_no_tilt() -> None:
    assert (
        substitute_asset(wanted("cup", 0.0), AssetMatch("uid", "lib", "", 1, 1, 1, UPRIGHT, (1, 1, 1), (1, 1, 1))).tilt_angle
        == 0
    )


def test_a_turned_asset_turns_the_object() -> None:
    before = wanted("0_cup_0", 0.05)
    after = substitute_asset(before, replace(match(0.3), is_turned=True))
    assert after.yaw == pytest.approx(before.yaw + math.pi / 2)
    assert after.size == (0.2, 0.3, 0.3)
