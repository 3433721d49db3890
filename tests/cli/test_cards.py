"""Trees on a page: everything has its place, nothing covers anything else."""

from __future__ import annotations

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from zstate.cli.pictures.cards import Card, cards

TREES = st.lists(st.tuples(st.integers(0, 10_000), st.floats(20.0, 300.0), st.booleans()), max_size=40)


def drawn(parents: dict[str, str], sizes: dict[str, tuple[float, float]]) -> dict[str, Card]:
    children: dict[str, list[str]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
    roots = [name for name in sizes if name not in parents]
    return {card.name: card for card in cards(roots, children, sizes.__getitem__)}


def overlap(one: Card, other: Card) -> bool:
    x = min(one.x + one.width, other.x + other.width) - max(one.x, other.x)
    y = min(one.y + one.height, other.y + other.height) - max(one.y, other.y)
    return min(x, y) > 1e-9


@given(TREES)
def test_every_node_has_a_place_of_its_own_below_its_parent(nodes: list[tuple[int, float, bool]]):
    # Every eighth node is a root; the others hang on any node before them.
    names = [f"n{number}" for number in range(len(nodes))]
    parents = {names[n]: names[nodes[n][0] % n] for n in range(len(nodes)) if n % 8}
    sizes = {
        name: (width, 38.0 if high else 24.0) for name, (_, width, high) in zip(names, nodes, strict=True)
    }
    placed = drawn(parents, sizes)
    assert placed.keys() == sizes.keys()
    assert not any(overlap(one, other) for one, other in combinations(placed.values(), 2))
    for child, parent in parents.items():
        assert placed[child].parent == parent
        assert placed[child].y >= placed[parent].y + placed[parent].height
        rail = placed[child].rail
        assert rail is None or rail < placed[child].x
    assert all(card.x > -1e-9 and card.y > -1e-9 for card in placed.values())


def test_an_only_child_stands_under_the_middle_of_its_parent():
    sizes = {"base": (100.0, 38.0), "arm": (60.0, 38.0), "hand": (80.0, 38.0), "tip": (50.0, 38.0)}
    placed = drawn({"arm": "base", "hand": "arm", "tip": "hand"}, sizes)
    middles = {placed[name].x + placed[name].width / 2 for name in ("base", "arm", "hand")}
    assert len(middles) == 1


def test_a_wide_tree_is_folded_to_the_shape_of_a_page():
    leaves = [f"leaf{number}" for number in range(40)]
    placed = drawn(dict.fromkeys(leaves, "base"), dict.fromkeys(["base", *leaves], (200.0, 24.0)))
    assert max(card.x + card.width for card in placed.values()) < 300.0
    assert placed["leaf0"].rail is not None


def test_a_deep_chain_is_drawn():
    names = [f"n{number}" for number in range(3000)]
    parents = dict(zip(names[1:], names, strict=False))
    assert len(drawn(parents, dict.fromkeys(names, (50.0, 24.0)))) == 3000
