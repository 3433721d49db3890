"""Trees on a page: everything has its place, nothing covers anything else."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from zstate.cli.output.layout import Layout, Size, tree_layout

TREES = st.lists(st.tuples(st.integers(0, 10_000), st.floats(20.0, 300.0), st.booleans()), max_size=40)


def drawn(parents: Mapping[str, str], sizes: Mapping[str, Size]) -> Layout:
    return tree_layout(sizes, [(parent, child) for child, parent in parents.items()])


def overlap(one: str, other: str, layout: Layout, sizes: Mapping[str, Size]) -> bool:
    return all(
        min(layout.places[one][axis] + sizes[one][axis], layout.places[other][axis] + sizes[other][axis])
        - max(layout.places[one][axis], layout.places[other][axis])
        > 1e-9
        for axis in (0, 1)
    )


@given(TREES)
def test_every_node_has_its_own_place_below_its_parent(nodes: list[tuple[int, float, bool]]):
    # Every eighth node is a root; the others hang on any node before them.
    names = [f"n{number}" for number in range(len(nodes))]
    parents = {names[n]: names[nodes[n][0] % n] for n in range(len(nodes)) if n % 8}
    sizes = {
        name: (width, 38.0 if high else 24.0) for name, (_, width, high) in zip(names, nodes, strict=True)
    }
    layout = drawn(parents, sizes)
    assert layout.places.keys() == sizes.keys()
    assert not any(overlap(one, other, layout, sizes) for one, other in combinations(sizes, 2))
    assert layout.routes.keys() == {(parent, child) for child, parent in parents.items()}
    for (parent, child), route in layout.routes.items():
        (left, top), (x, y) = layout.places[parent], layout.places[child]
        (width, height), (child_width, child_height) = sizes[parent], sizes[child]
        assert y >= top + height
        assert left < route[0][0] < left + width
        assert route[0][1] == top + height
        assert route[-1] in ((x + child_width / 2, y), (x, y + child_height / 2))
        assert route[-2][0] <= route[-1][0]  # a line along a rail arrives at the left edge
    assert all(x > -1e-9 and y > -1e-9 for x, y in layout.places.values())


def test_an_only_child_is_centred_below_its_parent():
    sizes = {"base": (100.0, 38.0), "arm": (60.0, 38.0), "hand": (80.0, 38.0), "tip": (50.0, 38.0)}
    layout = drawn({"arm": "base", "hand": "arm", "tip": "hand"}, sizes)
    middles = {layout.places[name][0] + sizes[name][0] / 2 for name in ("base", "arm", "hand")}
    assert len(middles) == 1


def test_a_wide_tree_is_folded_to_the_shape_of_a_page():
    leaves = [f"leaf{number}" for number in range(40)]
    layout = drawn(dict.fromkeys(leaves, "base"), dict.fromkeys(["base", *leaves], (200.0, 24.0)))
    assert max(x + 200.0 for x, _ in layout.places.values()) < 300.0
    assert layout.routes["base", "leaf0"][-1][0] == layout.places["leaf0"][0]  # along a rail, from the left


def test_a_deep_chain_is_drawn():
    names = [f"n{number}" for number in range(3000)]
    parents = dict(zip(names[1:], names, strict=False))
    assert len(drawn(parents, dict.fromkeys(names, (50.0, 24.0))).places) == 3000
