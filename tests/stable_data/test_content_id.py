"""Names derived from content: the same ones for ever, and in little memory where there are many parts."""

import hashlib
import json
from typing import Any

import pytest

from stable_data.content_id import content_id, content_id_of_items


@pytest.mark.parametrize("items", [[], [1], [{"b": (1, None), "a": "Tür"}, [], "x", 2.5]])
@pytest.mark.parametrize("more", [(), ([],), ({"z": 1}, "y")])
def test_many_items_have_the_name_of_their_list(items: list[Any], more: tuple[Any, ...]) -> None:
    assert content_id_of_items(iter(items), *more) == content_id(items, *more)
    text = json.dumps([items, *more], sort_keys=True, separators=(",", ":"), ensure_ascii=False)  # as runs are named that exist
    assert content_id(items, *more) == hashlib.sha256(text.encode()).hexdigest()[:16]
