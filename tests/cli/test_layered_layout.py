"""Graphs from left to right: no node covers another one, and arrows leave on the right."""

from __future__ import annotations

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from zstate.cli.output.layout import layered_layout

NODES = [f"n{number}" for number in range(12)]
PAIRS = [(one, other) for one in NODES for other in NODES if one != other]
SIZE = (100.0, 40.0)


@given(st.lists(st.sampled_from(PAIRS), unique=True, max_size=30))
def test_nodes_do_not_overlap_and_every_edge_touches_both_of_its_ends(edges: list[tuple[str, str]]):
    layout = layered_layout(dict.fromkeys(NODES, SIZE), edges)
    assert layout.places.keys() == set(NODES)
    for (x, y), (other_x, other_y) in combinations(layout.places.values(), 2):
        assert abs(x - other_x) >= SIZE[0] or abs(y - other_y) > SIZE[1]
    assert min(y for _, y in layout.places.values()) >= -1e-9
    for begin, end in edges:
        route = layout.routes[begin, end]
        for node, (x, y) in ((begin, route[0]), (end, route[-1])):
            left, top = layout.places[node]
            assert x in (left, left + SIZE[0])
            assert top < y < top + SIZE[1]


def test_data_flow_from_left_to_right():
    edges = [("driver", "joints"), ("joints", "publisher"), ("publisher", "tf"), ("joints", "viewer")]
    layout = layered_layout(dict.fromkeys(["tf", "viewer", "publisher", "joints", "driver"], SIZE), edges)
    for begin, end in edges:
        assert layout.places[begin][0] + SIZE[0] < layout.places[end][0]
        assert layout.routes[begin, end][0][0] == layout.places[begin][0] + SIZE[0]
        assert layout.routes[begin, end][-1][0] == layout.places[end][0]


def test_an_edge_that_closes_a_circle_runs_back():
    edges = [("a", "b"), ("b", "c"), ("c", "a")]
    layout = layered_layout(dict.fromkeys("abc", SIZE), edges)
    assert layout.places["a"][0] < layout.places["b"][0] < layout.places["c"][0]
    xs = [x for x, _ in layout.routes["c", "a"]]
    assert xs == sorted(xs, reverse=True)


def test_crossings_are_avoided():
    edges = [("a", "y"), ("b", "x"), ("c", "z")]
    layout = layered_layout(dict.fromkeys("abcxyz", SIZE), edges)
    heights = [(layout.places[begin][1], layout.places[end][1]) for begin, end in edges]
    assert all((one[0] < other[0]) == (one[1] < other[1]) for one, other in combinations(heights, 2))


def test_empty_graph_has_an_empty_drawing():
    assert not layered_layout({}, []).places
