"""Edits of every kind: clean and at rest afterwards, true to their words, nothing else touched."""

import numpy as np
import pytest

from stable_data.embedded_world.drafting import KINDS
from stable_data.embedded_world.edits import make_edit
from stable_data.embedded_world.scenes import EmbeddedScene, make_scene
from stable_data.embedded_world.settling import audit, bodies_of, unsteady_objects
from stable_data.simulation.settling import settle

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def made() -> list[EmbeddedScene]:
    return [make_scene(number, seed=8) for number in (2, 4, 5)]


@pytest.mark.parametrize("kind", KINDS)
def test_edit_of_every_kind_is_clean_and_changes_only_what_it_says(kind: str, made: list[EmbeddedScene]) -> None:
    edits = [make_edit(one, np.random.default_rng(k), (kind,)) for k, one in enumerate(made)]
    found = [edit for edit in edits if edit is not None]
    assert found
    for edit in found:
        before, after = ({o.instance: o for o in scene.objects} for scene in (edit.before, edit.after))
        assert set(after) - set(before) == set(edit.added)
        assert set(before) - set(after) == set(edit.removed)
        assert {name for name in set(before) & set(after) if before[name] != after[name]} == set(edit.moved)
        counts = {
            "add": (1, 0, 0), "remove": (0, 1, 0), "move": (0, 0, 1), "replace": (1, 1, 0),
        }  # fmt: skip
        if kind in counts:
            assert (len(edit.added), len(edit.removed), len(edit.moved)) == counts[kind]
        else:
            assert len(edit.moved) >= 2
        assert audit(edit.after, edit.placed).card().clean
        assert not unsteady_objects(edit.after, edit.placed)
        assert settle(bodies_of(edit.after, edit.placed), edit.after.table).stable
        assert edit.instruction[0].isupper()
        assert edit.instruction[-1] in ".?!"
        assert not set("[]{}|") & set(edit.instruction)


def test_edit_is_the_same_for_the_same_chance(made: list[EmbeddedScene]) -> None:
    one, other = (make_edit(made[0], np.random.default_rng(4)) for _ in range(2))
    assert one is not None
    assert other is not None
    assert (one.instruction, one.after) == (other.instruction, other.after)
