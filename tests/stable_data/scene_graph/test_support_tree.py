"""SupportTree against plain definitions: what is above what is a walk along ``support``, whatever the supports are."""

import networkx as nx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import SceneError
from stable_data.scene import TABLE
from stable_data.scene_graph.support_tree import SupportTree, ancestors

NAMES = [f"{k}_thing_0" for k in range(8)]


@st.composite
def forests(draw: st.DrawFn) -> dict[str, str | None]:
    """Supports without circles, in any order."""
    supports = {
        name: draw(st.sampled_from([TABLE, None, "left_out", *NAMES[:k], *NAMES[:k], *NAMES[:k]]))
        for k, name in enumerate(NAMES)
    }
    return {name: supports[name] for name in draw(st.permutations(NAMES))}


@given(forests())
def test_the_order_is_carriers_first_and_each_object_once(supports: dict[str, str | None]) -> None:
    tree = SupportTree(supports)
    order = tree.bottom_up()
    assert sorted(order) == sorted(supports)
    assert all(order.index(p) < order.index(name) for name in order if (p := tree.parent(name)) is not None)
    for name in order:  # what an object carries follows it at once
        own = tree.with_descendants({name})
        start = order.index(name)
        assert set(order[start : start + len(own)]) == own


@given(forests())
def test_ancestors_and_descendants_are_those_of_the_graph(supports: dict[str, str | None]) -> None:
    tree = SupportTree(supports)
    graph: nx.DiGraph[str] = nx.DiGraph((name, p) for name, p in supports.items() if p in supports and p is not None)
    graph.add_nodes_from(supports)
    for name in supports:
        assert set(tree.ancestors(name)) == nx.descendants(graph, name)
        assert tree.with_descendants({name}) == {name} | nx.ancestors(graph, name)
        assert tree.root(name) in tree.children(None)
        assert tree.root(name) in (name, *nx.descendants(graph, name))


@given(st.fixed_dictionaries({name: st.sampled_from([TABLE, None, *NAMES]) for name in NAMES}))
def test_every_walk_ends_and_the_order_refuses_circles(supports: dict[str, str | None]) -> None:
    tree = SupportTree(supports)
    for name in supports:
        found = list(ancestors(supports, name))
        assert len(found) == len(set(found))
        assert name not in found
    graph = nx.DiGraph((name, p) for name, p in supports.items() if p in supports)
    if nx.is_directed_acyclic_graph(graph):
        assert len(tree.bottom_up()) == len(supports)
    else:
        with pytest.raises(SceneError, match="form a cycle of supports") as caught:
            tree.bottom_up()
        assert caught.value.code == "support_circle"


def test_a_circle_is_named_with_its_scene() -> None:
    with pytest.raises(SceneError, match=r"^desk_7: lid -> pot -> lid form a cycle"):
        SupportTree({"cup": TABLE, "lid": "pot", "pot": "lid"}, "desk_7").bottom_up()


def test_names_that_are_no_objects_have_no_descendants() -> None:
    tree = SupportTree({"cup": "tray", "spoon": "cup"})
    assert tree.with_descendants({"tray"}) == {"tray"}
    assert tree.with_descendants({"cup"}) == {"cup", "spoon"}
