from hypothesis import given
from hypothesis import strategies as st

from stable_data.random_seeds import named_seed
from stable_data.scene import Stage


@given(st.lists(st.integers() | st.text(), min_size=1))
def test_seeds_are_small_and_the_same_each_time(parts: list[int | str]) -> None:
    assert named_seed(*parts) == named_seed(*parts)
    assert 0 <= named_seed(*parts) < 2**48


def test_seeds_tell_their_parts_apart() -> None:
    assert len({named_seed(1, 23), named_seed(12, 3), named_seed(123), named_seed(1, 23, 0)}) == 4
    assert named_seed(0, Stage.TASK) == named_seed(0, "task")
